"""The rays of up to 16 vertices by the mixture of samplers (caustic_mixture), side by side: the j-th of all at once.

Loops over lanes that read nothing but `MixtureWork.lane` become vector code; what must ask tables, or has gloss, is
done lane by lane in loops of its own. Vertex i is row i of `work.now`, and its samplers are told by `cluster` and
the cones of `work.forecast`.
"""

import numpy as np

from causticmpi.estimators import caustic_mixture as cm
from causticmpi.estimators import full_radiance as fr
from causticmpi.estimators.vertices import get
from causticmpi.kernels import bsdf, lanes, rng, vec, warp
from causticmpi.kernels.embree import LANES, aligned_words
from causticmpi.kernels.jit import inline
from causticmpi.kernels.material_kinds import PHONG
from causticmpi.kernels.path_layout import get3, put3
from causticmpi.kernels.vec import ALMOST_ONE, HALF, INFINITY, INV_PI, ONE, TWO, ZERO
from causticmpi.preprocess.cells import KEPT
from causticmpi.preprocess.forecast import ForecastMaps
from causticmpi.preprocess.parallax import ROWS

NORMAL, SHADE, KEY, RAY_KEY, CHOICE, COIN, U, V, DIRECTION, WEIGHT, SURVIVE, REACH, AXIS, HEIGHT, BIN, BRDF, STEERED = (
    LANES * row for row in (0, 3, 6, 8, 10, 11, 12, 13, 14, 17, 20, 21, 22, 25, 26, 27, 28)
)
COSINE, COUNT, _END = LANES * 29, LANES * 30, LANES * 31
"""Rows of a vertex that sends rays, as word offsets of the lanes in `MixtureWork.lane`.

SHADE: throughput x Lambert's BRDF; KEY, RAY_KEY uint64: of the vertex and of its ray; COIN: above 0 where the ray goes
by coarse directions; DIRECTION to REACH: the ray, as in `full_radiance.Rays`; AXIS, HEIGHT: the cone it is drawn from;
BIN int32: of the coarse directions; BRDF: density of that sampler; STEERED: that of all others, times how often each is
asked; COSINE: of direction and normal; COUNT int32: rays that the vertex sends. The last of them are drawn from cones,
the first `others` are not: one by the BRDF and one by coarse directions, or one of the two by the toss of a coin."""


def mixture_work(maps: ForecastMaps) -> cm.MixtureWork:
    """Workspace that fits the maps."""
    photons = max(KEPT, maps.anchor_photon.shape[1] // ROWS)
    return cm.MixtureWork(
        cluster=np.zeros(LANES, np.int64),
        anchor=np.zeros(LANES, np.int64),
        count=np.zeros(LANES, np.int64),
        columns=np.zeros(LANES, np.int64),
        total=np.zeros(LANES, np.float32),
        share=np.zeros(LANES, np.float32),
        cone=aligned_words(photons * cm.CONES).reshape(LANES, -1),
        cdf=np.zeros((LANES, photons), np.float32),
        lane=aligned_words(_END),
        codeword_distance=np.zeros(maps.codebook.shape[1], np.float32),
    )


@inline
def begin(work):
    """No vertex sends a ray yet."""
    words = work.forecast.lane.view(np.int32)
    for i in range(LANES):
        words[COUNT + i] = 0


@inline
def take_up(scene, work, i, count):
    """Vertex i is to send `count` rays. Returns whether it has gloss."""
    lane, at = work.forecast.lane, get(work.now, i)
    put3(lane, NORMAL, i, at.n)
    put3(lane, SHADE, i, vec.scale(vec.mul(at.throughput, vec.row(scene.reflectance, at.material)), INV_PI))
    lane.view(np.uint64)[KEY // 2 + i] = at.key
    lane.view(np.int32)[COUNT + i] = count
    return scene.kind[at.material] == PHONG


@inline
def most_rays(work):
    """The most rays that a vertex sends."""
    words = work.forecast.lane.view(np.int32)
    most = np.int32(0)
    for i in range(LANES):
        most = max(most, words[COUNT + i])
    return most


@inline
def draw(work, j):
    """The random numbers of the j-th rays."""
    lane = work.forecast.lane
    keys = lane.view(np.uint64)
    for i in range(LANES):
        keys[RAY_KEY // 2 + i] = rng.subkey(keys[KEY // 2 + i], fr.SAMPLE + j)
    for i in range(LANES):
        key = keys[RAY_KEY // 2 + i]
        lane[CHOICE + i], lane[SURVIVE + i] = rng.uniform2(key, fr.CHOICE)
        lane[U + i], lane[V + i] = rng.uniform2(key, fr.DIRECTION)


@inline
def toss(work):
    """Let half of the rays go by coarse directions, and make new random numbers of what is left of CHOICE."""
    lane = work.forecast.lane
    for i in range(LANES):
        coarse = ONE if lane[CHOICE + i] >= HALF else ZERO
        lane[COIN + i] = coarse
        lane[CHOICE + i] = min(ALMOST_ONE, TWO * lane[CHOICE + i] - coarse)


@inline
def by_brdf(scene, work, glossy):
    """DIRECTION from the BRDF."""
    lane = work.forecast.lane
    words = lane.view(np.int32)
    for i in range(LANES):
        local = warp.cosine_hemisphere(lane[U + i], lane[V + i])
        put3(lane, DIRECTION, i, vec.to_world(local, get3(lane, NORMAL, i)))
    if glossy:
        for i in range(LANES):
            material = work.now.tags[i, 0]
            if words[COUNT + i] > 0 and scene.kind[material] == PHONG:
                at = get(work.now, i)
                u, v = lane[U + i], lane[V + i]
                put3(lane, DIRECTION, i, bsdf.sample(scene, material, at.n, at.wo, lane[CHOICE + i], u, v))


@inline
def by_coin(maps, work):
    """DIRECTION from the coarse directions where COIN says so, else as it is."""
    near = work.forecast
    lane = near.lane
    words = lane.view(np.int32)
    for i in range(LANES):
        words[BIN + i] = 0
        if words[COUNT + i] > 0 and lane[COIN + i] > ZERO:
            words[BIN + i] = warp.pick(maps.coarse[near.cluster[i]], lane[CHOICE + i])
    for i in range(LANES):
        x, y, z = cm.in_coarse_bin(words[BIN + i], lane[U + i], lane[V + i])
        coarse, other = lane[COIN + i] > ZERO, get3(lane, DIRECTION, i)
        put3(lane, DIRECTION, i, (x if coarse else other[0], y if coarse else other[1], z if coarse else other[2]))


@inline
def by_cluster(maps, work):
    """DIRECTION from the coarse directions of the cluster."""
    lane = work.forecast.lane
    for i in range(LANES):
        lane[COIN + i] = ONE
    by_coin(maps, work)


@inline
def by_cones(work, j, others):
    """DIRECTION from the cones of anchors or cells, one in each stratum of their photons."""
    near = work.forecast
    lane = near.lane
    words = lane.view(np.int32)
    for i in range(LANES):
        axis, height = (ZERO, ZERO, ONE), ONE
        if words[COUNT + i] > j:
            stratum = (np.float32(j - others) + lane[CHOICE + i]) / np.float32(words[COUNT + i] - others)
            axis, height = cm.choose_cone(near, i, min(ALMOST_ONE, stratum))
        put3(lane, AXIS, i, axis)
        lane[HEIGHT + i] = height
    for i in range(LANES):
        put3(lane, DIRECTION, i, cm.in_cone(get3(lane, AXIS, i), lane[HEIGHT + i], lane[U + i], lane[V + i]))


@inline
def send(scene, maps, work, j, others, glossy):
    """Let the rays wait whose DIRECTION lies above the horizon, as number j of their vertices.

    Their density is that of all samplers of a vertex in sum, times how often each is asked: the balance heuristic
    [Veach 1997, (9.8)].
    """
    near, rays = work.forecast, work.rays
    lane = near.lane
    words = lane.view(np.int32)
    share = HALF * np.float32(others)
    for i in range(LANES):
        direction = get3(lane, DIRECTION, i)
        cosine = vec.dot(get3(lane, NORMAL, i), direction)
        lane[COSINE + i] = cosine
        lane[BRDF + i] = warp.cosine_hemisphere_pdf(cosine)
        words[BIN + i] = cm.coarse_bin(direction)
        lane[REACH + i] = INFINITY if (words[COUNT + i] > j) & (cosine > ZERO) else fr.OUT_OF_USE
    for i in range(LANES):
        lane[STEERED + i] = ONE
        if lane[REACH + i] > ZERO:
            density = share * cm.coarse_density(maps, near.cluster[i], np.int64(words[BIN + i]))
            steered = words[COUNT + i] - others
            if steered > 0:
                density += np.float32(steered) * cm.cones_pdf(near, i, get3(lane, DIRECTION, i))
            lane[STEERED + i] = density
    for i in range(LANES):
        density = share * lane[BRDF + i] + lane[STEERED + i]
        put3(lane, WEIGHT, i, vec.scale(get3(lane, SHADE, i), lane[COSINE + i] / density))
    if glossy:
        _weigh_gloss(scene, work, share)
    for i in range(LANES):
        lane[REACH + i] = lane[REACH + i] if vec.max3(get3(lane, WEIGHT, i)) > ZERO else fr.OUT_OF_USE
    for row in range(fr.RAY_WORDS):
        lanes.copy(lane, DIRECTION + LANES * row, rays.reals, fr.PACKET_WORDS * j + LANES * row)
    keys = lane.view(np.uint64)
    for i in range(LANES):
        rays.counts[j, i] = fr.ANYTHING
        rays.key[j, i] = keys[RAY_KEY // 2 + i]


@inline
def _weigh_gloss(scene, work, share):
    """WEIGHT of lanes with gloss."""
    lane = work.forecast.lane
    for i in range(LANES):
        material = work.now.tags[i, 0]
        if lane[REACH + i] > ZERO and scene.kind[material] == PHONG:
            at, direction = get(work.now, i), get3(lane, DIRECTION, i)
            density = share * bsdf.pdf(scene, material, at.n, at.wo, direction) + lane[STEERED + i]
            f = bsdf.evaluate(scene, material, at.n, at.wo, direction)
            put3(lane, WEIGHT, i, vec.mul(at.throughput, vec.scale(f, lane[COSINE + i] / density)))
