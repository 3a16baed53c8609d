"""The pilot: what it chooses on given figures, on scenes that are plain cases, and at any number of ranks."""

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
from causticmpi.preprocess.lamp_sight import seen_in_passing
from causticmpi.render import pilot
from causticmpi.scene.load import load_scene
from causticmpi.scene.tracing import camera_array
from causticmpi.stability.scenes import build, write_scene

SLOTS, BLOCKS = 64, (4, 4)
SIGHT = seen_in_passing()._replace(side=2)


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


def looks(grid: float, power: float = 2.0, rays: float = 1.0) -> pilot.LampTrial:
    """Looks for lamps, of so many rays: variance of a pass by the grid, and by what power of its side it is below that
    of single ones."""
    n = pilot.PASSES

    def lamps(variance: float, count: int) -> pilot.LampPasses:
        swing = np.sqrt(variance * (n - 1) / n) * np.tile([-1.0, 1.0], n // 2)
        return pilot.LampPasses(np.broadcast_to(swing[:, None, None], (n, SLOTS, 3)), count * rays)

    return pilot.LampTrial(lamps(grid, pilot.SIGHT_SIDE**2), lamps(grid * pilot.SIGHT_SIDE**power, 1))


NO_LAMPS = looks(0.0, rays=0.0)


def test_light_paths_where_error_times_cost_is_least() -> None:
    plain = trial(100.0, 0.0, 20.0, 0.0)
    plan = pilot.choose(trial(1.0, 4.0, 20.0, 5.0), plain, NO_LAMPS, 0.5, SIGHT, RELMSE_FLOOR)
    assert not plan.plain and plan.paths_per_pixel == pytest.approx(0.5 * 4.0)

    def score(more: float) -> float:
        return (1.0 + 4.0 / more) * (20.0 + 5.0 * more) / (1 + RELMSE_FLOOR)

    assert plan.forecast_score == pytest.approx(score(4.0))
    assert score(4.0) < min(score(3.0), score(5.0))
    hopeless = trial(1e12, 0.0, 20.0, 0.0)
    most = pilot.choose(trial(1.0, 1e9, 20.0, 5.0), hopeless, NO_LAMPS, 0.5, SIGHT, RELMSE_FLOOR)
    assert most.paths_per_pixel == pilot.MOST_PATHS
    assert pilot.choose(trial(1.0, 0.0, 20.0, 0.0), plain, NO_LAMPS, 0.0, SIGHT, RELMSE_FLOOR).paths_per_pixel == 0


def test_looks_for_lamps_where_error_times_cost_is_least() -> None:
    plain = trial(1e12, 0.0, 20.0, 0.0)
    for variance, side in ((0.2, 2), (1e-3, 0), (1e6, pilot.MOST_SIDE), (0.0, 2)):
        plan = pilot.choose(trial(1.0, 4.0, 20.0, 5.0), plain, looks(variance), 0.5, SIGHT, RELMSE_FLOOR)
        assert plan.sight_side == side


def test_a_grid_of_another_side_is_foretold_from_two() -> None:
    rest = np.ones((SLOTS, 3))
    for power, taken in ((0.5, 2.0), (2.4, 2.4), (5.0, 3.0)):
        of = [looks(0.2, power).of(side, rest, RELMSE_FLOOR) for side in range(4)]
        expected = [(2 / max(1, side)) ** taken for side in range(4)]
        assert [error / of[2][0] for error, _ in of] == pytest.approx(expected, rel=0.03)
        assert [rays for _, rays in of] == pytest.approx([0, 1, 4, 9])
        assert of[2][0] == pytest.approx(0.2 / (1 + RELMSE_FLOOR), rel=0.05)


def test_where_images_are_known_a_grid_shares_them() -> None:
    """Lamps seen in passing would have no part in the looks at images, however little those leave to be found."""
    images = SIGHT._replace(first=np.zeros(2, np.int32))
    quiet, noisy = trial(1.0, 0.0, 20.0, 0.0), trial(1e12, 0.0, 20.0, 0.0)
    for forecast, plain in ((quiet, noisy), (noisy, quiet)):
        assert pilot.choose(forecast, plain, looks(1e-3), 0.5, SIGHT, RELMSE_FLOOR).sight_side == 0
        assert pilot.choose(forecast, plain, looks(1e-3), 0.5, images, RELMSE_FLOOR).sight_side == 1


def test_a_glint_met_once_is_no_bright_pixel() -> None:
    """Its error is relative to what the other passes saw; that of a pixel which is bright, to its brightness."""
    passes = np.zeros((pilot.PASSES, 2, 3), np.float32)
    passes[3, 0] = 160.0
    passes[:, 1] = 80.0 + np.tile([-1.0, 1.0], pilot.PASSES // 2)[:, None]
    glint, lamp = (pilot.LampPasses(passes[:, i : i + 1], 1.0).errors(np.full((1, 3), 0.5), 0.01)[0] for i in (0, 1))
    variance = passes.astype(np.float64).var(axis=0, ddof=1)[:, 0]
    others = 160 / (pilot.PASSES - 1)
    quiet = (pilot.PASSES - 1) * others**2 / ((0.5 + others) ** 2 + 0.01) * (pilot.PASSES - 1) / pilot.PASSES
    assert glint == pytest.approx((160**2 * (pilot.PASSES - 1) / pilot.PASSES / 0.26 + quiet) / pilot.PASSES, rel=1e-5)
    assert glint > 0.9 * variance[0] * (pilot.PASSES - 1) / pilot.PASSES / 0.26
    assert lamp == pytest.approx(variance[1] / (80.5**2 + 0.01), rel=0.01)


def test_plain_sampling_is_chosen_where_it_pays_and_sees() -> None:
    forecast = trial(1.0, 1.0, 20.0, 20.0)
    assert pilot.choose(forecast, trial(1.0, 0.0, 20.0, 0.0), NO_LAMPS, 1.0, SIGHT, RELMSE_FLOOR).plain
    assert not pilot.choose(forecast, trial(3.5, 0.0, 20.0, 0.0), NO_LAMPS, 1.0, SIGHT, RELMSE_FLOOR).plain
    caustic = np.stack([np.full(BLOCKS, 1.0), np.full(BLOCKS, 0.01)])
    caustic[0, 1, 2] = 0.9  # one block is darker by 10 of its standard deviations
    assert not pilot.choose(forecast, trial(1.0, 0.0, 20.0, 0.0, caustic), NO_LAMPS, 1.0, SIGHT, RELMSE_FLOOR).plain
    caustic[0, 1, 2] = 1.1  # brighter is no sign of blindness
    assert pilot.choose(forecast, trial(1.0, 0.0, 20.0, 0.0, caustic), NO_LAMPS, 1.0, SIGHT, RELMSE_FLOOR).plain
    caustic[1] = 8.0  # the whole is not known to a tenth
    assert not pilot.choose(forecast, trial(1.0, 0.0, 20.0, 0.0, caustic), NO_LAMPS, 1.0, SIGHT, RELMSE_FLOOR).plain


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
