"""Scene files: the arrays they become, and the scenes of the repository."""

import dataclasses
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from causticmpi.config.records import Camera
from causticmpi.errors import InputError
from causticmpi.kernels.material_kinds import DIELECTRIC, DIFFUSE, MIRROR, PHONG
from causticmpi.scene.content import content_hash, has_specular, with_camera
from causticmpi.scene.data import SceneData
from causticmpi.scene.load import load_scene

ROOT = Path(__file__).resolve().parent.parent
HEAD = """\
camera: {eye: [0, 0, 4], target: [0, 0, 0]}
materials:
  white: {type: diffuse, reflectance: 0.5}
  glass: {type: dielectric, ior: 1.5}
shapes:
  - {type: quad, corners: [[0, 0, 0], [1, 0, 0], [1, 2, 0], [0, 2, 0]], material: white, emission: [1, 2, 3]}
"""


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "s.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def load(tmp_path: Path, shape: str = "") -> SceneData:
    return load_scene(write(tmp_path, HEAD + (f"  - {shape}\n" if shape else "")))


def crosses(scene: SceneData, start: int = 0) -> np.ndarray:
    a, b, c = (scene.vertices[scene.triangles[start:, i]].astype(float) for i in range(3))
    return np.cross(b - a, c - a)


def volume(scene: SceneData, start: int) -> float:
    """Signed volume inside the triangles from `start` on: positive where the normals point outward."""
    a, b, c = (scene.vertices[scene.triangles[start:, i]].astype(float) for i in range(3))
    return float((a * np.cross(b, c)).sum() / 6.0)


def test_quad(tmp_path: Path) -> None:
    scene = load(tmp_path)
    assert scene.triangles.shape == (2, 3) and scene.spheres.shape == (0, 4)
    np.testing.assert_allclose(crosses(scene), [[0, 0, 2], [0, 0, 2]])
    assert scene.emission.tolist() == [[1, 2, 3]] and scene.primitive_emission.tolist() == [0, 0]
    assert scene.name == "s" and not has_specular(scene)


def test_types_of_all_arrays(tmp_path: Path) -> None:
    scene = load(tmp_path, "{type: sphere, center: [1, 2, 3], radius: 0.5, material: glass}")
    floats = {"vertices", "spheres", "emission"} | {
        f"material_{part}" for part in ("reflectance", "specular", "exponent", "ior")
    }
    for name in SceneData.ARRAYS:
        assert getattr(scene, name).dtype == (np.float32 if name in floats else np.int32), name
    assert scene.spheres.tolist() == [[1, 2, 3, 0.5]]
    assert scene.primitive_material.tolist() == [0, 0, 1] and scene.primitive_emission.tolist() == [0, 0, -1]
    assert has_specular(scene)


def test_triangles_are_numbered_before_spheres(tmp_path: Path) -> None:
    sphere = "{type: sphere, center: [0, 0, 0], radius: 1, material: glass}"
    scene = load(tmp_path, f"{sphere}\n  - {{type: box, min: [0, 0, 0], max: [1, 1, 1], material: white}}")
    assert scene.primitive_material.tolist() == [0] * 14 + [1]
    assert scene.primitive_emission.tolist() == [0, 0] + [-1] * 13
    assert scene.primitive_shape.tolist() == [0, 0] + [1] * 12 + [2]


def test_materials(tmp_path: Path) -> None:
    text = HEAD.replace(
        "shapes:",
        "  silver: {type: mirror, reflectance: [0.9, 0.8, 0.7]}\n"
        "  gloss: {type: phong, diffuse: 0.7, specular: [0.3, 0.2, 0.1], exponent: 60}\nshapes:",
    )
    scene = load_scene(write(tmp_path, text))
    assert scene.material_kind.tolist() == [DIFFUSE, DIELECTRIC, MIRROR, PHONG]
    np.testing.assert_allclose(
        scene.material_reflectance, np.array([[0.5, 0.5, 0.5], [1, 1, 1], [0.9, 0.8, 0.7], [0.7, 0.7, 0.7]]), rtol=1e-6
    )
    np.testing.assert_allclose(scene.material_specular, np.array([[0, 0, 0]] * 3 + [[0.3, 0.2, 0.1]]), rtol=1e-6)
    assert scene.material_exponent.tolist() == [0, 0, 0, 60]
    np.testing.assert_allclose(scene.material_ior, [1, 1.5, 1, 1])


def test_equal_emissions_share_a_row_and_black_is_none(tmp_path: Path) -> None:
    lamp = "{type: sphere, center: [0, 0, 0], radius: 1, material: white, emission: "
    scene = load(tmp_path, f"{lamp}[1, 2, 3]}}\n  - {lamp}[0, 0, 0]}}\n  - {lamp}4}}")
    assert scene.emission.tolist() == [[1, 2, 3], [4, 4, 4]]
    assert scene.primitive_emission.tolist() == [0, 0, 0, -1, 1]


def test_box_faces_outward(tmp_path: Path) -> None:
    scene = load(tmp_path, "{type: box, min: [1, 2, 3], max: [2, 4, 7], material: white}")
    normals, corners = crosses(scene, 2), scene.vertices[scene.triangles[2:]].astype(float)
    assert len(normals) == 12
    outward = (normals * (corners.mean(axis=1) - [1.5, 3, 5])).sum(axis=1)
    assert (outward > 0).all() and volume(scene, 2) == pytest.approx(8.0)
    assert np.linalg.norm(normals, axis=1).sum() / 2 == pytest.approx(2 * (2 + 4 + 8))


def cube() -> Any:
    return trimesh.creation.box(extents=(1, 2, 3))


@pytest.mark.parametrize("kind", ["binary.ply", "ascii.ply", "cube.obj"])
def test_meshes_written_by_trimesh(tmp_path: Path, kind: str) -> None:
    mesh = cube()
    if kind.endswith("ply"):
        (tmp_path / kind).write_bytes(mesh.export(file_type="ply", encoding=kind.split(".")[0]))
    else:
        mesh.export(tmp_path / kind)
    scene = load(tmp_path, f"{{type: mesh, file: {kind}, material: glass, smooth: false}}")
    np.testing.assert_array_equal(
        scene.vertices[scene.triangles[2:]], np.asarray(mesh.vertices, np.float32)[mesh.faces]
    )
    assert volume(scene, 2) == pytest.approx(6.0) and scene.dropped_triangles == 0


def test_scale_then_rotate_x_y_z_then_translate(tmp_path: Path) -> None:
    (tmp_path / "m.obj").write_text("v 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\n")
    turn = "scale: [2, 3, 4], rotate: [90, 90, 0], translate: [10, 20, 30]"
    scene = load(tmp_path, f"{{type: mesh, file: m.obj, material: white, {turn}}}")
    # x: (2,0,0) -> (2,0,0) -> (0,0,-2); y: (0,3,0) -> (0,0,3) -> (3,0,0); z: (0,0,4) -> (0,-4,0) -> (0,-4,0).
    np.testing.assert_array_equal(
        scene.vertices[scene.triangles[2]], np.array([[0, 0, -2], [3, 0, 0], [0, -4, 0]]) + [10, 20, 30]
    )


@pytest.mark.parametrize("rotate", ["[30, 0, 0]", "[0, -75, 0]", "[10, 200, 355]"])
def test_transforms_keep_the_orientation(tmp_path: Path, rotate: str) -> None:
    cube().export(tmp_path / "m.ply")
    scene = load(tmp_path, f"{{type: mesh, file: m.ply, material: white, scale: [1, 2, 0.5], rotate: {rotate}}}")
    assert volume(scene, 2) == pytest.approx(6.0, rel=1e-5)


def test_rotation_is_right_handed(tmp_path: Path) -> None:
    (tmp_path / "m.obj").write_text("v 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\n")
    scene = load(tmp_path, "{type: mesh, file: m.obj, material: white, rotate: [0, 0, 30]}")
    np.testing.assert_allclose(scene.vertices[scene.triangles[2, 0]], [3**0.5 / 2, 0.5, 0], atol=1e-7)


def test_quads_are_triangulated_and_flat_triangles_dropped(tmp_path: Path) -> None:
    (tmp_path / "m.obj").write_text(
        "v 9 9 9\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 2 3 4 5\nf 2 2 3\nf 2 3 3\nf -1 -2 -3\n"
    )
    scene = load(tmp_path, "{type: mesh, file: m.obj, material: white}")
    np.testing.assert_allclose(crosses(scene, 2), [[0, 0, 1], [0, 0, 1], [0, 0, -1]])
    assert scene.dropped_triangles == 2
    assert scene.vertices.max() == 2.0, "the unused vertex (9, 9, 9) is gone"


@pytest.mark.parametrize(
    ("name", "triangles", "spheres", "specular", "power"),
    [
        ("cornell", 12, 2, {MIRROR, DIELECTRIC}, 15 * 0.25),
        ("ring", 12_004, 0, {MIRROR}, 200 * 0.16),
        ("pool", 32_780, 0, {DIELECTRIC}, 600 * 0.04),
    ],
)
def test_shipped_scenes(name: str, triangles: int, spheres: int, specular: set[int], power: float) -> None:
    scene = load_scene(ROOT / "scenes" / f"{name}.yaml")
    assert (len(scene.triangles), len(scene.spheres), scene.dropped_triangles) == (triangles, spheres, 0)
    assert set(scene.material_kind[scene.primitive_material].tolist()) == {DIFFUSE} | specular
    lit = scene.primitive_emission[:triangles] >= 0
    areas = np.linalg.norm(crosses(scene), axis=1) / 2
    assert (areas[lit] * scene.emission[0, 0]).sum() == pytest.approx(power, rel=1e-5)
    # Lights shine down; their material is black.
    assert (crosses(scene)[lit][:, 1] < 0).all()
    assert not scene.material_reflectance[scene.primitive_material[:triangles][lit]].any()


def test_shipped_light_of_the_ring_faces_the_origin() -> None:
    scene = load_scene(ROOT / "scenes" / "ring.yaml")
    normal = crosses(scene)[scene.primitive_emission >= 0][0]
    np.testing.assert_allclose(normal / np.linalg.norm(normal), [-(0.5**0.5), -(0.5**0.5), 0], atol=1e-6)


def test_committed_meshes_are_what_the_script_writes(tmp_path: Path) -> None:
    runpy.run_path(str(ROOT / "scripts" / "make_meshes.py"))["main"](tmp_path)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["ring.ply", "water.ply"]
    for name in names:
        assert (tmp_path / name).read_bytes() == (ROOT / "scenes" / "meshes" / name).read_bytes(), name


def test_ring_is_closed_and_water_looks_up() -> None:
    ring: Any = trimesh.load(ROOT / "scenes" / "meshes" / "ring.ply", process=False)
    assert ring.is_watertight and len(ring.faces) == 12_000
    exact = np.pi * (1.02**2 - 0.98**2) * 0.61
    assert ring.volume == pytest.approx(exact, rel=1e-3)
    water: Any = trimesh.load(ROOT / "scenes" / "meshes" / "water.ply", process=False)
    assert len(water.faces) == 32_768 and (water.face_normals[:, 1] > 0.9).all()


def test_hash_follows_content_and_nothing_else(tmp_path: Path) -> None:
    scene = load(tmp_path)
    (tmp_path / "other.yaml").write_text("# a comment\n" + HEAD)
    twin = load_scene(tmp_path / "other.yaml")
    assert twin.content_hash == scene.content_hash == content_hash(scene) and len(scene.content_hash) == 64
    assert twin.name != scene.name
    for name in SceneData.ARRAYS:
        array = getattr(scene, name)
        if array.size:
            changed = dataclasses.replace(scene, **{name: array + array.dtype.type(1)})
            assert content_hash(changed) != scene.content_hash, name


def test_with_camera(tmp_path: Path) -> None:
    scene = load(tmp_path)
    moved = with_camera(scene, Camera(eye=(1, 2, 3), target=(0, 0, 0)))
    assert moved.camera.eye == (1, 2, 3) and moved.vertices is scene.vertices
    assert moved.content_hash != scene.content_hash
    assert with_camera(moved, scene.camera).content_hash == scene.content_hash
    with pytest.raises(InputError, match="eye and target are the same point"):
        with_camera(scene, Camera(eye=(1, 2, 3), target=(1, 2, 3)))


def test_the_measured_cornell_box_may_be_a_little_skew(tmp_path: Path) -> None:
    wall = "[[552.8, 0, 0], [549.6, 0, 559.2], [556, 548.8, 559.2], [556, 548.8, 0]]"
    assert len(load(tmp_path, f"{{type: quad, material: white, corners: {wall}}}").triangles) == 4


@pytest.mark.parametrize("size", [1e-15, 1e-6, 1e6, 1e15])
def test_scale_of_the_scene_does_not_matter(tmp_path: Path, size: float) -> None:
    scene = load(
        tmp_path,
        f"{{type: quad, material: white, corners: [[0, 0, 0], [{size}, 0, 0], [{size}, {size}, 0], [0, {size}, 0]]}}",
    )
    assert len(scene.triangles) == 4
