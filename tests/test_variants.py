"""Every variant of the caustic estimator and of the clustering is unbiased: furnace, a rival method, lies."""

import numpy as np
import pytest
from rendering import render_passes, scene_from, total
from test_furnace import poisoned, room
from test_furnace import settings as furnace_settings
from test_unbiased import CASES, ROOM, layers, settings
from z_test import ALPHA, assert_equal_means, block_means, compare_with_truth, largest_share, relative_error

from causticmpi.config.records import RenderConfig
from causticmpi.preprocess.forecast import ForecastMaps
from causticmpi.scene.data import SceneData

pytestmark = pytest.mark.statistical
TABLES = ("one", "one-cosine", "one-smooth", "mis")
LARGEST_ERROR = 0.003
"""Relative standard error of the picture's mean: what a furnace must resolve."""


@pytest.fixture(scope="module")
def half_white(tmp_path_factory: pytest.TempPathFactory) -> SceneData:
    return scene_from(room(0.5), tmp_path_factory.mktemp("room"))


def furnace(**forecast: object) -> RenderConfig:
    return furnace_settings("iws+cf", forecast=forecast, side=8)


def check(scene: SceneData, config: RenderConfig, maps: ForecastMaps | None = None) -> None:
    """Radiance 2 in 4 x 4 blocks, or, where lies make the tails too heavy for a t-test of few passes, over all."""
    blocks = block_means(total(render_passes(scene, config, 2000, maps=maps))[..., :1], 2 if maps is None else 8)
    verdict = compare_with_truth(blocks, 2.0)
    print(f"\n{config.forecast.sampling}: {verdict}, relative error {relative_error(blocks):.2e}")
    assert relative_error(blocks) <= LARGEST_ERROR
    assert verdict.p > ALPHA


@pytest.mark.parametrize("sampling", TABLES)
def test_furnace(half_white: SceneData, sampling: str) -> None:
    check(half_white, furnace(sampling=sampling))


@pytest.mark.parametrize("sampling", TABLES)
@pytest.mark.parametrize("how", ["random directions", "no power"])
def test_lies(half_white: SceneData, sampling: str, how: str) -> None:
    config = furnace(sampling=sampling)
    check(half_white, config, poisoned(half_white, config, how))


def test_furnace_with_k_means(half_white: SceneData) -> None:
    check(half_white, furnace(clustering="kmeans"))


GLOSS = 20
"""Exponent of the gloss: a lobe as wide as the bins. Those of one filled table miss a narrower one (500: one pass of
4000 had a third of all L_c), and then no number of passes that a test can afford has a normal mean."""
LARGEST_SHARE = 0.05
"""Of one pass in the L_c of a colour. It is 2 % of the light here and comes in rare bright samples: only its mean over
the picture is tested, for in a quarter of it one pass had up to a quarter of the L_c."""


@pytest.fixture(scope="module")
def gloss(tmp_path_factory: pytest.TempPathFactory) -> tuple[SceneData, np.ndarray]:
    """A caustic on satin before gloss, and what path tracing makes of it."""
    (floor, back), shapes = CASES["gloss behind a caustic"]
    text = ROOM.replace("exponent: 500", f"exponent: {GLOSS}").replace("FLOOR", floor).replace("BACK", back)
    scene = scene_from(text + shapes, tmp_path_factory.mktemp("gloss"))
    return scene, layers(render_passes(scene, settings("pt", 2), 4000), 1)


@pytest.mark.parametrize("sampling", TABLES)
def test_gloss_behind_a_caustic(gloss: tuple[SceneData, np.ndarray], sampling: str) -> None:
    scene, truth = gloss
    found = layers(render_passes(scene, settings("iws+cf", 1, sampling), 4000), 1)
    assert largest_share(found) < LARGEST_SHARE
    print(f"\n{sampling}: {assert_equal_means(found, truth, sampling)}, relative error {relative_error(found):.2e}")
