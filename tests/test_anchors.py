"""Anchors against a plain reading of the trees: which one a place falls to, and what photons it knows."""

import numba
import numpy as np
import pytest
from test_chains import HALF_AXES, assert_stand_for, chain_names, naive_chains, naive_represent
from test_forecast import build, caustic_points
from test_packed_photons import DIRECTION_ERROR, REAL_ERROR
from test_parallax import naive_settle

from causticmpi.kernels import vec
from causticmpi.preprocess.anchors import COMPANIONS, MOST_RARE, REACH, RUN, SHORTEST, anchor_of
from causticmpi.preprocess.chains import FACINGS, WITNESSES
from causticmpi.preprocess.forecast import ForecastMaps, no_forecast
from causticmpi.preprocess.packed_photons import unpacked_photons
from causticmpi.preprocess.parallax import CURVATURE, HEIGHT, POWER

GREY = ((0x3F80 - 1500 + np.random.default_rng(3).permutation(3000)) << 16).astype(np.int32).view(np.float32)
"""Powers that tell photons apart once they are packed."""
CHAIN = np.where(np.random.default_rng(4).random(3000) < 0.6, np.int32(7), chain_names(3000, 40))
"""One common chain, and more rare ones than an anchor may have room for."""
POINTS = caustic_points(3000)._replace(power=np.repeat(GREY[:, None], 3, axis=1), chain=CHAIN)
LUMINANCE = POINTS.power.astype(np.float64) @ [0.2126, 0.7152, 0.0722]
FACING = (POINTS.normal @ HALF_AXES.T).argmax(axis=1)


@numba.njit
def run_anchor_of(maps, points, normals, out):
    for i in range(points.shape[0]):
        out[i] = anchor_of(maps, vec.row(points, i), vec.row(normals, i))


def anchors(maps: ForecastMaps, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    out = np.zeros(len(points), np.int64)
    run_anchor_of(maps, points.astype(np.float32), normals.astype(np.float32), out)
    return out


def runs(maps: ForecastMaps, facing: int) -> list[tuple[int, int]]:
    """Rows of every run of a tree, by recursion."""

    def below(low: int, high: int) -> list[tuple[int, int]]:
        middle = (low + high) // 2
        return [(low, high)] if high - low <= RUN else below(low, middle) + below(middle + 1, high)

    low, high = (int(row) for row in maps.tree_start[facing : facing + 2])
    return below(low, high) if high > low else []


def coordinates(maps: ForecastMaps) -> np.ndarray:
    return np.stack([maps.tree_x, maps.tree_y, maps.tree_z], axis=1)


def naive_anchor(maps: ForecastMaps, p: np.ndarray, n: np.ndarray) -> int:
    """By walking down with a point's own coordinates, and all distances."""
    facing = int((HALF_AXES @ n).argmax())
    low, high = (int(row) for row in maps.tree_start[facing : facing + 2])
    if low == high:
        return -1
    start, points = low, coordinates(maps)
    while high - low > RUN:
        middle = (low + high) // 2
        axis = maps.tree_axis[middle]
        low, high = (low, middle) if p[axis] < points[middle, axis] else (middle + 1, high)
    anchor = int(maps.anchor_start[facing]) + (low - start) // SHORTEST
    return anchor if ((maps.anchor[anchor] - p) ** 2).sum() < (REACH * np.float32(maps.radius)) ** 2 else -1


@pytest.fixture(scope="module")
def maps() -> ForecastMaps:
    return build(POINTS)[0]


def test_a_tree_holds_the_photons_of_its_facing(maps: ForecastMaps) -> None:
    points = coordinates(maps)
    for facing in range(FACINGS):
        held = points[maps.tree_start[facing] : maps.tree_start[facing + 1]]
        expected = POINTS.position[facing == FACING]
        assert np.array_equal(held[np.lexsort(held.T)], expected[np.lexsort(expected.T)])
    assert (np.diff(maps.tree_start) > 0).sum() == 2 and maps.tree_start[-1] == 3000


def test_every_run_has_an_anchor_of_its_own_in_its_middle(maps: ForecastMaps) -> None:
    points, seen = coordinates(maps), set()
    for facing in range(FACINGS):
        for low, high in runs(maps, facing):
            anchor = int(maps.anchor_start[facing]) + (low - int(maps.tree_start[facing])) // SHORTEST
            assert anchor not in seen and anchor < maps.anchor_start[facing + 1]
            seen.add(anchor)
            np.testing.assert_allclose(maps.anchor[anchor], points[low:high].mean(axis=0), atol=1e-6)
    assert len(seen) > 100 and (maps.anchor_count > 0).sum() == len(seen)


def test_anchors_know_the_nearest_photons(maps: ForecastMaps) -> None:
    """Those of their facing, known by their powers; turned to the anchor and with the cones of the definition. Before
    them photons that stand for the chains of which fewer than WITNESSES are among them, and in the place of these."""
    photons, compared, turns = unpacked_photons(maps.anchor_photon), 0.0, 0.0
    grey = POINTS._replace(power=LUMINANCE.astype(np.float32))
    _, chains = naive_chains(grey)
    stood, rare = [], []
    for facing in range(FACINGS):
        own = np.flatnonzero(facing == FACING)
        for anchor in range(maps.anchor_start[facing], maps.anchor_start[facing + 1]):
            count = maps.anchor_count[anchor]
            assert (photons[anchor, :, count:] == 0).all()
            if count == 0:
                continue
            d2 = ((POINTS.position[own] - maps.anchor[anchor]) ** 2).sum(axis=1)
            near = np.argsort(d2)[: maps.neighbours]
            near = near[d2[near] < (REACH * maps.radius) ** 2]
            reach2 = d2[near[-1]] if len(near) == maps.neighbours else (REACH * maps.radius) ** 2
            near, place = own[near], maps.anchor[anchor]
            few = np.concatenate([rows for rows in chains[facing].values() if np.isin(near, rows).sum() < WITNESSES])
            common = near[~np.isin(near, few)]
            room = min(MOST_RARE, photons.shape[2] - len(common))
            expected = naive_represent(grey, chains[facing], near, place, WITNESSES, np.pi * reach2, room)
            held = len(expected)
            assert count == held + len(common)
            stood.append(assert_stand_for(photons[anchor, :, :held].T, expected, REAL_ERROR, 1e-6 + DIRECTION_ERROR))
            rare.append((held, len(near) - len(common), len(near) == maps.neighbours, held == room))
            near = common[np.argsort(LUMINANCE[common])]
            found = photons[anchor, :, held:count].T
            found = found[np.argsort(found[:, POWER])]
            np.testing.assert_allclose(found[:, POWER], LUMINANCE[near], rtol=1e-6)
            direction, curvature = POINTS.direction[near], POINTS.curvature[near]
            offset = maps.anchor[anchor] - POINTS.position[near]
            wanted, height, turned, sure = naive_settle(direction, curvature, offset, COMPANIONS)
            np.testing.assert_allclose(found[sure, HEIGHT], height[sure], rtol=2e-3 + REAL_ERROR)
            if sure.any():
                np.testing.assert_allclose(found[:, :3], wanted, atol=1e-6 + DIRECTION_ERROR)
                np.testing.assert_allclose(found[turned == 1, CURVATURE:], curvature[turned == 1], rtol=REAL_ERROR)
                assert (found[turned == 0, CURVATURE:] == 0).all()
                turns += (turned == 1).mean() / (maps.anchor_count > 0).sum()
            compared += sure.mean() / (maps.anchor_count > 0).sum()
    assert compared > 0.9 and 0.1 < turns < 0.9
    represented, dropped, many, no_room = np.transpose(rare)
    assert np.mean(stood) > 0.8 and represented.mean() > 3 and dropped.mean() > 3
    assert 0.05 < many.mean() < 1 and 0.05 < no_room.mean() < 0.9


def test_places_find_the_anchor_of_their_run(maps: ForecastMaps) -> None:
    """Photons themselves, places between them, places too far from any, and such as face where no photon lies."""
    generator = np.random.default_rng(1)
    moved = POINTS.position + np.float32(1.2 * maps.radius) * generator.normal(size=(3000, 3)).astype(np.float32)
    for place in (POINTS.position, moved, POINTS.position + np.float32(9)):
        expected = [naive_anchor(maps, p, n) for p, n in zip(place, POINTS.normal, strict=True)]
        assert anchors(maps, place, POINTS.normal).tolist() == expected
    assert (anchors(maps, POINTS.position, POINTS.normal) >= 0).mean() > 0.9
    assert 0.1 < (anchors(maps, moved, POINTS.normal) >= 0).mean() < 0.9
    assert (anchors(maps, POINTS.position, -POINTS.normal) == -1).all()


def test_maps_without_photons_have_no_anchor() -> None:
    maps = no_forecast()
    assert len(maps.anchor) == len(maps.anchor_count) == 0 and maps.anchor_start.tolist() == [0] * 7
    assert (anchors(maps, np.zeros((6, 3)), HALF_AXES) == -1).all()
