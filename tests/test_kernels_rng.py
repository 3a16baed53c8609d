"""Random numbers: uniform, independent between all that names them, and never changed by accident."""

import itertools

import naive
import numba
import numpy as np
import pytest
from chi_square import SAMPLES, pair_p_value, sidak, uniform_p_value

from causticmpi.kernels import rng

AXES = ("seed", "pass_index", "item", "counter", "dimension")
COMPARISONS = 5 * len(AXES) + 5
GOLDEN = [
    [13462529, 8827],
    [15014901, 531475],
    [14353225, 1161290],
    [3076236, 3623906],
    [12629925, 9541195],
    [10980351, 15464272],
]
"""First and second number, times 2^24, of each purpose and of a subkey."""


@numba.njit
def draw(seed, purpose, pass_index, item, counter, dimension, out):
    """Uniforms of many keys; a negative counter draws from the key itself, else from its subkey."""
    for i in range(out.shape[0]):
        key = rng.make_key(seed[i], purpose[i], pass_index[i], item[i])
        if counter[i] >= 0:
            key = rng.subkey(key, counter[i])
        out[i, 0], out[i, 1] = rng.uniform2(key, dimension[i])


def draws(n: int = SAMPLES, purpose: int | np.ndarray = 0, **varied: int | np.ndarray) -> np.ndarray:
    """(n, 2) uniforms; each argument is a number or an array of n."""
    base = {"seed": 7, "pass_index": 3, "item": 11, "counter": -1, "dimension": 0} | varied
    columns = {k: np.broadcast_to(np.asarray(v, np.int64), n).copy() for k, v in base.items()}
    out = np.empty((n, 2), np.float32)
    purposes = np.broadcast_to(np.asarray(purpose, np.uint64), n).copy()
    draw(columns["seed"], purposes, *(columns[k] for k in AXES[1:]), out)
    return out


def test_against_plain_splitmix() -> None:
    seeds, passes, items = np.array([0, 1, 2**40]), np.array([0, 5, 10**6]), np.array([0, 9, 2**31])
    for purpose, (seed, index, item), counter, dimension in itertools.product(
        range(5), itertools.product(seeds, passes, items), (-1, 0, 3), (0, 7)
    ):
        got = draws(
            1, purpose, seed=int(seed), pass_index=int(index), item=int(item), counter=counter, dimension=dimension
        )
        key = naive.make_key(int(seed), purpose, int(index), int(item))
        if counter >= 0:
            key = naive.subkey(key, counter)
        assert tuple(got[0].tolist()) == naive.uniform2(key, dimension)


def test_golden_values() -> None:
    """Pinned: were these to change, every picture of every seed would change silently."""
    purposes = (rng.CAMERA, rng.PARTICLE, rng.PHOTON, rng.TRAINING, rng.SHIFT)
    got = [draws(1, int(p), seed=1, pass_index=2, item=3, dimension=4)[0].tolist() for p in purposes]
    got.append(draws(1, 0, seed=1, pass_index=2, item=3, counter=5, dimension=4)[0].tolist())
    assert [[int(x * 2**24) for x in pair] for pair in got] == GOLDEN


def test_range() -> None:
    values = draws(1 << 22, item=np.arange(1 << 22))
    assert values.min() >= 0 and values.max() < 1
    scaled = values.astype(np.float64) * 2**24
    assert (scaled == np.floor(scaled)).all()  # 24 bits each, so that 1 is never reached by rounding
    assert values.max() > 1 - 2.0**-20 and values.min() < 2.0**-20


@pytest.mark.statistical
@pytest.mark.parametrize("axis", AXES)
def test_uniform_along(axis: str) -> None:
    """What any one argument counts through is uniform, in each number and in the pair; neighbours are independent."""
    values = draws(**{axis: np.arange(SAMPLES)})
    level = sidak(COMPARISONS)
    assert uniform_p_value(values[:, 0]) > level and uniform_p_value(values[:, 1]) > level
    assert pair_p_value(values[:, 0], values[:, 1]) > level
    for lag in (1, 2):
        assert pair_p_value(values[:-lag, 0], values[lag:, 0]) > level
    bound = 5 / np.sqrt(SAMPLES)  # correlation, five standard errors
    for lag in (1, 2, 32, 640):
        assert abs(np.corrcoef(values[:-lag, 0], values[lag:, 1])[0, 1]) < bound


@pytest.mark.statistical
@pytest.mark.parametrize(
    "other",
    [{"purpose": 1}, {"seed": 8}, {"pass_index": 4}, {"counter": 0}, {"dimension": 1}],
    ids=lambda other: next(iter(other)),
)
def test_streams_are_independent(other: dict[str, int]) -> None:
    """The same items under another name: every pairing of numbers is uniform in the square."""
    items = np.arange(SAMPLES)
    a, b = draws(item=items), draws(item=items, **other)
    assert (a != b).any(axis=1).mean() > 0.999
    assert pair_p_value(a[:, 0], b[:, 0]) > sidak(COMPARISONS)


def test_every_argument_counts() -> None:
    """A small grid of all arguments names different streams throughout."""
    grid = np.array(list(itertools.product((0, 1, 2), range(5), range(9), range(9), (-1, 0, 1, 2), (0, 1, 2))))
    purpose, rest = grid[:, 1], np.delete(grid, 1, axis=1).T
    out = draws(len(grid), purpose, **dict(zip(AXES, rest, strict=True))).astype(np.float64)
    words = (out[:, 0] * 2**24).astype(np.int64) << 24 | (out[:, 1] * 2**24).astype(np.int64)
    assert len(np.unique(words)) == len(grid)
