"""Estimators that share little agree: block means of L_d, of L_c and of their sum, over independent passes.

`pt` meets lights by next-event estimation, `pt-brute` by chance alone, `iws` and `iws+cf` by virtual lights and
forecasts.
"""

from pathlib import Path

import numpy as np
import pytest
from rendering import REPOSITORY, make_config, render_passes, scene_from
from z_test import Verdict, assert_equal_means, block_means, relative_error

from causticmpi.config.records import RenderConfig
from causticmpi.scene.data import SceneData
from causticmpi.scene.load import load_scene

pytestmark = pytest.mark.statistical
SAMPLINGS = ("mixture", "two")
SIDE = 16
"""Pixels of a picture's side; compared as 4 x 4 blocks, large enough for the rare bright paths of L_c to even out."""


def settings(method: str, seed: int, sampling: str = "mixture", **iws: float) -> RenderConfig:
    return make_config(
        method=method,
        seed=seed,
        film={"width": SIDE, "height": SIDE},
        iws={"paths": 32, **iws},
        forecast={
            "photons": 5000,
            "clusters": 32,
            "neighbours": 20,
            "table": [16, 8],
            "splitting": 2,
            "sampling": sampling,
        },
    )


def layers(films: np.ndarray, blocks: int = 4) -> np.ndarray:
    """(passes, columns): block means of L_d, L_c and their sum in RGB."""
    films = films.astype(np.float64)
    films = np.concatenate([films, films[..., :3] + films[..., 3:]], axis=-1)
    return block_means(films, films.shape[1] // blocks)


RIVALS: dict[tuple[str, str, int, int], np.ndarray] = {}
"""Layers of the methods compared with, which know neither sampling nor bound, by scene."""


def rival_layers(scene: SceneData, method: str, passes: int, blocks: int) -> np.ndarray:
    key = (scene.content_hash, method, passes, blocks)
    if key not in RIVALS:
        RIVALS[key] = layers(render_passes(scene, settings(method, 2), passes), blocks)
    return RIVALS[key]


def assert_agree(
    scene: SceneData,
    a: tuple[str, int],
    b: tuple[str, int],
    blocks: int = 4,
    sampling: str = "mixture",
    **iws: float,
) -> Verdict:
    """Methods with their numbers of passes; seeds differ, so the samples are independent. b: `pt` or `pt-brute`."""
    found = layers(render_passes(scene, settings(a[0], 1, sampling, **iws), a[1]), blocks)
    truth = rival_layers(scene, *b, blocks)
    verdict = assert_equal_means(found, truth, f"{a[0]} against {b[0]}")
    whole = [layers.reshape(len(layers), -1, 9) for layers in (found, truth)]
    ratio = [float(x.mean()) for x in (whole[0][..., 6:], whole[1][..., 6:])]
    caustics = whole[1][..., 3:6].mean() / ratio[1]
    print(
        f"\n{a}, {sampling}, against {b}: {verdict}; {100 * (ratio[0] / ratio[1] - 1):+.2f} %, relative errors "
        f"{relative_error(whole[0][..., 6:]):.2e} and {relative_error(whole[1][..., 6:]):.2e}; L_c {caustics:.0%}"
    )
    return verdict


@pytest.fixture(scope="module")
def cornell() -> SceneData:
    return load_scene(REPOSITORY / "scenes" / "cornell.yaml")


@pytest.mark.parametrize("sampling", SAMPLINGS)
@pytest.mark.parametrize(("passes", "rival"), [(2000, 8000), (200, 8000), (600, 8000)])
def test_cornell(cornell: SceneData, passes: int, rival: int, sampling: str) -> None:
    assert_agree(cornell, ("iws+cf", passes), ("pt", rival), sampling=sampling)


def test_iws_is_the_diffusive_layer(cornell: SceneData) -> None:
    alone = layers(render_passes(cornell, settings("iws", 1), 1500)).reshape(1500, -1, 9)
    forecast = layers(render_passes(cornell, settings("iws+cf", 2), 1500)).reshape(1500, -1, 9)
    assert not alone[..., 3:6].any()
    verdict = assert_equal_means(alone[..., :3].reshape(1500, -1), forecast[..., :3].reshape(1500, -1), "L_d")
    print(f"\n{verdict}")


ROOM = """
camera: {eye: [0, 0.6, 3.4], target: [0, -0.1, 0], up: [0, 1, 0], fov: 42}
materials:
  white: {type: diffuse, reflectance: [0.7, 0.6, 0.5]}
  black: {type: diffuse, reflectance: 0}
  mirror: {type: mirror, reflectance: [0.9, 0.8, 0.7]}
  glass: {type: dielectric, ior: 1.5}
  satin: {type: phong, diffuse: 0.4, specular: 0.4, exponent: 5}
  gloss: {type: phong, diffuse: [0.2, 0.3, 0.4], specular: 0.5, exponent: 500}
shapes:
  - {type: quad, corners: [[-1, -0.5, 1], [1, -0.5, 1], [1, -0.5, -1], [-1, -0.5, -1]], material: FLOOR}
  - {type: quad, corners: [[-1, -0.5, -1], [1, -0.5, -1], [1, 1.2, -1], [-1, 1.2, -1]], material: BACK}
  - {type: quad, corners: [[-1, -0.5, 1], [-1, -0.5, -1], [-1, 1.2, -1], [-1, 1.2, 1]], material: white}
"""
LAMP = """
  - {type: quad, corners: [[-0.4, 1.1, -0.4], [0.4, 1.1, -0.4], [0.4, 1.1, 0.4], [-0.4, 1.1, 0.4]], material: black,
     emission: [9, 8, 7]}
"""
GLASS_BALL = "  - {type: sphere, center: [0.3, -0.1, 0], radius: 0.35, material: glass}\n"
MIRROR_BALL = "  - {type: sphere, center: [-0.5, -0.2, 0.2], radius: 0.3, material: mirror}\n"
# A pane before the camera, and the caustic of the glass ball also in the mirror behind it.
PANE = "  - {type: box, min: [-0.9, -0.4, 1.2], max: [0.3, 0.6, 1.3], material: glass}\n"
# A dim lamp and a bright small one close to the gloss, 1 : 200 in power.
BALL_LAMPS = """
  - {type: sphere, center: [-0.3, 0.6, 0.2], radius: 0.25, material: white, emission: 4}
  - {type: sphere, center: [0.7, -0.38, 0.5], radius: 0.1, material: black, emission: [0.2, 0.1, 0.05]}
"""
LOW_LAMP = """
  - {type: quad, corners: [[0.5, -0.45, -0.6], [0.5, 0.05, -0.6], [0.5, 0.05, -0.1], [0.5, -0.45, -0.1]],
     material: black, emission: 6}
"""
LAMP_IN_GLASS = """
  - {type: sphere, center: [0, 0.3, 0], radius: 0.3, material: black, emission: 5}
  - {type: sphere, center: [0, 0.3, 0], radius: 0.45, material: glass}
"""

CASES = {
    "caustic behind glass and in a mirror": (("white", "mirror"), LAMP + GLASS_BALL + PANE),
    "satin and gloss": (("gloss", "satin"), LOW_LAMP + LAMP + MIRROR_BALL),
    "gloss behind a caustic": (("satin", "gloss"), LAMP + GLASS_BALL),
    "sphere lights of unlike power": (("white", "gloss"), BALL_LAMPS + GLASS_BALL),
    "a lamp in glass": (("white", "white"), LAMP_IN_GLASS),
}


def case(name: str, folder: Path) -> SceneData:
    (floor, back), shapes = CASES[name]
    return scene_from(ROOM.replace("FLOOR", floor).replace("BACK", back) + shapes, folder)


@pytest.mark.parametrize("sampling", SAMPLINGS)
@pytest.mark.parametrize("name", CASES)
def test_forecasts_against_paths(name: str, sampling: str, tmp_path: Path) -> None:
    # Through gloss a caustic path is rare and bright: 1000 passes miss some.
    passes = 4000 if name == "satin and gloss" else 1000
    assert_agree(case(name, tmp_path), ("iws+cf", passes), ("pt", 4000), sampling=sampling)


@pytest.mark.parametrize("name", CASES)
def test_paths_against_brute_force(name: str, tmp_path: Path) -> None:
    assert_agree(case(name, tmp_path), ("pt", 2000), ("pt-brute", 8000))


@pytest.mark.parametrize("sampling", SAMPLINGS)
@pytest.mark.parametrize("bound", [0.05, 50.0])
def test_gloss_at_any_bound(bound: float, sampling: str, tmp_path: Path) -> None:
    """Many passes and coarse blocks, for what is said above."""
    scene = case("satin and gloss", tmp_path)
    assert_agree(scene, ("iws+cf", 6000), ("pt", 12000), blocks=2, sampling=sampling, bound=bound)


@pytest.mark.parametrize("sampling", SAMPLINGS)
@pytest.mark.parametrize(("name", "passes", "rival"), [("ring", 500, 10000), ("pool", 1000, 20000)])
def test_scenes_of_hard_caustics(name: str, passes: int, rival: int, sampling: str) -> None:
    """Coarse blocks: a path tracer meets these lights by luck alone."""
    scene = load_scene(REPOSITORY / "scenes" / f"{name}.yaml")
    assert_agree(scene, ("iws+cf", passes), ("pt", rival), blocks=2, sampling=sampling)
