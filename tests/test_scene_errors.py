"""Scene files that cannot be rendered: the exact words, and nothing but InputError."""

import random
from pathlib import Path

import numpy as np
import pytest
import trimesh

from causticmpi.errors import InputError
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
SHAPE_LINE = 7


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "s.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def message(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        load_scene(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


QUAD = "{type: quad, material: white, corners: "
LIT = "{type: quad, material: white, emission: 1, corners: "
BALL = "{type: sphere, center: [0, 0, 0], "
BAD_SHAPES = [
    ("5", ["shapes[1]: found 5", "a section with a type (quad, sphere, box, mesh)"]),
    ("{material: white}", ['shapes[1]: missing key "type"', "quad, sphere"]),
    ("{type: qaud}", ['shapes[1].type: found "qaud"', "quad, sphere, box, mesh", 'did you mean "quad"?']),
    ("{type: [quad]}", ['shapes[1].type: found ["quad"]', "allowed: quad"]),
    (BALL + "radius: 1}", ['shapes[1]: missing key "material"', "add `material:"]),
    (
        BALL + "radius: 1, material: glas}",
        ['shapes[1].material: found "glas"', "white, glass", 'did you mean "glass"?'],
    ),
    (BALL + "radius: 1, material: 3}", ["shapes[1].material: found 3", "a text"]),
    (BALL + "radius: 1, material: white, color: 3}", ["shapes[1].color: unknown key; allowed: type, material"]),
    (BALL + "radius: 1, material: white, emision: 3}", ["emision: unknown key", 'did you mean "emission"?']),
    (BALL + "radius: -1, material: white}", ["shapes[1].radius: found -1", "a number > 0"]),
    (BALL + "radius: x, material: white}", ['shapes[1].radius: found "x"', "a number"]),
    (BALL + "radius: 1e-60, material: white}", ["shapes[1].radius: found 1e-60", "vanishes in float32"]),
    (BALL + "radius: 0, material: white, emission: 1}", ["radius: found 0", "caustics of point lights are out of"]),
    (BALL + "radius: 1, material: white, emission: -1}", ["shapes[1].emission: found -1", "from 0 to 1e+18"]),
    (BALL + "radius: 1, material: white, emission: [1, -2, 3]}", ["emission: found [1.0, -2.0, 3.0]", "from 0"]),
    (BALL + "radius: 1, material: white, emission: .inf}", ["shapes[1].emission: found .inf", "finite"]),
    (BALL + "radius: 1, material: white, emission: [1, 2]}", ["emission: found [1, 2]", "a number or a list of 3"]),
    (BALL + "radius: 1, material: white, emission: hot}", ['emission: found "hot"', "a number or a list of 3"]),
    (BALL + "radius: 1, material: glass, emission: 1}", ['specular material "glass"', "black diffuse material"]),
    ("{type: sphere, center: [0, 1e20, 0], radius: 1, material: white}", ["coordinate 1e+20", "up to 1e+18"]),
    ("{type: sphere, center: [1e9, 0, 0], radius: 1, material: white}", ["radius: found 1", "vanishes in float32"]),
    (QUAD + "[[0, 0, 0], [1, 0, 0], [1, 1, 0.1], [0, 1, 0]]}", ["corners: not in one plane, off by 0.0", "use a mesh"]),
    (QUAD + "[[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]]}", ["corners: all four lie on one line, zero area"]),
    (QUAD + "[[1, 1, 1], [1, 1, 1], [1, 1, 1], [1, 1, 1]]}", ["all four are the same point"]),
    (QUAD + "[[0, 0, 0], [1, 1, 0], [1, 0, 0], [0, 1, 0]]}", ["do not go around a convex outline", "in order"]),
    (QUAD + "[[0, 0, 0], [1, 0, 0], [1, 1, 0], [0.9, 0.1, 0]]}", ["do not go around a convex outline"]),
    (QUAD + "[[0, 0, 0], [1, 0, 0], [1, 0, 0], [0, 1, 0]]}", ["two corners in one place"]),
    (QUAD + "[[1e9, 0, 0], [1000000001, 0, 0], [1000000001, 1, 0], [1e9, 1, 0]]}", ["zero area once rounded"]),
    (QUAD + "[[0, 0, 0], [1, 0, 0], [1, 1, 0]]}", ["corners: found", "a list of 4, each a list of 3"]),
    (LIT + "[[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]]}", ["zero area", "caustics of point lights are out of"]),
    ("{type: box, min: [0, 0, 0], max: [1, 0, 1], material: white}", ["found 0 and 0 in y", "min < max", "a quad"]),
    ("{type: box, min: [0, 0, 2], max: [1, 1, 1], material: white}", ["found 2 and 1 in z", "swap them"]),
    (
        "{type: mesh, file: none.ply, material: white}",
        ["cannot read", "none.ply: no such file", "relative to the scene"],
    ),
    ('{type: mesh, file: "m.stl", material: white}', ["file: found", ".ply or .obj", "convert"]),
    ("{type: mesh, file: m.ply, material: white, smooth: true}", ["smooth: found true", "tessellate the mesh finer"]),
    ("{type: mesh, file: m.ply, material: white, scale: -1}", ["scale: found -1", "normals inside out"]),
    ("{type: mesh, file: m.ply, material: white, scale: [1, 0, 1]}", ["scale: found (1.0, 0.0, 1.0)", "> 0"]),
    ("{type: mesh, file: m.ply, material: white, scale: 1e300}", ["file: ", "coordinate", "up to 1e+18"]),
    ("{type: mesh, file: m.ply, material: white, translate: [1e9, 1e9, 0]}", ["only triangles of zero area"]),
]


@pytest.mark.parametrize(("shape", "pieces"), BAD_SHAPES, ids=[shape[:70] for shape, _ in BAD_SHAPES])
def test_bad_shapes(tmp_path: Path, shape: str, pieces: list[str]) -> None:
    trimesh.creation.box(extents=(1, 2, 3)).export(tmp_path / "m.ply")
    path = write(tmp_path, f"{HEAD}  - {shape}\n")
    found = message(path)
    assert found.startswith(f"{path}:{SHAPE_LINE}: shapes[1]")
    assert [piece for piece in pieces if piece not in found] == [], found


def test_a_block_shape_names_the_line_of_its_key(tmp_path: Path) -> None:
    shape = "\n    type: sphere\n    center: [0, 0, 0]\n    radius: -1\n    material: white"
    path = write(tmp_path, f"{HEAD}  -{shape}\n")
    assert message(path).startswith(f"{path}:{SHAPE_LINE + 3}: shapes[1].radius: found -1")


BAD_MATERIALS = [
    ("{type: diffuse, reflectance: 1.5}", ["reflectance: found 1.5", "each from 0 to 1"]),
    ("{type: diffuse, reflectance: [0, -0.1, 0]}", ["reflectance: found [0.0, -0.1, 0.0]", "each from 0 to 1"]),
    ("{type: diffuse, reflectance: [0, x, 0]}", ['reflectance[1]: found "x"', "a number"]),
    ("{type: diffuse, reflectance: true}", ["reflectance: found true", "a number or a list of 3"]),
    ("{type: diffuse}", ['missing key "reflectance"', "add `reflectance: 1`"]),
    ("{type: diffuse, reflectence: 1}", ["reflectence: unknown key", 'did you mean "reflectance"?']),
    ("{type: mirror, reflectance: 2}", ["reflectance: found 2", "each from 0 to 1"]),
    ("{type: miror, reflectance: 1}", ['type: found "miror"', 'did you mean "mirror"?']),
    ("{type: dielectric, ior: 1}", ["ior: found 1", "> 1 and <= 10", "out of the denser side"]),
    ("{type: dielectric, ior: 0.7}", ["ior: found 0.7", "> 1 and <= 10"]),
    ("{type: dielectric, ior: 50}", ["ior: found 50", "> 1 and <= 10"]),
    ("{type: phong, diffuse: 0.5, specular: [0.2, 0.6, 0], exponent: 9}", ["= 1.1 in a channel", "conserves energy"]),
    ("{type: phong, diffuse: 0.5, specular: 0.1, exponent: -1}", ["exponent: found -1", ">= 0"]),
    ("{type: phong, diffuse: 0.5, specular: 0.1, exponent: 1e9}", ["exponent: found 1e+09", "up to 1e+06"]),
    ("{type: phong, diffuse: 0.5, specular: 0.1, exponent: .inf}", ["exponent: found .inf", "finite"]),
    ("white", ['found "white"', "a section with a type (diffuse, mirror, dielectric, phong)"]),
]


@pytest.mark.parametrize(("material", "pieces"), BAD_MATERIALS, ids=[text for text, _ in BAD_MATERIALS])
def test_bad_materials(tmp_path: Path, material: str, pieces: list[str]) -> None:
    path = write(tmp_path, HEAD.replace("{type: dielectric, ior: 1.5}", material))
    found = message(path)
    assert found.startswith(f"{path}:4: materials.glass")
    assert [piece for piece in pieces if piece not in found] == [], found


@pytest.mark.parametrize(
    ("old", "new", "line", "pieces"),
    [
        (", emission: [1, 2, 3]", "", 5, ["shapes: no shape emits light", "add for example `emission:"]),
        ("emission: [1, 2, 3]", "emission: 0", 5, ["no shape emits light"]),
        ("emission: [1, 2, 3]", "emission: 1e-60", 5, ["no shape emits light"]),
        ("target: [0, 0, 0]", "target: [0, 0, 4]", 1, ["camera: eye and target are the same point"]),
        ("target: [0, 0, 0]", "target: [0, 0, 0], up: [0, 0, -2]", 1, ["camera.up: found", "parallel"]),
        ("eye: [0, 0, 4], ", "", 1, ['camera: missing key "eye"']),
        ("camera:", "kamera:", 1, ["kamera: unknown key", 'did you mean "camera"?']),
        ("  white:", "  glass:", 4, ['duplicate key "materials.glass"', "first on line 3"]),
        ("materials:", "materials: 5\nx:", 2, ["materials: found 5", "name: value"]),
        ("shapes:", "shapes: 5\nx:", 5, ["shapes: found 5", "a list"]),
    ],
)
def test_bad_scenes(tmp_path: Path, old: str, new: str, line: int, pieces: list[str]) -> None:
    assert old in HEAD
    path = write(tmp_path, HEAD.replace(old, new, 1))
    found = message(path)
    assert found.startswith(f"{path}:{line}: ")
    assert [piece for piece in pieces if piece not in found] == [], found


ASCII = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n1 1 {z}\n{face}"
)
OBJ = "v 0 0 0\nv 1 0 0\nv 1 1 {z}\n{face}"


@pytest.mark.parametrize(
    ("name", "text", "piece"),
    [
        ("a.ply", ASCII.format(z="nan", face="3 0 1 2\n"), "vertices that are not finite"),
        ("a.obj", OBJ.format(z="nan", face="f 1 2 3\n"), "vertices that are not finite"),
        ("a.obj", OBJ.format(z="inf", face="f 1 2 3\n"), "vertices that are not finite"),
        ("a.ply", ASCII.format(z="0", face="3 0 1 7\n"), "names vertex 7; allowed: 0 to 2"),
        ("a.ply", ASCII.format(z="0", face="3 0 1 -1\n"), "names vertex -1; allowed: 0 to 2"),
        ("a.obj", OBJ.format(z="0", face="f 1 2 9\n"), "is no readable mesh"),
        ("a.obj", OBJ.format(z="0", face="f 0 1 2\n"), "names vertex 0; OBJ counts from 1"),
        ("a.obj", OBJ.format(z="0", face="f 1/1 2/2 0/3\n"), "names vertex 0; OBJ counts from 1"),
        ("a.obj", OBJ.format(z="0", face=""), "has no triangles"),
        ("a.ply", ASCII.replace("face 1\n", "face 0\n").format(z="0", face=""), "has no triangles"),
        (
            "a.ply",
            ASCII.replace("face 1\n", "face 2\n").format(z="0", face="3 0 1 2\n"),
            "declares 2 faces and holds 1",
        ),
        ("a.ply", "hello", "is no readable mesh (Not a ply file!)"),
        ("a.ply", "", "is no readable mesh"),
        ("a.obj", OBJ.format(z="0", face="f 1 2 2\n"), "only triangles of zero area"),
    ],
)
def test_bad_meshes(tmp_path: Path, name: str, text: str, piece: str) -> None:
    (tmp_path / name).write_text(text)
    path = write(tmp_path, f"{HEAD}  - {{type: mesh, file: {name}, material: white, emission: 1}}\n")
    found = message(path)
    assert found.startswith(f"{path}:{SHAPE_LINE}: shapes[1].file: {tmp_path / name} ") and piece in found, found
    assert ("caustics of point lights" in found) == ("zero area" in found)


def test_binary_mesh_cut_short(tmp_path: Path) -> None:
    whole = (ROOT / "scenes" / "meshes" / "ring.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(whole[:-100])
    path = write(tmp_path, f"{HEAD}  - {{type: mesh, file: a.ply, material: white}}\n")
    assert "is no readable mesh" in message(path)


def test_random_corruptions_load_or_say_why(tmp_path: Path) -> None:
    rng = random.Random(20240502)
    whole = HEAD + "  - {type: sphere, center: [1, 2, 3], radius: 0.5, material: glass}\n"
    whole += "  - {type: box, min: [0, 0, 0], max: [1, 1, 1], material: white, emission: 2}\n"
    refused = 0
    for _ in range(300):
        text = list(whole)
        for _ in range(rng.randint(1, 3)):
            at = rng.randrange(len(text))
            text[at : at + rng.choice([0, 1, 1, 5])] = rng.choice(
                list("{}[]:,-&*!%@\"'#\t\n 0159.") + ["é", "1e39", "-1"]
            )
        path = write(tmp_path, "".join(text))
        try:
            scene = load_scene(path)
        except InputError as error:
            refused += 1
            assert "\n" not in str(error) and str(error).startswith(str(path))
        else:
            assert np.isfinite(scene.vertices).all() and np.isfinite(scene.spheres).all()
    assert 50 < refused < 300
