"""Other renderers: what is exported, what is recorded, what is measured; a small comparison of our own methods."""

from argparse import ArgumentTypeError
from pathlib import Path

import numpy as np
import pytest
from rendering import REPOSITORY, scene_from

from causticmpi.compare.metrics import measure
from causticmpi.errors import InputError
from causticmpi.peers.export import icosphere, surfaces, write_ply
from causticmpi.peers.luxcore import engine_properties, pixel_footprint, scene_properties
from causticmpi.peers.mitsuba import llvm_version
from causticmpi.peers.recording import Recording, Task, budgets
from causticmpi.peers.references import find_reference, from_halves
from causticmpi.peers.results import OTHERS, misplaced, own, points_of
from causticmpi.peers.run import compare, read_arguments
from causticmpi.peers.scenes import common_scene
from causticmpi.scene.load import load_scene
from causticmpi.scene.mesh import mesh_triangles
from causticmpi.scene.records import Mesh

SCENE = """
camera: {eye: [0, 0, 1.8], target: [0, 0, 0], fov: 40}
materials:
  white: {type: diffuse, reflectance: [0.7, 0.6, 0.5]}
  glass: {type: dielectric, ior: 1.5}
  gloss: {type: phong, diffuse: [0.3, 0.2, 0.1], specular: 0.5, exponent: 60}
shapes:
  - {type: quad, corners: [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], material: GROUND}
  - {type: quad, corners: [[-1, -1, 2], [-1, 1, 2], [1, 1, 2], [1, -1, 2]], material: white, emission: 3}
  - {type: sphere, center: [0.1, 0.2, 0.5], radius: 0.25, material: glass}
"""


def scene_file(folder: Path, ground: str = "white", size: int = 16) -> Path:
    (folder / "scene.yaml").write_text(SCENE.replace("GROUND", ground))
    config = folder / "little.yaml"
    config.write_text(
        f"{{scene: scene.yaml, film: {{width: {size}, height: {size}}}, forecast: {{photons: 500, clusters: 4}}}}"
    )
    return config


def test_surfaces_have_one_look_each_and_keep_every_triangle(tmp_path: Path) -> None:
    scene = scene_from(SCENE.replace("GROUND", "white"), tmp_path)
    found = {surface.name: surface for surface in surfaces(scene)}
    assert [s.kind for s in found.values()] == ["diffuse", "diffuse", "dielectric"]
    dark, light, ball = found.values()
    assert (dark.radiance, light.radiance, ball.ior) == (None, (3.0, 3.0, 3.0), 1.5)
    assert ball.sphere == pytest.approx((0.1, 0.2, 0.5, 0.25))
    corners = np.concatenate([s.vertices[s.triangles] for s in (dark, light)])
    np.testing.assert_array_equal(corners, scene.vertices[scene.triangles])
    assert not surfaces(scene, 2)[2].sphere and len(surfaces(scene, 2)[2].triangles) == 320


def test_a_material_that_others_do_not_have_is_refused_and_replaced_for_all(tmp_path: Path) -> None:
    config = scene_file(tmp_path, "gloss")
    with pytest.raises(InputError, match="found a phong material"):
        surfaces(load_scene(tmp_path / "scene.yaml"))
    common, changes = common_scene(config, tmp_path / "out", None)
    scene = load_scene(common.parent / "scene.yaml")
    assert "gloss of `gloss`" in changes and {s.kind for s in surfaces(scene)} == {"diffuse", "dielectric"}
    np.testing.assert_allclose(surfaces(scene)[1].reflectance, (0.3, 0.2, 0.1), rtol=1e-6)


@pytest.mark.parametrize("name", ["ring", "cornell"])
def test_without_gloss_the_common_scene_is_the_original(tmp_path: Path, name: str) -> None:
    common, changes = common_scene(REPOSITORY / f"configs/{name}.yaml", tmp_path, None)
    original = load_scene(REPOSITORY / f"scenes/{name}.yaml")
    assert (load_scene(common.parent / "scene.yaml").content_hash, changes) == (original.content_hash, "")


def test_tessellated_for_all(tmp_path: Path) -> None:
    common, changes = common_scene(scene_file(tmp_path), tmp_path / "out", 3)
    scene = load_scene(common.parent / "scene.yaml")
    assert (len(scene.spheres), len(scene.triangles)) == (0, 4 + 1280) and "1280 triangles" in changes


def test_an_icosphere_is_closed_and_faces_outward(tmp_path: Path) -> None:
    centre = np.array([1.0, 2.0, 3.0])
    vertices, triangles = icosphere(centre, 0.5, 3)
    np.testing.assert_allclose(np.linalg.norm(vertices - centre, axis=1), 0.5, rtol=1e-6)
    a, b, c = (vertices[triangles[:, i]] - centre for i in range(3))
    assert (np.sum(np.cross(b - a, c - a) * (a + b + c), axis=1) > 0).all()
    surface = surfaces(scene_from(SCENE.replace("GROUND", "white"), tmp_path), 3)[2]
    write_ply(surface, tmp_path / "ball.ply")
    read = mesh_triangles(Mesh(file="ball.ply", material="glass"), tmp_path)
    np.testing.assert_array_equal(read.vertices[read.triangles], surface.vertices[surface.triangles])


def test_luxcore_gets_camera_materials_and_flat_meshes(tmp_path: Path) -> None:
    scene = scene_from(SCENE.replace("GROUND", "white"), tmp_path)
    found = scene_properties(surfaces(scene, 1), scene.camera, 32, 16, tmp_path)
    assert found["scene.camera.screenwindow"] == pytest.approx([-2, 2, -1.125, 0.875])
    assert found["scene.materials.mesh1.emission"] == [3.0, 3.0, 3.0]
    assert found["scene.materials.sphere0.interiorior"] == 1.5
    assert b"nx" not in Path(found["scene.shapes.sphere0.ply"]).read_bytes()[:400]
    footprint = pixel_footprint(scene.camera, 16)
    assert footprint == pytest.approx(2 * np.tan(np.radians(20)) * 1.8 / 16)
    for method in ("path", "hybrid", "bidir", "bidirvm", "photongi"):
        assert engine_properties(method, 32, 16, 1, footprint)["native.threads.count"] == 1
    assert {c.method for c in OTHERS if c.module == "luxcore"} == {"path", "hybrid", "bidir", "bidirvm", "photongi"}


@pytest.mark.parametrize(
    ("name", "version"), [("libLLVM-16.so.1", 16), ("libLLVM.so.19.1", 19), ("libLLVM-14.so", 14), ("libLLVM.so", 0)]
)
def test_llvm_version_by_file_name(name: str, version: int) -> None:
    assert llvm_version(Path("/usr/lib") / name) == version


def test_mitsuba_sees_what_we_see(tmp_path: Path) -> None:
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    from causticmpi.peers.mitsuba import mitsuba_scene

    scene = scene_from(SCENE.replace("GROUND", "white"), tmp_path)
    picture = np.array(mi.render(mitsuba_scene(mi, scene, 16, 16, None), spp=64, seed=1))
    task = Task(scene_file(tmp_path), "pt", tmp_path / "pt.npz", (0.1,))
    from causticmpi.peers.ours import render

    ours = render(task)[0].pictures[-1]
    assert abs(picture.mean() / ours.mean() - 1) < 0.03


def test_a_recording_takes_the_nearest_moment_for_each_budget(tmp_path: Path) -> None:
    recording = Recording(budgets("4,1,2"))
    for step in range(12):
        seconds = 0.75 * step
        if recording.due(seconds, 0.75):
            recording.take(np.full((2, 2, 3), seconds), seconds, 0.75, step)
    assert recording.done and recording.seconds == [0.75, 2.25, 3.75]
    slow = Recording(budgets("1,2,9"))
    slow.take(np.zeros((2, 2, 3)), 5.0, 1.0, 1)
    assert slow.seconds == [5.0, 5.0] and not slow.done
    recording.write(Task(tmp_path, "pt", tmp_path / "run.npz", (1, 2, 4), key="k"), {"note": "n"})
    again, facts = Recording.read(tmp_path / "run.npz")
    assert again.seconds == recording.seconds and facts == {"note": "n", "key": "k"}
    assert again.pictures[1][0, 0, 0] == 2.25


def test_budgets_must_be_positive() -> None:
    with pytest.raises(ArgumentTypeError, match='found "0"; allowed: a number > 0'):
        budgets("0,5")


def test_the_noise_of_two_halves_cancels() -> None:
    """A noisy picture's error comes out as it is, the truth's as 0, within 5 standard errors of 0.9 % each."""
    random = np.random.default_rng(1)
    truth = random.uniform(0.2, 1.0, (64, 64, 3))
    a, b, e = (truth + random.normal(0, 0.02, truth.shape) for _ in range(3))
    nothing = np.zeros((64, 64), bool)
    expected = float((0.02**2 / (truth**2 + 0.01)).mean())
    found = measure(e, from_halves(a, b), nothing, False).relmse
    assert abs(found / expected - 1) < 0.05
    assert abs(measure(truth, from_halves(a, b), nothing, False).relmse) < 0.05 * expected


def test_a_reference_of_another_size_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "ring.npz", half1=np.zeros((4, 5, 1)), half2=np.zeros((4, 5, 1)))
    assert find_reference(tmp_path, "pool", (4, 5)) is None
    found = find_reference(tmp_path, "ring", (4, 5))
    assert found is not None and found.rgb.shape == (4, 5, 3)
    with pytest.raises(InputError, match="found 5 x 4 pixels, need 8 x 8"):
        find_reference(tmp_path, "ring", (8, 8))


def test_a_shifted_picture_is_noticed(tmp_path: Path) -> None:
    truth = np.random.default_rng(2).uniform(0.1, 1, (32, 32, 3))
    reference = from_halves(truth, truth)
    for name, shift, words in (("right", 0, ""), ("low", 1, "fits better moved by (-1, 0) pixels (down, right)")):
        recording = Recording((1.0,))
        recording.take(np.roll(truth, shift, 0), 1.0, 0, 1)
        task = Task(tmp_path, "pt", tmp_path / f"{name}.npz", (1.0,))
        recording.write(task, {"renderer": "x", "note": "", "uncounted_cpu_seconds": 0.0})
        assert misplaced(task.out, reference) == words
        assert points_of(own("pt"), 1, task.out, reference)[0].mean_difference == pytest.approx(0, abs=1e-6)


def test_a_comparison_is_whole_and_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    config = scene_file(tmp_path)
    out = tmp_path / "peers"
    command = ["--scenes", str(config), "--only", "ours:pt", "--seconds", "1,2", "--scale", "0.1", "--out", str(out)]
    command += ["--reference-seconds", "3"]
    compare(read_arguments(command))
    made = (out / "little/ours-pt-1.npz").stat().st_mtime_ns
    text = (out / "little.md").read_text()
    assert "| causticmpi pt |" in text and "two halves of 0.3 CPU seconds" in text
    assert (out / "little.csv").read_text().splitlines()[-1].startswith("little,causticmpi,pt,,1,0.2,")
    assert (out / "little.png").exists() and (out / "peers.png").exists()
    compare(read_arguments(command))
    assert (out / "little/ours-pt-1.npz").stat().st_mtime_ns == made
    with pytest.raises(InputError, match="found cycles; allowed: ours, mitsuba, luxcore"):
        compare(read_arguments(["--only", "cycles"]))
