"""Meshes that the program makes itself: closed, outward, the same everywhere, and made once."""

import functools
import hashlib
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from mpi_tools import ROOT

from causticmpi.cli.main import main
from causticmpi.errors import InputError
from causticmpi.scene.generated import catalogue, dragon, horse
from causticmpi.scene.generated.implicit import Bead, Field, sheet, spline, tube, union
from causticmpi.scene.generated.polygonise import evaluate, polygonise
from causticmpi.scene.generated.tin import lid, tin
from causticmpi.scene.load import load_scene

COARSE = {
    "horse": functools.partial(horse.horse, 0.04),
    "dragon": functools.partial(dragon.dragon, 0.04),
    "tin": functools.partial(tin, 2),
    "lid": functools.partial(lid, 2),
}
Arrays = tuple[np.ndarray, np.ndarray]


@functools.cache
def coarse(name: str) -> Arrays:
    return COARSE[name]()


def assert_closed(triangles: np.ndarray) -> None:
    """Every edge has two triangles, which run along it in opposite directions."""
    start = triangles.astype(np.int64).ravel()
    end = np.roll(triangles, -1, axis=1).astype(np.int64).ravel()
    edges, back = np.sort(start * len(start) + end), np.sort(end * len(start) + start)
    assert (np.diff(edges) > 0).all()
    assert np.array_equal(edges, back)


def volume(vertices: np.ndarray, triangles: np.ndarray) -> float:
    """Positive where normals point outward."""
    a, b, c = (vertices[triangles[:, i]].astype(np.float64) for i in range(3))
    return float((a * np.cross(b, c)).sum() / 6.0)


def ball(centre: Bead) -> Field:
    return tube([centre, (centre[0] + 1e-9, *centre[1:])])


@pytest.mark.parametrize("name", list(COARSE))
def test_closed_and_outward(name: str) -> None:
    vertices, triangles = coarse(name)
    assert vertices.dtype == np.float32 and triangles.dtype == np.int32
    assert_closed(triangles)
    assert np.array_equal(np.unique(triangles), np.arange(len(vertices)))
    # In its own units a horse holds 0.17, a dragon 0.21, a tin about pi 2.4, a lid about pi 0.5.
    expected = {"horse": 0.17, "dragon": 0.21, "tin": 7.2, "lid": 1.6}[name]
    assert volume(vertices, triangles) == pytest.approx(expected, rel=0.15)
    assert vertices[:, 1].min() >= -1e-6


@pytest.mark.parametrize(("name", "field"), [("horse", horse.field()), ("dragon", dragon.field())])
def test_normals_follow_the_field(name: str, field: Field) -> None:
    """A step along a triangle's normal leads out of the solid, a step against it leads in."""
    vertices, triangles = coarse(name)
    a, b, c = (vertices[triangles[:, i]].astype(np.float64) for i in range(3))
    cross = np.cross(b - a, c - a)
    normal = cross / np.linalg.norm(cross, axis=1)[:, None]
    out, back = (evaluate(field, (a + b + c) / 3 + side * 0.01 * normal) for side in (1.0, -1.0))
    assert (out > back).mean() > 0.95  # but for wings and tips, thinner than these triangles are wide


def test_a_ball_is_round() -> None:
    vertices, triangles = polygonise(ball((0.1, 0.2, 0.3, 0.5)), (-1, -1, -1), 2.2, 0.1)
    assert_closed(triangles)
    np.testing.assert_allclose(np.linalg.norm(vertices - [0.1, 0.2, 0.3], axis=1), 0.5, atol=1e-4)
    assert volume(vertices, triangles) == pytest.approx(4 / 3 * np.pi * 0.125, rel=0.01)
    corners = vertices[triangles]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    assert (area / longest**2).min() > 0.1  # 0.43 if equilateral: no slivers, whose flat normals would be far off


def test_fields_are_distances() -> None:
    points = np.array([[0.5, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.25, 0.25, -0.5], [3.0, 0.0, 0.0]])
    rod = tube([(0.0, 0.0, 0.0, 0.2), (1.0, 0.0, 0.0, 0.2)])
    np.testing.assert_allclose(rod(points), [0.8, 0.8, np.sqrt(0.3125) - 0.2, 1.8])
    skin = sheet((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), 0.1)
    np.testing.assert_allclose(skin(points), [np.sqrt(0.125) - 0.1, 0.9, 0.4, 1.9])
    # Farther apart than the fillet is wide, the union is the lesser of both; where they meet, it is filled.
    assert union([(rod, 0.1), (skin, 0.1)])(np.array([[0.5, -1.0, 0.0]])) == pytest.approx(0.8)
    np.testing.assert_allclose(union([(rod, 0.1), (rod, 0.1)])(points), rod(points) - 0.1 / 4)


def test_capsules_are_those_of_a_plain_sum_to_the_last_bit() -> None:
    chance = np.random.default_rng(8)
    points, flat = chance.uniform(-1, 1, (1000, 3)), 0.3
    beads: list[Bead] = [tuple(row) for row in chance.uniform(0.1, 1, (5, 4)).tolist()]  # type: ignore[misc]
    x, y, z = points[:, 0], points[:, 1], points[:, 2] / flat
    nearest = np.full(len(points), np.inf)
    for (ax, ay, az, r), (bx, by, bz, s) in zip(beads[:-1], beads[1:], strict=True):
        ux, uy, uz = bx - ax, by - ay, (bz - az) / flat
        px, py, pz = x - ax, y - ay, z - az / flat
        along = np.clip((px * ux + py * uy + pz * uz) / (ux * ux + uy * uy + uz * uz), 0.0, 1.0)
        px, py, pz = px - along * ux, py - along * uy, pz - along * uz
        nearest = np.minimum(nearest, np.sqrt(px * px + py * py + pz * pz) - (r + along * (s - r)))
    assert tube(beads, flat)(points).tobytes() == (nearest * flat).tobytes()


def test_a_spline_runs_through_its_beads() -> None:
    beads: list[Bead] = [(0, 0, 0, 1), (1, 2, 0, 0.5), (3, 1, 1, 0.2), (4, 0, 0, 0.1)]
    curve = spline(beads, 5)
    assert len(curve) == 16
    np.testing.assert_allclose(curve[::5], beads, atol=1e-12)


def digest(mesh: Arrays) -> str:
    """Of coordinates to four digits and of the triangles, in little-endian bytes."""
    vertices, triangles = mesh
    rounded = np.round(vertices.astype(np.float64) * 1e4).astype("<i4")
    return hashlib.sha256(rounded.tobytes() + triangles.astype("<i4").tobytes()).hexdigest()[:16]


@pytest.mark.parametrize("name", list(COARSE))
def test_the_same_mesh_everywhere(name: str) -> None:
    again = COARSE[name]()
    assert again[0].tobytes() == coarse(name)[0].tobytes() and again[1].tobytes() == coarse(name)[1].tobytes()
    assert digest(again) == GOLDEN[name]


GOLDEN = {
    "horse": "cc099d077f7bfbc6",
    "dragon": "92d3e17e7cc33f6a",
    "tin": "0c8dd46e3ec892f9",
    "lid": "5760a14eedb72c93",
}


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache, and meshes that are made in no time."""
    monkeypatch.setenv("CAUSTICMPI_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(catalogue, "MESHES", dict(COARSE))
    return tmp_path / "cache"


def make_tin(capsys: pytest.CaptureFixture[str]) -> tuple[Arrays, str]:
    mesh = catalogue.generated_mesh("tin")
    assert all(found.tobytes() == made.tobytes() for found, made in zip(mesh, coarse("tin"), strict=True))
    return mesh, capsys.readouterr().err


def test_made_once(cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = make_tin(capsys)[1]
    assert said == "causticmpi: making the mesh tin, which takes some seconds once\n"
    assert [path.suffix for path in cache.iterdir() if path.is_file()] == [".npz"]
    assert make_tin(capsys)[1] == ""


@pytest.mark.parametrize("damage", ["cut", "empty", "flipped", "text"])
def test_a_damaged_cache_file_is_made_anew(cache: Path, capsys: pytest.CaptureFixture[str], damage: str) -> None:
    make_tin(capsys)
    (path,) = cache.glob("mesh-tin-*.npz")
    whole = path.read_bytes()
    middle = len(whole) // 2
    flipped = whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :]
    path.write_bytes({"cut": whole[:middle], "empty": b"", "flipped": flipped, "text": b"hello"}[damage])
    assert make_tin(capsys)[1] != ""
    assert path.read_bytes() == whole and make_tin(capsys)[1] == ""


def test_a_cache_that_cannot_be_written_to(
    cache: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    make_tin(capsys)
    (path,) = cache.glob("mesh-tin-*.npz")
    path.unlink()

    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "replace", refuse)
    assert make_tin(capsys)[1].count("\n") == 1
    assert [path for path in cache.iterdir() if path.is_file()] == []  # no temporary file left


SCENE = """\
camera: {eye: [0, 0, 4], target: [0, 0, 0]}
materials: {white: {type: diffuse, reflectance: 0.5}}
shapes:
  - {type: quad, corners: [[0, 0, 0], [1, 0, 0], [1, 2, 0], [0, 2, 0]], material: white, emission: 1}
  - SHAPE
"""


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ("generate: hrose", ['shapes[1].generate: found "hrose"', "horse, dragon, tin, lid", 'did you mean "horse"?']),
        ("generate: tin, file: a.ply", ["shapes[1].generate: found beside a file", "one of the two"]),
        ("scale: 2", ['shapes[1]: missing key "file"', "generate: horse"]),
    ],
)
def test_what_is_wrong_is_told(cache: Path, tmp_path: Path, keys: str, words: list[str]) -> None:
    path = tmp_path / "s.yaml"
    path.write_text(SCENE.replace("SHAPE", f"{{type: mesh, {keys}, material: white}}"))
    with pytest.raises(InputError) as raised:
        load_scene(path)
    text = str(raised.value)
    assert text.startswith(f"{path}:5: ") and "\n" not in text
    for word in words:
        assert word in text, text


def test_a_mesh_of_ones_own_in_its_place(cache: Path, tmp_path: Path) -> None:
    """The hash follows the triangles, wherever they come from."""
    vertices, triangles = coarse("lid")
    trimesh.Trimesh(vertices, triangles, process=False).export(tmp_path / "mine.ply")
    path, place = tmp_path / "s.yaml", "scale: 0.5, rotate: [0, 40, 0], translate: [1, 2, 3], material: white"
    scenes = []
    for source in ("generate: lid", "generate: lid", "file: mine.ply", "generate: tin"):
        path.write_text(SCENE.replace("SHAPE", f"{{type: mesh, {source}, {place}}}"))
        scenes.append(load_scene(path))
    made, kept, mine, other = scenes
    assert made.content_hash == kept.content_hash == mine.content_hash != other.content_hash
    assert len(made.triangles) == len(triangles) + 2


def test_the_figurines_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """At full detail: several hundred thousand triangles, each figurine in one piece."""
    monkeypatch.setenv("CAUSTICMPI_CACHE", str(tmp_path))
    assert main(["check", str(ROOT / "configs" / "figurines.yaml"), "--set", f"output.directory={tmp_path}/out"]) == 0
    assert "iws+cf" in capsys.readouterr().out
    for name, least in (("horse", 150_000), ("dragon", 250_000), ("tin", 100_000)):
        vertices, triangles = catalogue.generated_mesh(name)
        assert len(triangles) > least
        assert_closed(triangles)
        assert trimesh.Trimesh(vertices, triangles, process=False).body_count == 1
    assert capsys.readouterr().err == ""
