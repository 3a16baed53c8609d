"""Path tracing in waves: a pixel's sums are the same bits whoever shares its waves, and its trigonometry is exact."""

import numba
import numpy as np
import pytest
from rendering import REPOSITORY, make_config, prepare

from causticmpi.kernels import warp
from causticmpi.kernels.pixels import pixel_order
from causticmpi.preprocess.forecast import no_forecast
from causticmpi.render.methods import make_method
from causticmpi.scene.load import load_scene
from causticmpi.scene.tracing import camera_array

SIDE = 40


@pytest.mark.parametrize("name", ["cornell", "pool"])
def test_same_bits_in_any_company(name: str) -> None:
    """All pixels at once, tile by tile, in odd runs, and a crop across tiles."""
    prepared = prepare(load_scene(REPOSITORY / "scenes" / f"{name}.yaml"))
    camera = camera_array(prepared.data.camera, SIDE, SIDE)
    method = make_method(make_config(method="pt"), prepared.traced, camera, no_forecast(), prepared.extent)

    def film(window: tuple[int, int, int, int], rows: int) -> np.ndarray:
        pixels = pixel_order(window, SIDE)
        height, width = window[3] - window[1], window[2] - window[0]
        out = np.zeros((height * width, 6), np.float32)
        method.begin_pass(3)
        for first in range(0, len(pixels), rows):
            method.trace(pixels[first : first + rows], out)
        return out.reshape(height, width, 6)

    whole = film((0, 0, SIDE, SIDE), 10**6)
    assert whole[..., :3].any() and np.isfinite(whole).all()
    for rows in (16, 7 * 16, 33 * 16):
        assert film((0, 0, SIDE, SIDE), rows).tobytes() == whole.tobytes()
    assert film((5, 3, 38, 31), 10**6).tobytes() == np.ascontiguousarray(whole[3:31, 5:38]).tobytes()
    prepared.embree.close()


@numba.njit
def turns(v, out):
    for i in range(v.shape[0]):
        out[i, 0], out[i, 1] = warp.turn(v[i])


def test_cosine_and_sine_of_a_turn() -> None:
    v = np.linspace(0, 1, 100_001, dtype=np.float32)[:-1]
    out = np.empty((len(v), 2), np.float32)
    turns(v, out)
    angle = 2 * np.pi * v.astype(np.float64)
    np.testing.assert_allclose(out, np.stack([np.cos(angle), np.sin(angle)], axis=1), atol=5e-7)
