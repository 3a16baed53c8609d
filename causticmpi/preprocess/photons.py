"""Forecast photons: caustic points, stored wherever a particle met S and then D, at any depth of its path [CF sec.
3.2].

So L D S D (secondary caustics, the spot on the green wall) is forecast too. None is stored at specular vertices.
"""

from typing import Any, NamedTuple

import numpy as np

from causticmpi.kernels import lanes, rng
from causticmpi.kernels import particle_waves as waves
from causticmpi.kernels import path_layout as at
from causticmpi.kernels.aim import NATURAL
from causticmpi.kernels.embree import LANES
from causticmpi.kernels.jit import inline, kernel
from causticmpi.kernels.material_kinds import MIRROR
from causticmpi.kernels.particle_emission import emit_aimed
from causticmpi.kernels.traced_scene import TracedScene
from causticmpi.kernels.wavefront import CHAIN_NAME, CURVATURE, ENTRIES, arrive, leave, wavefronts


class CausticPoints(NamedTuple):
    """position (n, 3), normal (n, 3) on the lit side, direction (n, 3) back to the specular surface, power (n, 3): the
    flux of the whole lights, not yet divided by the number of particles emitted; curvature (n, 6): of its wavefront
    there, ∂(-direction)/∂position [1 / scene units], see `wavefront`. float32. chain (n,) int32: name of the specular
    chain that it came by, the same for no other but by chance."""

    position: Any
    normal: Any
    direction: Any
    power: Any
    curvature: Any
    chain: Any


def no_points(count: int) -> CausticPoints:
    """Room for so many caustic points, all zero."""
    position, normal, direction, power, curvature = (
        np.zeros((count, columns), np.float32) for columns in (3, 3, 3, 3, ENTRIES)
    )
    return CausticPoints(position, normal, direction, power, curvature, np.zeros(count, np.int32))


class _Found(NamedTuple):
    """Caustic points of one group in the order found: point (n, 18) float32, chain (n,) int32, the next point of the
    same particle, -1 for none (n,) int32; the first and last of each particle (GROUP,) int32, for those whose bit is
    set in some (GROUP / 64,) uint64."""

    point: Any
    chain: Any
    next: Any
    first: Any
    last: Any
    some: Any


def _room(points: int) -> _Found:
    return _Found(
        point=np.zeros((points, 18), np.float32),
        chain=np.zeros(points, np.int32),
        next=np.zeros(points, np.int32),
        first=np.zeros(waves.GROUP, np.int32),
        last=np.zeros(waves.GROUP, np.int32),
        some=np.zeros(waves.GROUP // 64, np.uint64),
    )


@inline
def _note(scene, work, found, count):
    """Note the caustic points of a block that has met its surfaces. Returns how many the group has."""
    words = work.view(np.int32)
    for i in range(LANES):
        kind = words[at.KIND + i]
        words[at.LIGHT + i] = np.int32((words[at.CHAIN + i] > 0) & (kind >= 0) & (kind < MIRROR))
    caustic = lanes.marked(work, at.LIGHT)
    if count + lanes.count(caustic) > found.next.shape[0]:
        return count + lanes.count(caustic)
    while caustic > 0:
        i = lanes.first(caustic)
        caustic &= caustic - 1
        for c in range(3):
            found.point[count, c] = work[at.POINT + 16 * c + i]
            found.point[count, 3 + c] = work[at.NORMAL + 16 * c + i]
            found.point[count, 6 + c] = -work[at.DIRECTION + 16 * c + i]
            found.point[count, 9 + c] = work[at.THROUGHPUT + 16 * c + i]
        for k in range(ENTRIES):
            found.point[count, 12 + k] = work[CURVATURE + 16 * k + i]
        found.chain[count] = words[CHAIN_NAME + i]
        particle = words[at.PIXEL + i]
        word, bit = particle >> 6, np.uint64(1) << np.uint64(particle & 63)
        found.next[count] = -1
        if found.some[word] & bit:
            found.next[found.last[particle]] = count
        else:
            found.some[word] |= bit
            found.first[particle] = count
        found.last[particle] = count
        count += 1
    return count


@inline
def _store(found, points, stored):
    """Hand over the points of a group, particle by particle. Returns (stored, particles until the last one needed)."""
    for word in range(waves.GROUP // 64):
        left = found.some[word]
        while left:
            particle = 64 * word + lanes.first(np.int64(left))
            left &= left - np.uint64(1)
            k = found.first[particle]
            while k >= 0 and stored < points.power.shape[0]:
                for c in range(3):
                    points.position[stored, c] = found.point[k, c]
                    points.normal[stored, c] = found.point[k, 3 + c]
                    points.direction[stored, c] = found.point[k, 6 + c]
                    points.power[stored, c] = found.point[k, 9 + c]
                for c in range(ENTRIES):
                    points.curvature[stored, c] = found.point[k, 12 + c]
                points.chain[stored] = found.chain[k]
                stored += 1
                k = found.next[k]
            if stored == points.power.shape[0]:
                return stored, particle + 1
    return stored, waves.GROUP


@kernel
def _shoot(scene, work, queues, fronts, seed, first, last, aim, points, stored, found):
    """Particles first … last-1, emitted by `aim`; stops when `points` is full.

    work, queues: `particle_waves.particle_work`; fronts: `wavefront.wavefronts`. Returns (stored, next particle, rays
    traced, points of the last group): if that is more than `found` has room for, nothing of the group was stored, and
    it is the next.
    """
    traced, count = 0, 0
    while first < last and stored < points.power.shape[0]:
        end = min(last, first + waves.GROUP)
        found.some[:] = 0
        waiting = 0
        for number in range(0, end - first, LANES):
            emit_aimed(scene, work, aim, seed, rng.PHOTON, 0, first + number, end, number)
            waiting = waves.wait(work, queues[0], waiting)
        count, rays = waves.walk(scene, work, queues, waiting, arrive, leave, fronts, _note, found, 0)
        traced += rays
        if count > found.next.shape[0]:
            return stored, first, traced, count
        stored, needed = _store(found, points, stored)
        first += min(needed, end - first)
    return stored, first, traced, count


MOST_PARTICLES_PER_PHOTON = 400
"""The shooting gives up after this many particles per caustic point asked for: then few reach a specular surface."""


def shoot_photons(
    scene: TracedScene, seed: int, count: int, aim: np.ndarray = NATURAL
) -> tuple[CausticPoints, int, int]:
    """Shoot until `count` caustic points are found, or nearly nothing reaches a specular surface.

    The points are in the order of their particles, and along each; the particle that makes the last one is the last
    emitted. (Its group is traced to the end, and some rays in vain.)
    aim (7,) float32: see kernels.aim; whatever it is, the points' power over the particles emitted is unbiased.
    Returns the points found, the particles emitted and the rays traced.
    """
    points = no_points(count)
    work, queues = waves.particle_work()
    fronts = wavefronts()
    found = _room(4 * waves.GROUP)
    stored = emitted = traced = 0
    limit = MOST_PARTICLES_PER_PHOTON * count
    while stored < count and emitted < limit:
        batch = min(limit - emitted, 1 << 20)
        last = emitted + batch
        stored, emitted, rays, lately = _shoot(
            scene, work, queues, fronts, seed, emitted, last, aim, points, stored, found
        )
        traced += rays
        if lately > len(found.next):
            found = _room(2 * lately)
    return CausticPoints(*(a[:stored] for a in points)), emitted, traced
