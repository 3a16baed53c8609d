"""Warnings before the budget is spent: each appears where it is due, none on the scenes that come along."""

from pathlib import Path

import pytest
import yaml
from rendering import REPOSITORY, make_config, prepare, scene_from

from causticmpi.cli.main import main
from causticmpi.config.load import load_config, scene_path
from causticmpi.distributed.clock import Stopwatch
from causticmpi.distributed.prepare import prepare_forecast
from causticmpi.distributed.world import SerialWorld
from causticmpi.render.foresight import of_photons, of_scene, smallest_light
from causticmpi.scene.content import extent
from causticmpi.scene.load import load_scene
from causticmpi.stability.scenes import build

CONFIGS = sorted((REPOSITORY / "configs").glob("*.yaml"))
ROOM = """
camera: {eye: [0, 0, 3], target: [0, 0, 0], up: [0, 1, 0], fov: 40}
materials:
  white: {type: diffuse, reflectance: 0.7}
  glass: {type: dielectric, ior: 1.5}
  mirror: {type: mirror, reflectance: 0.9}
  gloss: {type: phong, diffuse: 0.2, specular: 0.5, exponent: EXPONENT}
shapes:
  - {type: quad, corners: [[-1, -1, 1], [1, -1, 1], [1, -1, -1], [-1, -1, -1]], material: FLOOR}
  - {type: quad, corners: [[-1, -1, -1], [-1, 1, -1], [1, 1, -1], [1, -1, -1]], material: BACK}
  - {type: quad, corners: [[-1, -1, 1], [-1, 1, 1], [1, 1, 1], [1, -1, 1]], material: FRONT}
  - {type: quad, corners: [[LOW, 0.9, LOW], [HIGH, 0.9, LOW], [HIGH, 0.9, HIGH], [LOW, 0.9, HIGH]], material: white,
     emission: 5}
  - {type: sphere, center: [0, -0.5, 0], radius: 0.3, material: glass}
"""


def room(folder: Path, light: float = 0.5, **more: str):
    text = ROOM.replace("LOW", str(-light / 2)).replace("HIGH", str(light / 2))
    for name, value in {"EXPONENT": "10", "FLOOR": "white", "BACK": "white", "FRONT": "white", **more}.items():
        text = text.replace(name, value)
    return scene_from(text, folder)


@pytest.mark.parametrize("setting", ["forecast.sampling=two", "forecast.sampling=mixture", "method=pt", "method=iws"])
@pytest.mark.parametrize("file", CONFIGS, ids=lambda file: file.stem)
def test_none_on_the_scenes_that_come_along(file: Path, setting: str) -> None:
    config = load_config(file, [setting])
    assert of_scene(config, load_scene(scene_path(file, config))) == ()


@pytest.mark.parametrize(
    ("light", "settings", "words"),
    [
        (0.005, {"method": "pt"}, "by chance, once in"),
        (0.02, {"method": "iws+cf", "forecast": {"sampling": "two"}}, "a bin of forecast.table 32 x 16 is"),
        (0.001, {"method": "iws+cf", "forecast": {"sampling": "mixture"}}, "nearly a point"),
        (0.5, {"method": "iws+cf", "forecast": {"photons": 0}}, "forecast.photons is 0"),
        (0.5, {"method": "iws+cf", "forecast": {"photons": 100, "clusters": 64}}, "100 photons for 64 clusters"),
    ],
)
def test_lights_and_settings(tmp_path: Path, light: float, settings: dict, words: str) -> None:
    (warning,) = of_scene(make_config(**settings), room(tmp_path, light))
    assert words in warning
    assert of_scene(make_config(method=settings["method"]), room(tmp_path, 0.5)) == ()


def test_gloss_too_sharp_for_virtual_lights(tmp_path: Path) -> None:
    sharp = room(tmp_path, FLOOR="gloss", EXPONENT="30000")
    (warning,) = of_scene(make_config(method="iws"), sharp)
    assert "a Phong exponent of 3e+04 is too sharp" in warning
    assert of_scene(make_config(method="pt"), sharp) == ()
    assert of_scene(make_config(method="iws"), room(tmp_path, FLOOR="gloss", EXPONENT="100")) == ()
    assert of_scene(make_config(method="iws"), room(tmp_path, EXPONENT="30000")) == ()  # used by no shape


def test_facing_mirrors(tmp_path: Path) -> None:
    (warning,) = of_scene(make_config(method="pt"), room(tmp_path, BACK="mirror", FRONT="mirror"))
    assert "mirrors of reflectance 0.9 face each other: paths between them take some 10 bounces" in warning
    assert of_scene(make_config(method="pt"), room(tmp_path, BACK="mirror", FLOOR="mirror")) == ()


def test_photons() -> None:
    assert of_photons(1000, 1000, 5000) == ()
    assert "no photon of 4000 reached" in of_photons(0, 10, 4000)[0]
    assert "starved: 5 of 10" in of_photons(5, 10, 4000)[0]
    assert "one particle in 300" in of_photons(10, 10, 3000)[0]


def test_a_forecast_warns_of_an_unlit_specular_object(tmp_path: Path) -> None:
    """The glass stands in a closed box: no particle gets there."""
    box = "  - {type: box, min: [-0.4, -0.9, -0.4], max: [0.4, -0.1, 0.4], material: white}\n"
    scene = scene_from(
        ROOM.replace("LOW", "-0.2").replace("HIGH", "0.2").replace("EXPONENT", "10")
        .replace("FLOOR", "white").replace("BACK", "white").replace("FRONT", "white") + box,
        tmp_path,
    )  # fmt: skip
    config = make_config(method="iws+cf", forecast={"photons": 20, "clusters": 2})
    made = prepare_forecast(SerialWorld(), config, prepare(scene), Stopwatch())
    assert len(made.warnings) == 1 and "no photon of 8000 reached" in made.warnings[0]


def test_a_light_is_what_hangs_together(tmp_path: Path) -> None:
    scene = room(tmp_path, 0.1)
    assert smallest_light(scene) == pytest.approx(0.01)
    assert extent(scene) == pytest.approx((2**2 + 2**2 + 2**2) ** 0.5)


def test_far_from_the_origin(tmp_path: Path) -> None:
    far, near = (
        scene_from(text, tmp_path)
        for text in (
            yaml.safe_dump(build("box", {"offset": offset}), sort_keys=False) for offset in (100_000, 10_000)
        )
    )  # fmt: skip
    (warning,) = of_scene(make_config(method="iws+cf"), far)
    assert "from the origin" in warning and "the picture will be wrong" in warning
    assert of_scene(make_config(method="iws+cf"), near) == ()


def test_check_tells(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(CONFIGS[0]), "--set", "forecast.photons=0"]) == 0
    assert "warning  forecast.photons is 0" in capsys.readouterr().out
