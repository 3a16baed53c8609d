"""`causticmpi inspect`: its numbers are the library's, its points are drawn where the eye sees them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi_tools import require_mpi, run_mpi
from PIL import Image
from program_tools import CORNELL, main, tree
from rendering import make_config, prepare, scene_from

from causticmpi.config.load import load_config, scene_path
from causticmpi.config.records import RenderConfig
from causticmpi.distributed.begin import sound_scene
from causticmpi.distributed.clock import Stopwatch
from causticmpi.estimators.virtual_lights import empty_virtual_lights, trace_virtual_lights
from causticmpi.inspect.figures import BLACK, MUSTARD, WHITE, cluster_colours
from causticmpi.inspect.findings import Findings, find
from causticmpi.inspect.run import CLUSTERS, NUMBERS, SHOOTING
from causticmpi.inspect.scenery import Discs, Scenery
from causticmpi.inspect.sight import Sight
from causticmpi.kernels.embree import ray_buffer
from causticmpi.kernels.emission import natural_emission
from causticmpi.preprocess.packed_photons import unpacked_photons
from causticmpi.preprocess.parallax import HEIGHT
from causticmpi.preprocess.photons import shoot_photons
from causticmpi.scene.data import SceneData
from causticmpi.scene.load import load_scene
from causticmpi.scene.tracing import camera_array

SMALL = ["film.width=96", "film.height=96", "forecast.photons=3000", "forecast.clusters=24", "forecast.max_rank=2"]
SETTINGS = [word for setting in SMALL for word in ("--set", setting)]

# A wall at z = 0 with a hole in the eye's way to the right half of the wall behind it, at z = -2.
WALLS = """\
camera: {eye: [0, 0, 4], target: [0, 0, 0], fov: 40}
materials:
  white: {type: diffuse, reflectance: 0.5}
  glass: {type: dielectric, ior: 1.000001}
  mirror: {type: mirror, reflectance: 1}
shapes:
  - {type: quad, corners: [[-2, -2, 0], [0, -2, 0], [0, 2, 0], [-2, 2, 0]], material: white}
  - {type: quad, corners: [[-4, -4, -2], [4, -4, -2], [4, 4, -2], [-4, 4, -2]], material: white}
  - {type: quad, corners: [[-1, -1, 6], [-1, 1, 6], [1, 1, 6], [1, -1, 6]], material: white, emission: 1}
"""
PANE = "  - {type: box, min: [-4, -4, 1], max: [4, 4, 1.5], material: glass}\n"
MIRROR = "  - {type: quad, corners: [[1.3, -2, -1], [1.5, -2, -0.5], [1.5, 2, -0.5], [1.3, 2, -1]], material: mirror}\n"


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of a small inspection."""
    folder = tmp_path_factory.mktemp("inspect") / "some" / "out"
    assert main(["inspect", str(CORNELL), *SETTINGS, "--out", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def found() -> Findings:
    """What that inspection found."""
    config = load_config(CORNELL, SMALL)
    return find(config, sound_scene(config, scene_path(CORNELL, config)), Stopwatch())


def read_numbers(folder: Path) -> dict[str, Any]:
    return json.loads((folder / NUMBERS).read_text())


def test_what_it_leaves(out: Path) -> None:
    assert {path.name for path in out.iterdir()} == {SHOOTING, CLUSTERS, NUMBERS}
    for name in (SHOOTING, CLUSTERS):
        with Image.open(out / name) as picture:
            assert picture.format == "PNG" and "cornell" in picture.info["Description"]


def test_the_numbers_are_the_librarys(out: Path, found: Findings) -> None:
    told, config = read_numbers(out), load_config(CORNELL, SMALL)
    scene = load_scene(scene_path(CORNELL, config))
    assert (told["scene"]["triangles"], told["scene"]["spheres"]) == (len(scene.triangles), 2) == (12, 2)
    assert told["scene"]["content_hash"] == scene.content_hash
    assert told["scene"]["primitives_by_material"] == {"diffuse": 12, "phong": 0, "mirror": 1, "dielectric": 1}
    traced, paths = prepare(scene).traced, config.iws.paths
    points, emitted, _ = shoot_photons(traced, config.seed, 3000)
    assert (told["caustic_points"]["found"], told["caustic_points"]["particles"]) == (len(points.power), emitted)
    lights, kinds = empty_virtual_lights(1000), []
    for index in range(told["virtual_lights"]["passes"]):
        count, _ = trace_virtual_lights(traced, ray_buffer(), natural_emission(), config.seed, index, paths, lights)
        kinds += (lights.material[:count] < 0).tolist()
    assert told["virtual_lights"]["direct"] == sum(kinds) == told["virtual_lights"]["paths"]
    assert told["virtual_lights"]["indirect"] == len(kinds) - sum(kinds) > 0
    clusters, maps = told["clusters"], found.forecasting.maps
    assert clusters["count"] == maps.codebook.shape[1] == 24
    assert clusters["used"] + clusters["culled"] == 24 and clusters["used"] == (maps.rank <= 2).sum() < 24
    assert clusters["forecast_points"] == len(maps.x) and clusters["search_radius"] == maps.radius
    assert clusters["anchors"] == (maps.anchor_count > 0).sum() > 0
    photons = unpacked_photons(maps.anchor_photon)
    heights = [height for anchor in photons for height in anchor[HEIGHT].tolist() if height > 0]
    assert len(heights) == maps.anchor_count.sum()
    told_cones = [clusters["cone_half_angle"][key] for key in ("least", "median", "greatest")]
    wanted = np.degrees(2 * np.arcsin(np.sqrt(np.array([min(heights), np.median(heights), max(heights)]) / 2)))
    assert told_cones == pytest.approx(wanted.tolist(), rel=1e-6)


def test_the_clusters_add_up(out: Path, found: Findings) -> None:
    clusters = read_numbers(out)["clusters"]
    assert found.clusters is not None
    counted = np.bincount(found.clusters, minlength=24)
    assert clusters["each"]["caustic_points"] == counted.tolist() and counted.sum() == 3000
    luminance = found.points.power.astype(np.float64) @ [0.2126, 0.7152, 0.0722]
    energy = np.bincount(found.clusters, luminance, 24) / luminance.sum()
    assert clusters["each"]["energy"] == pytest.approx(energy.tolist(), rel=1e-9)
    rows = clusters["by_rank"]
    assert sum(row["clusters"] for row in rows) == 24 and sum(row["energy"] for row in rows) == pytest.approx(1)
    for row in rows:
        up_to = np.array(clusters["each"]["rank"]) <= row["rank"]
        assert row["energy_so_far"] == pytest.approx(energy[up_to].sum())
        assert row["energy_so_far"] > 1 - 0.5 ** (row["rank"] + 1) - 1e-9


def view(scene: SceneData, config: RenderConfig) -> Sight:
    window = config.film.crop or (0, 0, config.film.width, config.film.height)
    camera = camera_array(scene.camera, config.film.width, config.film.height)
    return Sight(prepare(scene).traced, camera, window, config.film.width)


PLACES = np.array([[-1, 0.5, 0], [-1, 0.5, -2], [1, 0.5, -2], [1, 0.5, 0.5], [0, 0, 9], [0, 9, -2]], float)
NAMES = ["on the wall", "behind the wall", "through the hole", "in mid air", "behind the eye", "outside the film"]
SEEN = [True, False, True, False, False, False]


@pytest.mark.parametrize("crop", [None, [20, 20, 160, 140]])
def test_a_hidden_point_is_not_seen(tmp_path: Path, crop: list[int] | None) -> None:
    config = make_config(film={"width": 160, "height": 140, "crop": crop})
    sight = view(scene_from(WALLS, tmp_path), config)
    towards = np.tile([0.0, 0.0, 1.0], (len(PLACES), 1))
    spots, seen = sight.spots(PLACES, towards)
    assert dict(zip(NAMES, seen.tolist(), strict=True)) == dict(zip(NAMES, SEEN, strict=True))
    assert not sight.spots(PLACES, -towards)[1].any()  # they lie on the far sides of the walls then
    scale = 70 / np.tan(np.radians(20))
    left, top = (crop or [0, 0])[:2]
    assert spots[0] == pytest.approx([80 - scale / 4 - left, 70 - scale * 0.5 / 4 - top], abs=1e-3)
    assert spots[2] == pytest.approx([80 + scale / 6 - left, 70 - scale * 0.5 / 6 - top], abs=1e-3)


def test_points_are_seen_through_glass_and_in_mirrors(tmp_path: Path) -> None:
    config = make_config(film={"width": 160, "height": 140})
    towards = np.tile([0.0, 0.0, 1.0], (len(PLACES), 1))
    straight, _ = view(scene_from(WALLS, tmp_path), config).spots(PLACES, towards)
    spots, seen = view(scene_from(WALLS + PANE, tmp_path), config).spots(PLACES, towards)
    assert seen.tolist() == SEEN  # glass without refraction: what was seen is seen through it, within a pixel
    assert np.abs(spots - straight)[seen].max() < 1.5
    mirrored = view(scene_from(WALLS + MIRROR, tmp_path), config)
    behind = np.random.default_rng(1).uniform([-1.5, -0.5, -2], [0, 0.5, -2], (500, 3))
    seen = mirrored.spots(behind, np.tile([0.0, 0.0, 1.0], (500, 1)))[1]
    assert 20 < seen.sum() < 450


def test_discs_have_their_colours_where_they_should(tmp_path: Path) -> None:
    path = tmp_path / "s.yaml"
    path.write_text(WALLS)
    config = make_config(film={"width": 480, "height": 420})
    found = find(config, sound_scene(config, path), Stopwatch())
    assert found.silence == "no surface of the scene is specular" and found.statistics is None
    scenery = Scenery(found)
    normals = np.tile([0.0, 0.0, 1.0], (3, 1))
    colours = np.array([MUSTARD, WHITE, BLACK], np.uint8)
    picture, counts = scenery.drawn(scenery.pale(), [Discs(PLACES[:3], normals, 3.0, colours)])
    assert counts == [2]
    spots, _ = scenery.sight.spots(PLACES[:3], normals)
    pale, drawn = np.asarray(scenery.pale()).astype(int), np.asarray(picture).astype(int)
    changed = np.abs(drawn - pale).sum(axis=2) > 0
    for i, colour in ((0, MUSTARD), (2, BLACK)):
        x, y = np.floor(spots[i]).astype(int)
        assert tuple(drawn[y, x]) == colour
        changed[y - 5 : y + 6, x - 5 : x + 6] = False
    assert not changed.any()


def test_figure_2_colours_the_clusters_up_to_the_rank(out: Path, found: Findings) -> None:
    with Image.open(out / CLUSTERS) as sheet:
        pixels = np.asarray(sheet.convert("RGB")).astype(int)
    half = pixels.shape[0] // 2, pixels.shape[1] // 2
    panels = [pixels[: half[0], : half[1]], pixels[: half[0], half[1] :], pixels[half[0] :, half[1] :]]
    saturated = [int((np.ptp(panel, axis=2) > 100).sum()) for panel in panels]
    assert 0 < saturated[0] < saturated[1] < saturated[2]
    assert found.statistics is not None
    colours = cluster_colours(24).astype(int)
    for panel, highest in zip(panels, (0, 2, 8), strict=True):
        present = [(np.abs(panel - colour).sum(axis=2) == 0).any() for colour in colours]
        culled = found.statistics.rank > highest
        assert not (np.array(present) & culled).any()
        assert np.array(present)[~culled].mean() > 0.8  # a cluster may lie where the eye does not look


def test_a_scene_without_specular_surfaces(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "s.yaml").write_text(WALLS)
    config, folder = tmp_path / "c.yaml", tmp_path / "out"
    config.write_text(f"scene: s.yaml\nfilm: {{width: 64, height: 48}}\noutput: {{directory: {folder}}}\n")
    folder.mkdir()
    (folder / "inspect").mkdir()
    (folder / "inspect" / CLUSTERS).write_text("of an earlier inspection")
    assert main(["inspect", str(config)]) == 0
    told = capfd.readouterr()
    assert "none to forecast: no surface of the scene is specular" in told.out and "6 triangles" in told.out
    assert {path.name for path in (folder / "inspect").iterdir()} == {SHOOTING, NUMBERS}
    numbers = read_numbers(folder / "inspect")
    assert numbers["silence"] and "clusters" not in numbers and numbers["caustic_points"]["found"] == 0


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["missing.yaml"], "missing.yaml"),
        ([str(CORNELL), "--set", "forecast.photon=1"], 'did you mean "photons"'),
        ([str(CORNELL), "--out", "FILE"], "it is a file"),
    ],
)
def test_bad_input_is_one_line(words: list[str], told: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("mine")
    before = tree(tmp_path)
    assert main(["inspect", *(word.replace("FILE", str(tmp_path / "file")) for word in words)]) == 2
    err = capfd.readouterr().err
    assert err.count("\n") == 1 and told in err, err
    assert tree(tmp_path) == before


@pytest.mark.mpi
def test_one_rank_is_enough(tmp_path: Path) -> None:
    require_mpi()
    done = run_mpi(2, ["-m", "causticmpi", "inspect", str(CORNELL), *SETTINGS, "--out", tmp_path / "out"], timeout=120)
    assert done.returncode == 0 and done.stdout.count("search radius") == 1, done.stderr
