"""Illumination by Weak Singularities (IWS) [CF sec. 3.1; Kollig, Keller 2004]: sums over virtual point lights.

The geometry term is bounded, and what the bound takes away is given back by a compensation ray:

    w(p, q) = min(1, b / (G s))         s = max(1, pi f_p) * peak_q        (eq. w)
    sum over VPLs: f_p G w f_q Phi      compensation: (1 - w) of the radiance of the vertex that a BRDF ray hits

The paper bounds G alone (s = 1), which leaves a sharp BRDF free to spike; bounding pi f G as well removes the spikes of
gloss. It stays unbiased for any s that both techniques compute alike: s depends on p, q and the eye direction at p
only.
"""

import numpy as np

from causticmpi.kernels import bsdf, vec
from causticmpi.kernels.embree import LANES, RAY16, TFAR, VALID, ray_buffer, rtc_occluded16, visible
from causticmpi.kernels.jit import inline
from causticmpi.kernels.material_kinds import DIFFUSE
from causticmpi.kernels.vec import ONE, PI, ZERO

POINT = RAY16  # the 16-wide ray's origins are the points, already moved off their surfaces
DIRECTION = RAY16 + 4 * LANES
REACH = RAY16 + TFAR * LANES
TILE = RAY16 + 24 * LANES
NORMAL, OUT, WEIGHT, SUM, EPSILON = TILE, TILE + 3 * LANES, TILE + 6 * LANES, TILE + 9 * LANES, TILE + 12 * LANES
WORDS = TILE + 13 * LANES
"""Layout of the packet workspace in float32 words: one array, so that LLVM sees that rows do not overlap. A lane is out
of use when its normal is 0. SUM collects the irradiance-like RGB sums."""


def packet_buffer() -> np.ndarray:
    """Aligned packet workspace; its head is a `kernels.embree.ray_buffer`."""
    return ray_buffer(WORDS - TILE)


@inline
def sharpness(f):
    """max(1, pi f): how much a BRDF value exceeds white Lambert."""
    return max(ONE, PI * vec.max3(f))


@inline
def bounded_share(geometry, sharp, bound):
    """w of eq. w: the part of a connection that the virtual lights carry; 1 - w is compensated."""
    g = geometry * sharp
    return ONE if g <= bound else bound / g


@inline
def _connect_lambert(packet, lights, j, bound):
    """Weights of virtual light j for 16 Lambertian points, w G in WEIGHT, and the shadow rays. Returns lanes in use.

    Written for LLVM's vectorizer: selections instead of branches and of min/max, an integer as the only reduction.
    """
    qx, qy, qz = lights.point[j, 0], lights.point[j, 1], lights.point[j, 2]
    mx, my, mz = lights.normal[j, 0], lights.normal[j, 1], lights.normal[j, 2]
    offset = lights.offset[j]
    limit = bound / lights.peak[j]
    alive = np.int32(0)
    for i in range(LANES):
        o = packet[EPSILON + i]
        o = o if o > offset else offset
        dx = qx + mx * o - packet[POINT + i]
        dy = qy + my * o - packet[POINT + 16 + i]
        dz = qz + mz * o - packet[POINT + 32 + i]
        inverse = ONE / (dx * dx + dy * dy + dz * dz)
        cp = packet[NORMAL + i] * dx + packet[NORMAL + 16 + i] * dy + packet[NORMAL + 32 + i] * dz
        cq = -(mx * dx + my * dy + mz * dz)
        cp = cp if cp > ZERO else ZERO
        cq = cq if cq > ZERO else ZERO
        w = (cp * inverse) * (cq * inverse)
        w = w if w < limit else limit
        packet[DIRECTION + i] = dx
        packet[DIRECTION + 16 + i] = dy
        packet[DIRECTION + 32 + i] = dz
        packet[WEIGHT + i] = w
        packet[REACH + i] = ONE if w > ZERO else -ONE
        alive += np.int32(w > ZERO)
    return alive


@inline
def _collect_lambert(packet, lights, j):
    r, g, b = lights.intensity[j, 0], lights.intensity[j, 1], lights.intensity[j, 2]
    for i in range(LANES):
        w = packet[WEIGHT + i] if packet[REACH + i] >= ZERO else ZERO
        packet[SUM + i] += w * r
        packet[SUM + 16 + i] += w * g
        packet[SUM + 32 + i] += w * b


@inline
def connection(scene, lights, j, p, n, offset, wo, material, bound):
    """f_p G w f_q Phi of one virtual light (RGB), before visibility, and the far end of its shadow ray.

    p: already moved off its surface by `offset`.
    """
    m = vec.row(lights.normal, j)
    q = vec.along(vec.row(lights.point, j), m, max(lights.offset[j], offset))
    d = vec.sub(q, p)
    cp, cq = vec.dot(n, d), -vec.dot(m, d)
    if cp <= ZERO or cq <= ZERO:
        return vec.BLACK, q
    inverse = ONE / vec.dot(d, d)
    geometry = (cp * inverse) * (cq * inverse)
    wi = vec.scale(d, np.float32(np.sqrt(inverse)))
    f = bsdf.evaluate(scene, material, n, wo, wi)
    value = vec.mul(f, vec.row(lights.intensity, j))
    mirror = lights.material[j]
    if mirror >= 0 and scene.kind[mirror] != DIFFUSE:
        value = vec.mul(value, bsdf.evaluate(scene, mirror, m, vec.row(lights.arrival, j), vec.neg(wi)))
    share = bounded_share(geometry, sharpness(f) * lights.peak[j], bound)
    return vec.scale(value, share * geometry), q


@inline
def gather_tile(scene, packet, lights, count, materials, glossy, bound):
    """Sum all virtual lights at the 16 points of a tile. Returns shadow rays traced.

    SUM then holds, times reflectance / pi, the radiance of a Lambertian lane; of a tile with gloss (`glossy`) the
    radiance itself, in which case `materials` (16,) int64 and OUT (directions to the eye) are read.
    """
    for i in range(3 * LANES):
        packet[SUM + i] = ZERO
    traced = 0
    for j in range(count):
        shiny = lights.material[j] >= 0 and scene.kind[lights.material[j]] != DIFFUSE
        if glossy or shiny:
            traced += _gather_light_of_any_kind(scene, packet, lights, j, materials, glossy, bound)
            continue
        alive = _connect_lambert(packet, lights, j, bound)
        if alive == 0:
            continue
        traced += alive
        rtc_occluded16(packet.ctypes.data + 4 * VALID, scene.handle, packet.ctypes.data + 4 * RAY16, 0)
        _collect_lambert(packet, lights, j)
    return traced


@inline
def _gather_light_of_any_kind(scene, packet, lights, j, materials, glossy, bound):
    traced = 0
    for i in range(LANES):
        n = (packet[NORMAL + i], packet[NORMAL + 16 + i], packet[NORMAL + 32 + i])
        if n[0] == ZERO and n[1] == ZERO and n[2] == ZERO:
            continue
        p = (packet[POINT + i], packet[POINT + 16 + i], packet[POINT + 32 + i])
        wo = (packet[OUT + i], packet[OUT + 16 + i], packet[OUT + 32 + i])
        value, q = connection(scene, lights, j, p, n, packet[EPSILON + i], wo, materials[i], bound)
        if vec.max3(value) <= ZERO:
            continue
        traced += 1
        if visible(scene.handle, packet, p, q):
            for c in range(3):
                x = value[c]
                if not glossy:  # the caller multiplies Lambertian tiles by reflectance / pi: undo it here
                    r = scene.reflectance[materials[i], c]
                    x = x * PI / r if r > ZERO else ZERO
                packet[SUM + 16 * c + i] += x
    return traced


@inline
def gather_few(scene, packet, lights, count, few, p, n, offset, wo, material, bound, u):
    """Unbiased estimate of the sum over all virtual lights from `few` of them, taken at equal steps from a random
    start.

    p: already moved off its surface; u: uniform. Returns (RGB radiance, shadow rays traced).
    """
    total = vec.BLACK
    traced = 0
    step = np.float32(count) / np.float32(few)
    if step < ONE:
        step = ONE
    position = u * step
    while np.int64(position) < count:
        value, q = connection(scene, lights, np.int64(position), p, n, offset, wo, material, bound)
        if vec.max3(value) > ZERO:
            traced += 1
            if visible(scene.handle, packet, p, q):
                total = vec.add(total, value)
        position += step
    return vec.scale(total, step), traced
