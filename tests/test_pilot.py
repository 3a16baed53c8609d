"""The pilot: what it chooses on given figures, on scenes that are plain cases, and at any number of ranks."""

import math
from pathlib import Path

import numpy as np
import pytest
from program_tools import CORNELL

from causticmpi.config.load import load_config
from causticmpi.config.records import Film, RenderConfig
from causticmpi.distributed.clock import Stopwatch
from causticmpi.distributed.prepare import prepare_method, share_scene
from causticmpi.distributed.world import SerialWorld
from causticmpi.output.picture import RELMSE_FLOOR
from causticmpi.render import pilot
from causticmpi.render.looks import MOST_LOOKS, SIGHT_SIDE, LampPasses, LampTrial
from causticmpi.scene.load import load_scene
from causticmpi.scene.tracing import camera_array
from causticmpi.stability.scenes import build, write_scene

SLOTS, BLOCKS = 64, (4, 4)


def trial(
    eye: float,
    light: float,
    eye_rays: float,
    light_rays: float,
    caustic: np.ndarray | None = None,
) -> pilot.Trial:
    """Of given variance per pass, mean 1; caustic: (2, 4, 4) mean and standard deviation of L_c in each block."""
    n = pilot.PASSES
    none = np.zeros((SLOTS, 3))

    def part(mean: float, variance: float, rays: float) -> pilot.Part:
        return pilot.Part(none + n * mean, none + n * mean**2 + variance * (n - 1), rays)

    mean, deviation = np.stack([np.full(BLOCKS, 1.0), np.full(BLOCKS, 0.01)]) if caustic is None else caustic
    return pilot.Trial(
        part(1.0, eye, eye_rays), part(0.0, light, light_rays),
        n * mean, n * (mean**2 + deviation**2),
    )  # fmt: skip


def looks(grid: float, power: float = 2.0, least: int = 0, each: float = 1.0) -> LampTrial:
    """Looks for lamps of mean 0, met in every pass: variance of a pass by the grid, by what power of its side it is
    below that of single ones, and rays of a look for a pixel."""

    def lamps(variance: float, count: int) -> LampPasses:
        none = np.zeros((SLOTS, 3))
        return LampPasses(none, none + variance, np.full(SLOTS, pilot.PASSES), count * each)

    single, whole = lamps(grid * SIGHT_SIDE**power, 1), np.ones(SLOTS, np.bool_)
    return LampTrial((8, 8), lamps(grid, SIGHT_SIDE**2), single, single, whole, np.full(SLOTS, least, np.uint8))


NO_LAMPS = looks(0.0, each=0.0)


def test_light_paths_where_error_times_cost_is_least() -> None:
    plain = trial(100.0, 0.0, 20.0, 0.0)
    plan = pilot.choose(trial(1.0, 4.0, 20.0, 5.0), plain, NO_LAMPS, 0.5, RELMSE_FLOOR)
    assert not plan.plain and plan.paths_per_pixel == pytest.approx(0.5 * 4.0)

    def score(more: float) -> float:
        return (1.0 + 4.0 / more) * (20.0 + 5.0 * more) / (1 + RELMSE_FLOOR)

    assert plan.forecast_score == pytest.approx(score(4.0))
    assert score(4.0) < min(score(3.0), score(5.0))
    hopeless = trial(1e12, 0.0, 20.0, 0.0)
    most = pilot.choose(trial(1.0, 1e9, 20.0, 5.0), hopeless, NO_LAMPS, 0.5, RELMSE_FLOOR)
    assert most.paths_per_pixel == pilot.MOST_PATHS
    assert pilot.choose(trial(1.0, 0.0, 20.0, 0.0), plain, NO_LAMPS, 0.0, RELMSE_FLOOR).paths_per_pixel == 0


def test_looks_for_lamps_where_error_times_cost_is_least() -> None:
    plain = trial(1e12, 0.0, 20.0, 0.0)
    for variance, side in ((0.2, 2), (1e-3, 0), (1e6, math.isqrt(MOST_LOOKS)), (0.0, 0)):
        plan = pilot.choose(trial(1.0, 4.0, 20.0, 5.0), plain, looks(variance), 0.5, RELMSE_FLOOR)
        assert (plan.sides == side).all(), (variance, plan.sides)


def test_a_grid_of_another_side_is_foretold_from_two() -> None:
    rest = np.ones((SLOTS, 3))
    for power, taken in ((0.5, 2.0), (2.4, 2.4), (5.0, 3.0)):
        needs = looks(0.2, power).needs(rest, RELMSE_FLOOR)
        sides = [np.full(SLOTS, side, np.uint8) for side in range(4)]
        expected = [0.2 / (1 + RELMSE_FLOOR) * (2 / max(1, side)) ** taken for side in range(4)]
        assert [needs.error(side) for side in sides] == pytest.approx(expected)
        assert [needs.rays(side) for side in sides] == pytest.approx([0, 1, 4, 9])


def test_where_images_are_known_a_grid_shares_them() -> None:
    """Lamps seen in passing would have no part in the looks at images, however little those leave to be found."""
    quiet, noisy = trial(1.0, 0.0, 20.0, 0.0), trial(1e12, 0.0, 20.0, 0.0)
    for forecast, plain in ((quiet, noisy), (noisy, quiet)):
        for least in (0, 1):
            plan = pilot.choose(forecast, plain, looks(1e-3, least=least), 0.5, RELMSE_FLOOR)
            assert (plan.sides == least).all()


def test_plain_sampling_is_chosen_where_it_pays_and_sees() -> None:
    forecast = trial(1.0, 1.0, 20.0, 20.0)
    assert pilot.choose(forecast, trial(1.0, 0.0, 20.0, 0.0), NO_LAMPS, 1.0, RELMSE_FLOOR).plain
    assert not pilot.choose(forecast, trial(3.5, 0.0, 20.0, 0.0), NO_LAMPS, 1.0, RELMSE_FLOOR).plain
    caustic = np.stack([np.full(BLOCKS, 1.0), np.full(BLOCKS, 0.01)])
    caustic[0, 1, 2] = 0.9  # one block is darker by 10 of its standard deviations
    assert not pilot.choose(forecast, trial(1.0, 0.0, 20.0, 0.0, caustic), NO_LAMPS, 1.0, RELMSE_FLOOR).plain
    caustic[0, 1, 2] = 1.1  # brighter is no sign of blindness
    assert pilot.choose(forecast, trial(1.0, 0.0, 20.0, 0.0, caustic), NO_LAMPS, 1.0, RELMSE_FLOOR).plain
    caustic[1] = 8.0  # the whole is not known to a tenth
    assert not pilot.choose(forecast, trial(1.0, 0.0, 20.0, 0.0, caustic), NO_LAMPS, 1.0, RELMSE_FLOOR).plain


def config_of(scene: Path, *settings: str) -> RenderConfig:
    return load_config(CORNELL, [f"scene={scene}", "forecast.photons=20000", *settings])


def plan_of(config: RenderConfig) -> pilot.Plan | None:
    world = SerialWorld()
    scene = share_scene(world, load_scene(Path(config.scene)))
    camera = camera_array(scene.data.camera, config.film.width, config.film.height)
    method, made = prepare_method(world, config, scene, camera, Stopwatch())
    if made.plan is not None and made.plan.plain:
        assert method.light_paths == 0 and made.maps.codebook.shape[1] == 0
    return made.plan


def test_a_light_too_small_for_plain_sampling(tmp_path: Path) -> None:
    """Plain sampling never meets it, and so shows hardly any variance: it must not be believed."""
    scene = write_scene(build("box", {"light": 0.02}), tmp_path / "small.yaml")
    plan = plan_of(config_of(scene, "film.width=64", "film.height=64"))
    assert plan is not None and not plan.plain and plan.paths_per_pixel > 0
    assert plan_of(config_of(scene, "film.width=64", "film.height=64")) == plan


def test_a_light_so_large_that_the_forecast_does_not_pay(tmp_path: Path) -> None:
    scene = write_scene(build("box", {"light": 1.9}), tmp_path / "large.yaml")
    settings = "film.width=64", "film.height=64", "forecast.light_tracing=false", "forecast.splitting=4"
    plan = plan_of(config_of(scene, *settings))
    assert plan is not None and plan.plain


def test_nothing_to_choose() -> None:
    scene = CORNELL.parent / load_config(CORNELL, []).scene
    for settings in (["forecast.pilot=false"], ["forecast.sampling=two"], ["method=iws"]):
        assert plan_of(config_of(scene.resolve(), "film.width=32", "film.height=32", *settings)) is None


def test_the_small_picture_has_the_shape_of_the_large_one() -> None:
    small = pilot.small_film(Film(width=1280, height=720))
    assert small.width * small.height <= pilot.PIXELS and small.width / small.height == pytest.approx(16 / 9, rel=0.02)
    assert pilot.small_film(Film(width=20, height=10)) == Film(width=20, height=10)
