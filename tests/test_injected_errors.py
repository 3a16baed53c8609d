"""The tests of unbiasedness have teeth: known errors put into the kernels on purpose make them fail, and clearly.

A mutant is the source text of a kernel module with one phrase replaced, compiled under another name. A phrase that is
no longer there, or there twice, fails at once: then the mutant must follow the source.
"""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from rendering import REPOSITORY, make_config, render_passes, scene_from, total
from test_furnace import UNDER_WATER, room
from z_test import ALPHA, Verdict, block_means, compare, compare_with_truth

from causticmpi.config.records import RenderConfig
from causticmpi.render import methods
from causticmpi.scene.data import SceneData

pytestmark = pytest.mark.statistical
SAMPLINGS = ("mixture", "two")
CLEAR = 1e-6
"""p-value below which an injected error counts as found; the right kernels must stay above ALPHA."""
PACKAGE = REPOSITORY / "causticmpi"
UNCACHED = """import numba
from causticmpi.kernels.jit import POLICY, inline
kernel = numba.njit(**POLICY)
"""
"""In place of the cached decorator: mutants must not settle in the folder of the right kernels."""


def mutant(module: str, folder: Path, *changes: tuple[str, str]) -> ModuleType:
    """The module, named as "room.module", with each (phrase, replacement) carried out, compiled on first call."""
    text = PACKAGE.joinpath(*module.split(".")).with_suffix(".py").read_text()
    decorators = "from causticmpi.kernels.jit import inline, kernel\n"
    for phrase, replacement in [*changes, *([(decorators, UNCACHED)] if decorators in text else [])]:
        assert text.count(phrase) == 1, f"{module} holds {text.count(phrase)} times, not once: {phrase!r}"
        text = text.replace(phrase, replacement)
    name = "mutant_" + module.replace(".", "_")
    path = folder / f"{name}.py"
    path.write_text(text)
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    sys.modules[name] = made
    spec.loader.exec_module(made)
    return made


# A light that shines at a mirror wall, which throws most of it back into the room; a mirror sphere in the middle.
ROOM = """
camera: {eye: [0, 1.6, 3.2], target: [0, 0.1, 0], up: [0, 1, 0], fov: 40}
materials:
  white: {type: diffuse, reflectance: 0.7}
  black: {type: diffuse, reflectance: 0}
  mirror: {type: mirror, reflectance: 0.95}
shapes:
  - {type: quad, corners: [[-1, -0.5, 1], [1, -0.5, 1], [1, -0.5, -1], [-1, -0.5, -1]], material: white}
  - {type: quad, corners: [[-1, -0.5, -1], [1, -0.5, -1], [1, 1.2, -1], [-1, 1.2, -1]], material: white}
  - {type: quad, corners: [[-1, -0.5, 1], [-1, -0.5, -1], [-1, 1.2, -1], [-1, 1.2, 1]], material: white}
  - {type: quad, corners: [[1, -0.5, -1], [1, -0.5, 1], [1, 1.2, 1], [1, 1.2, -1]], material: mirror}
  - {type: sphere, center: [-0.2, -0.1, 0], radius: 0.4, material: mirror}
  - type: quad
    corners: [[0.6, 0.4, -0.4], [0.6, 1.1, -0.4], [0.6, 1.1, 0.4], [0.6, 0.4, 0.4]]
    material: black
    emission: 8
"""
BOUND = 0.5
"""b [units^-2]: compensation reaches sqrt(1 / b) = 1.4 units here, the distance of walls and sphere."""


def settings(method: str, sampling: str = "two") -> RenderConfig:
    return make_config(
        method=method,
        film={"width": 16, "height": 16},
        iws={"paths": 32, "bound": BOUND},
        forecast={
            "photons": 5000,
            "clusters": 16,
            "neighbours": 20,
            "table": [16, 8],
            "max_rank": 12,
            "sampling": sampling,
            "light_tracing": False,  # else it would draw what the forecast is to be judged by
        },
    )


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SceneData:
    return scene_from(ROOM, tmp_path_factory.mktemp("scene"))


def blocks_of(scene: SceneData, config: RenderConfig, passes: int) -> np.ndarray:
    return block_means(total(render_passes(scene, config, passes))[..., :1], 4)


@pytest.fixture(scope="module")
def truth(scene: SceneData) -> np.ndarray:
    return blocks_of(scene, settings("pt"), 8000)


def judge(scene: SceneData, truth: np.ndarray, sampling: str = "two") -> Verdict:
    found = blocks_of(scene, settings("iws+cf", sampling), 1000)
    verdict = compare(found, truth)
    print(f"\n{sampling}: {verdict}; picture {100 * (found.mean() / truth.mean() - 1):+.2f} %")
    return verdict


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_right_kernels_pass(scene: SceneData, truth: np.ndarray, sampling: str) -> None:
    assert judge(scene, truth, sampling).p > ALPHA


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_lights_lost_behind_mirrors(
    scene: SceneData, truth: np.ndarray, sampling: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Virtual lights after a specular chain are not stored: the paths L S+ D D E are lost."""
    made = mutant(
        "estimators.virtual_lights",
        tmp_path,
        ("if at.primitive >= 0 and vec.max3(", "if at.primitive >= 0 and at.events == 0 and vec.max3("),
    )
    monkeypatch.setattr(methods, "trace_virtual_lights", made.trace_virtual_lights)
    assert judge(scene, truth, sampling).p < CLEAR


MIXTURE_ERRORS = {
    "no BRDF ray": [  # weights count on a ray that is not sent; if they did not, cones, which have no rim, would do
        ("if (words[COUNT + i] > j) & (cosine", "if (j > 0) & (words[COUNT + i] > j) & (cosine"),
    ],
    "thin cones": [  # cones are sampled more often than the weights know; with none at all paths would never end
        (
            "density += np.float32(steered) * cm.cones_pdf",
            "density += np.float32(0.7) * np.float32(steered) * cm.cones_pdf",
        ),
    ],
}


FROM_MUTANT_RAYS = (
    "from causticmpi.estimators import mixture_rays as rays\n",
    "import mutant_estimators_mixture_rays as rays\n",
)


@pytest.mark.parametrize("name", MIXTURE_ERRORS)
def test_errors_of_the_mixture(
    scene: SceneData, truth: np.ndarray, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mutant("estimators.mixture_rays", tmp_path, *MIXTURE_ERRORS[name])
    made = mutant("estimators.iws_mixture", tmp_path, FROM_MUTANT_RAYS)
    monkeypatch.setattr(methods, "trace_iws_mixture", made.trace_iws_mixture)
    assert judge(scene, truth, "mixture").p < CLEAR


MIRRORS_COMPENSATED = ("far, survive, key, ON_DIFFUSE)", "far, survive, key, ANYTHING)")
"""Of `full_radiance`: the compensation ray follows what it hits on S."""
FROM_MUTANT_RADIANCE = (
    "from causticmpi.estimators import full_radiance as fr\n",
    "import mutant_estimators_full_radiance as fr\n",
)


def test_compensation_counts_caustics_again(
    scene: SceneData, truth: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A compensation ray that hits a mirror follows it, although the caustic samples do so already.

    Only mirrors within the ray's reach sqrt(cos / b) do harm: a large b would hide the error.
    """
    mutant("estimators.full_radiance", tmp_path, MIRRORS_COMPENSATED)
    made = mutant("estimators.iws_cf", tmp_path, FROM_MUTANT_RADIANCE)
    monkeypatch.setattr(methods, "trace_iws_cf", made.trace_iws_cf)
    assert judge(scene, truth).p < CLEAR


FROM_MUTANT = (
    "from causticmpi.estimators import caustic_forecast as cf\n",
    "import mutant_estimators_caustic_forecast as cf\n",
)
VEC_ONE = ("from causticmpi.kernels.vec import ZERO\n", "from causticmpi.kernels.vec import ONE, ZERO\n")


def test_empty_bins_left_out(
    scene: SceneData, truth: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Table 2 is not sampled: caustics arrive from the photons' bins alone."""
    mutant(
        "estimators.caustic_forecast", tmp_path, ("        if other <= ZERO:\n", "        if other > -ONE:\n"), VEC_ONE
    )
    made = mutant("estimators.iws_cf", tmp_path, FROM_MUTANT)
    monkeypatch.setattr(methods, "trace_iws_cf", made.trace_iws_cf)
    assert judge(scene, truth).p < CLEAR


def test_mis_without_the_other_density(
    scene: SceneData, truth: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Samples of the table are weighted as if the BRDF were never asked."""
    mutant("estimators.caustic_forecast", tmp_path, ("bsdf.pdf(scene, material, n, wo, direction) + dt", "dt"))
    made = mutant("estimators.iws_cf", tmp_path, FROM_MUTANT)
    monkeypatch.setattr(methods, "trace_iws_cf", made.trace_iws_cf)
    assert judge(scene, truth, "mis").p < CLEAR


def test_radiance_not_scaled_at_refraction(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without eta^2 the floor of a water furnace looks n^2 times as bright from the air."""
    water = scene_from(room(0.5, below=1.33**2, inside=UNDER_WATER), tmp_path)
    assert compare_with_truth(blocks_of(water, settings("pt"), 300), 2.0).p > ALPHA
    mutant(
        "estimators.path_specular",
        tmp_path,
        ("vec.scale(get3(work, at.THROUGHPUT, i), work[at.ETA2 + i])", "get3(work, at.THROUGHPUT, i)"),
    )
    made = mutant(
        "estimators.path_tracing",
        tmp_path,
        (
            "from causticmpi.estimators import path_specular as specular_stages",
            "import mutant_estimators_path_specular as specular_stages",
        ),
    )
    monkeypatch.setattr(methods, "trace_paths", made.trace_paths)
    assert compare_with_truth(blocks_of(water, settings("pt"), 300), 2.0).p < CLEAR
