"""Chains against a plain reading of all photons: which there are, and the photons that stand for those rare at a
place."""

from typing import NamedTuple

import naive
import numba
import numpy as np
import pytest
from test_parallax import naive_settle

from causticmpi.kernels import wavefront
from causticmpi.preprocess import chains as library
from causticmpi.preprocess.chains import FACINGS, MOST_CHAINS, WITNESSES, Chains, part_chains
from causticmpi.preprocess.parallax import CURVATURE, HEIGHT, POWER, ROWS
from causticmpi.preprocess.photons import CausticPoints

HALF_AXES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float32)
NAMES = np.random.default_rng(11).integers(-(2**31), 2**31, 60).astype(np.int32)
RUBBISH = 9


def chain_names(count: int, names: int, seed: int = 12) -> np.ndarray:
    """Of so many photons, (count,) int32: the first chains are common, the last are rare."""
    weight = 0.9 ** np.arange(names)
    return np.random.default_rng(seed).choice(NAMES[:names], count, p=weight / weight.sum())


def random_points(count: int, names: int = 60, seed: int = 1) -> CausticPoints:
    """Caustic points anywhere in a cube, half of which face +y, the others any way; power (n,)."""
    generator = np.random.default_rng(seed)
    position = generator.random((count, 3))
    normal = generator.normal(size=(count, 3)) + np.where(generator.random((count, 1)) < 0.5, [0, 9, 0], 0)
    direction = naive.unit([0.3, 0.8, -0.2] + 0.1 * generator.normal(size=(count, 3)))
    power, curvature = generator.exponential(size=count) ** 2, 0.3 * generator.normal(size=(count, 6))
    floats = (a.astype(np.float32) for a in (position, naive.unit(normal), direction, power, curvature))
    return CausticPoints(*floats, chain_names(count, names))


def naive_chains(points: CausticPoints) -> tuple[np.ndarray, list[dict[int, np.ndarray]]]:
    """The half axis that each point faces (n,), and of each facing the rows of its chains by name."""
    facing, chains = (points.normal @ HALF_AXES.T).argmax(axis=1), []
    for axis in range(FACINGS):
        here = np.flatnonzero(facing == axis)
        rows = {name: here[points.chain[here] == name] for name in set(points.chain[here].tolist())}
        power = {name: points.power[these].sum(dtype=np.float64) for name, these in rows.items()}
        telling = [name for name in rows if len(rows[name]) >= WITNESSES]
        chains.append({name: rows[name] for name in sorted(telling, key=lambda name: -power[name])[:MOST_CHAINS]})
    return facing, chains


class Standing(NamedTuple):
    """A photon that stands for a chain; turned: 1, 0 or perhaps, -1; sure: whether rounding cannot change it."""

    power: float
    direction: np.ndarray
    height: float
    curvature: np.ndarray
    turned: int
    sure: bool


def naive_represent(
    points: CausticPoints,
    chains: dict[int, np.ndarray],
    known: np.ndarray,
    p: np.ndarray,
    enough: int,
    area: float,
    room: int,
) -> list[Standing]:
    """Photons for the chains of which fewer than `enough` are among the rows `known`, the brightest first."""
    found = []
    for rows in chains.values():
        if np.isin(known, rows).sum() >= enough:
            continue
        d2 = ((points.position[rows].astype(np.float64) - p) ** 2).sum(axis=1)
        order = np.argsort(d2)[:WITNESSES]
        near = rows[order]
        power = points.power[near].sum(dtype=np.float64) * area / (np.pi * d2[order[-1]])
        direction, height, turned, sure = naive_settle(
            points.direction[near], points.curvature[near], p - points.position[near], WITNESSES - 1
        )
        found.append(Standing(power, direction[0], height[0], points.curvature[near[0]], turned[0], sure[0]))
    return sorted(found, key=lambda photon: -photon.power)[:room]


def assert_stand_for(
    found: np.ndarray, expected: list[Standing], error: float = 1e-4, direction_error: float = 1e-6
) -> float:
    """found (k, ROWS), in any order, are the photons expected. Returns the share of those that are sure."""
    found = found[np.argsort(-found[:, POWER], kind="stable")]
    power = np.array([photon.power for photon in expected])
    assert len(found) == len(expected)
    np.testing.assert_allclose(found[:, POWER], power, rtol=error)
    for photon in expected:
        there = np.isclose(found[:, POWER], photon.power, rtol=error)
        there &= (np.abs(found[:, :3] - photon.direction) < direction_error).all(axis=1)
        there &= np.isclose(found[:, HEIGHT], photon.height, rtol=2e-3 + error)
        if photon.turned >= 0:
            there &= np.isclose(found[:, CURVATURE:], photon.turned * photon.curvature, rtol=error).all(axis=1)
        assert there.any() or not photon.sure
    return float(np.mean([photon.sure for photon in expected])) if expected else 1.0


@numba.njit
def run_represent(chains, points, work, facing, known, p, enough, area, photon, first, room):
    library.forget(chains, work, facing)
    for row in known:
        library.witness(chains, work, row)
    return library.represent(chains, points, work, facing, (p[0], p[1], p[2]), enough, area, photon, first, room)


def represented(
    points: CausticPoints,
    chains: Chains,
    facing: int,
    known: np.ndarray,
    p: np.ndarray,
    enough: int,
    area: float,
    room: int,
) -> np.ndarray:
    """(k, ROWS): photons that stand for rare chains, put behind two others of a place; rubbish lies in its workspace
    and must stay where nothing is put."""
    work, first = library.witnesses(chains, room), 2
    for array in work:
        array[:] = RUBBISH
    photon = np.full((ROWS, first + room + 3), RUBBISH, np.float32)
    arguments = (known, p.astype(np.float32), enough, np.float32(area), photon, first, room)
    held = run_represent(chains, points, work, facing, *arguments)
    assert (photon[:, :first] == RUBBISH).all() and (photon[:, first + held :] == RUBBISH).all()
    return photon[:, first : first + held].T


@pytest.mark.parametrize(("count", "names"), [(6000, 60), (6000, 3), (300, 60), (40, 60), (1, 1)])
def test_chains_are_those_of_the_definition(count: int, names: int) -> None:
    points = random_points(count, names)
    facing, wanted = naive_chains(points)
    chains = part_chains(points)
    assert np.array_equal(chains.facing, facing) and chains.first[0] == chains.start[0] == 0
    number = np.full(count, -1)
    for axis in range(FACINGS):
        found = set()
        for chain in range(chains.first[axis], chains.first[axis + 1]):
            rows = np.sort(chains.point[chains.start[chain] : chains.start[chain + 1]])
            number[rows] = chain
            found.add(tuple(rows.tolist()))
        assert found == {tuple(rows.tolist()) for rows in wanted[axis].values()}
        assert len(found) == chains.first[axis + 1] - chains.first[axis]
    assert np.array_equal(chains.chain, number)
    assert chains.first[-1] == len(chains.start) - 1 and chains.start[-1] == len(chains.point) == (number >= 0).sum()
    assert np.array_equal(np.stack([chains.x, chains.y, chains.z], axis=1), points.position[chains.point])


def test_the_definition_is_asked_for_all_it_says() -> None:
    """Chains of every facing, of one more than there is room for; too few photons; the same name for two facings."""
    points = random_points(6000)
    facing, kept = naive_chains(points)
    everywhere = len(set(points.chain[facing == 2].tolist()))
    assert everywhere > MOST_CHAINS >= len(kept[2]) >= MOST_CHAINS - 2 and all(kept)
    assert set(kept[0]) & set(kept[2]) and any(len(chains) < MOST_CHAINS for chains in kept)
    counts = np.unique(points.chain[facing == 0], return_counts=True)[1]
    assert (counts < WITNESSES).any() and (counts == WITNESSES).any()


@pytest.mark.parametrize("enough", [1, 4, 5])
@pytest.mark.parametrize("room", [1, 5, 40])
def test_rare_chains_are_stood_for(enough: int, room: int) -> None:
    """At places among the photons and outside, where some of the photons near by are known, and all chains or the
    brightest of them find room."""
    points = random_points(4000)
    facing, wanted = naive_chains(points)
    chains, generator = part_chains(points), np.random.default_rng(3)
    sure, held, full, left_out = [], [], 0, 0
    for place in range(60):
        axis = (2, 2, 0, 5)[place % 4]
        here = np.flatnonzero(facing == axis)
        p = (generator.random(3) * 1.4 - 0.2).astype(np.float32)
        known = generator.choice(here, 12 * enough)
        expected = naive_represent(points, wanted[axis], known, p, enough, 0.03, room)
        found = represented(points, chains, axis, known, p, enough, 0.03, room)
        sure.append(assert_stand_for(found, expected))
        held.append(len(found))
        counts = [np.isin(known, rows).sum() for rows in wanted[axis].values()]
        full += sum(count < enough for count in counts) > room
        left_out += enough in counts
    assert np.mean(sure) > 0.85 and np.mean(held) > min(room, 5) - 0.5
    assert (full > 50 or room == 40) and left_out > 30


def test_so_bright_as_the_chain_is() -> None:
    """Photons of two chains all over a plane, one ten times as dense: known by their powers, in units of a photon."""
    generator = np.random.default_rng(5)
    count = 22_000
    position = generator.random((count, 3)).astype(np.float32) * np.float32([1, 0, 1])
    up = np.tile(np.float32([0, 1, 0]), (count, 1))
    name = np.where(np.arange(count) % 11 == 0, 7, -7).astype(np.int32)
    points = CausticPoints(position, up, up, np.ones(count, np.float32), np.zeros((count, 6), np.float32), name)
    chains, found = part_chains(points), []
    for p in generator.uniform(0.2, 0.8, (2000, 3)) * [1, 0, 1]:
        photon = represented(points, chains, 2, np.zeros(0, np.int64), p, 1, 1e-3, 2)
        found.append(np.sort(photon[:, POWER]))
        assert (photon[:, :3] == up[0]).all()
    # The disc that reaches the last of n photons holds n - 1 on average: 1 / its area is n / (n - 1) of the density.
    wanted = np.array([2_000, 20_000]) * 1e-3 * WITNESSES / (WITNESSES - 1)
    np.testing.assert_allclose(np.mean(found, axis=0), wanted, rtol=0.1)


def test_all_photons_of_a_chain_at_one_place() -> None:
    """There is no disc: what stands for them is as bright as it may be."""
    points = random_points(50, 1)
    points = points._replace(position=np.zeros_like(points.position), normal=np.tile(HALF_AXES[2], (50, 1)))
    photon = represented(points, part_chains(points), 2, np.zeros(0, np.int64), np.zeros(3), 4, 1.0, 16)
    least, most = 1e6 * WITNESSES * points.power.min(), 1e6 * WITNESSES * points.power.max()
    assert len(photon) == 1 and np.isfinite(photon).all() and least < photon[0, POWER] < most
    dark = points._replace(power=np.zeros_like(points.power))
    photon = represented(dark, part_chains(dark), 2, np.zeros(0, np.int64), np.ones(3), 4, 1.0, 16)
    assert len(photon) == 1 and photon[0, POWER] == 0


@numba.njit
def run_joined(name, shape, reflected, out):
    for i in range(len(out)):
        out[i] = wavefront.joined(name[i], shape[i], reflected[i])


def test_names_of_chains_of_three_events_differ() -> None:
    """By all that they are made of: where they begin, and the shape and what happens there in turn."""
    shape, reflected = (a.ravel() for a in np.meshgrid(np.arange(8), [False, True], indexing="ij"))
    last, names = np.int32([0, 1]), []
    for _ in range(3):
        longer = np.zeros(16 * len(last), np.int32)
        run_joined(np.repeat(last, 16), *(np.tile(a, len(last)).astype(a.dtype) for a in (shape, reflected)), longer)
        names.append(longer)
        last = longer
    everything = np.concatenate(names)
    assert len(np.unique(everything)) == len(everything) == 2 * (16 + 16**2 + 16**3)
