"""Packed photons: what rounding takes from them, and that all that asks for one finds the same."""

import naive
import numba
import numpy as np
import pytest
from test_parallax import naive_turned

from causticmpi.preprocess import packed_photons as packing
from causticmpi.preprocess.packed_photons import BLOCK, STEP, packed_photons, unpacked_photons
from causticmpi.preprocess.parallax import CURVATURE, HEIGHT, NARROWEST, POWER, ROWS

DIRECTION_ERROR, REAL_ERROR = 0.501 * float(STEP), 2.0**-8
"""Of a coordinate, and relatively of all else, at most."""


@numba.njit
def run_ask(packed, step, out):
    for i in range(out.shape[0]):
        at = packing.place_of(i, BLOCK)
        out[i, 0], out[i, 1] = packing.power_of(packed, at), packing.height_of(packed, at)
        out[i, 2], out[i, 3], out[i, 4] = packing.turned_packed(packed, at, (step[0], step[1], step[2]))


@numba.njit
def run_pack(photon, count, packed, first):
    packing.pack(photon, count, packed, first)


def photons(places: int, columns: int) -> np.ndarray:
    """Of all sizes, (places, ROWS, columns)."""
    generator = np.random.default_rng(2)
    photon = generator.normal(size=(places, ROWS, columns))
    photon[:, :3] /= np.linalg.norm(photon[:, :3], axis=1)[:, None]
    photon[:, 3:] *= np.exp(generator.normal(0, 12, size=photon[:, 3:].shape))
    photon[:, POWER : HEIGHT + 1] = abs(photon[:, POWER : HEIGHT + 1])
    return photon.astype(np.float32)


def test_numbers_are_rounded_to_the_nearest() -> None:
    photon = photons(30, 48)
    packed = packed_photons(photon)
    assert packed.shape == (30, ROWS * 48) and 2 * packed.nbytes == photon.nbytes
    found = unpacked_photons(packed)
    assert abs(found[:, :3] - photon[:, :3]).max() < DIRECTION_ERROR < NARROWEST / 50
    error = found[:, 3:].astype(np.float64) / photon[:, 3:] - 1
    assert abs(error).max() < REAL_ERROR and abs(error).max() > 0.9 * REAL_ERROR
    assert abs(error.mean()) < 0.02 * REAL_ERROR and abs((found[:, :3] - photon[:, :3]).mean()) < 0.02 * STEP
    assert np.array_equal(packed_photons(found), packed)


def test_numbers_that_are_kept() -> None:
    """Nothing, which stands for no photon, and the axes; ties go to the even number, whatever their sign."""
    photon = np.zeros((1, ROWS, 16), np.float32)
    photon[0, :3, :3], photon[0, :3, 3:6] = np.eye(3), -np.eye(3)
    photon[0, CURVATURE, :6] = 0, 1, -1, 1e12, -1e-12, -0.0
    tie = np.float32(2.0**-8)
    photon[0, CURVATURE + 1, :4] = 1 + tie, 1 + 3 * tie, -1 - tie, -1 - 3 * tie
    found = unpacked_photons(packed_photons(photon))[0]
    assert np.array_equal(found[:3, :6], photon[0, :3, :6]) and (found[:, 6:] == 0).all()
    assert (found[POWER] == 0).all() and (found[HEIGHT] == 0).all()
    np.testing.assert_allclose(found[CURVATURE, :6], photon[0, CURVATURE, :6], rtol=REAL_ERROR)
    assert found[CURVATURE + 1, :4].tolist() == [1, 1 + 4 * tie, -1, -1 - 4 * tie]


def test_photons_are_found_again() -> None:
    photon, step = photons(3, 64), np.float32([0.1, -0.2, 0.05])
    photon[:, CURVATURE:] = np.random.default_rng(3).normal(size=(3, 6, 64))
    packed = packed_photons(photon)
    known = unpacked_photons(packed)
    for place in range(3):
        found = np.zeros((64, 5), np.float32)
        run_ask(packed[place], step, found)
        assert np.array_equal(found[:, :2], known[place, POWER : HEIGHT + 1].T)
        direction, curvature = known[place, :3].T, known[place, CURVATURE:].T
        np.testing.assert_allclose(found[:, 2:], naive_turned(direction, curvature, np.tile(step, (64, 1))), atol=3e-7)
        exact = naive_turned(photon[place, :3].T, photon[place, CURVATURE:].T, np.tile(step, (64, 1)))
        assert np.median(np.linalg.norm(naive.unit(found[:, 2:]) - exact, axis=1)) < 2e-3


@pytest.mark.parametrize("first", [0, 5, 13])
def test_so_many_are_packed(first: int) -> None:
    """Behind those that are there already."""
    photon, packed = photons(1, 48)[0], np.full(ROWS * 48, 77, np.int16)
    run_pack(photon[:, first:].copy(), 35, packed, first)
    by_photon = packed.reshape(3, ROWS, 16).transpose(0, 2, 1).reshape(48, ROWS)
    whole = packed_photons(photon[None])[0].reshape(3, ROWS, 16).transpose(0, 2, 1).reshape(48, ROWS)
    these = slice(first, first + 35)
    assert np.array_equal(by_photon[these], whole[these])
    assert (by_photon[:first] == 77).all() and (by_photon[first + 35 :] == 77).all()
