"""How the light that a particle stands for spreads: the curvature of its wavefront, carried along specular chains, and
which chain that is.

Rays from one point of a light are perpendicular to wavefronts, and stay so through mirrors and glass (Malus, Dupin). At
a caustic point the symmetric matrix D = ∂d/∂x therefore tells how the direction d from which that point of the light is
seen turns as the place x moves [Igehy 1999, ray differentials; here six numbers instead of twelve]:

    along a ray    D' = (D + t K (1 - d dᵀ)) / (1 + t tr D + t² K),  K the product of the principal curvatures
    at a surface   P D₂ P = P (η D₁ - γ S) P,  γ = (η d₁ - d₂)·n,  S = ∂n/∂x,  D₂ d₂ = 0,  P = 1 - n nᵀ

(the difference of the gradients of the phase is along n all over the surface; η = 1 for a mirror, n₁ / n₂ refracted).
Curvatures are in 1 / scene units, positive where light spreads. Behind a light or a non-specular vertex it comes from a
point: D = (1 - d dᵀ) / t.
"""

import math
from typing import Any

import numpy as np

from causticmpi.kernels import lanes, vec
from causticmpi.kernels import path_layout as at
from causticmpi.kernels.embree import DIR, LANES, RAY16
from causticmpi.kernels.jit import inline
from causticmpi.kernels.path_layout import get3
from causticmpi.kernels.vec import ONE, ZERO

ENTRIES = 6
"""Of a symmetric matrix: xx, xy, xz, yy, yz, zz."""
CURVATURE, CHAIN_NAME = at.PACKETS, at.PACKETS + LANES * ENTRIES
"""Their rows in the lanes of particles, which send no packets of their own: the curvature, and int32 that tells the
shapes and whether they reflected or let through, since the light or the last non-specular vertex."""
CARRIED = ENTRIES + 1
"""Rows that a particle carries."""
_LEAST = np.float32(1e-6)
"""Focus and grazing rays: what is divided by is no closer to 0."""
_NEAREST = np.float32(1e-12)
"""Light that comes from where it is, as between surfaces that touch, has a curvature that is finite all the same: one
photon that is not would have the whole forecast refused."""


def wavefronts() -> np.ndarray:
    """What particles carry along in queues beside those of two waves: (2, words) float32."""
    return np.zeros((2, CARRIED * at.ROOM), np.float32)


@inline
def times(m, v):
    """A symmetric matrix times a vector."""
    return (
        m[0] * v[0] + m[1] * v[1] + m[2] * v[2],
        m[1] * v[0] + m[3] * v[1] + m[4] * v[2],
        m[2] * v[0] + m[4] * v[1] + m[5] * v[2],
    )


@inline
def get6(work, row, lane):
    """Six rows of a lane as a symmetric matrix."""
    return (
        work[row + lane],
        work[row + 16 + lane],
        work[row + 32 + lane],
        work[row + 48 + lane],
        work[row + 64 + lane],
        work[row + 80 + lane],
    )


@inline
def put6(work, row, lane, m):
    work[row + lane], work[row + 16 + lane], work[row + 32 + lane] = m[0], m[1], m[2]
    work[row + 48 + lane], work[row + 64 + lane], work[row + 80 + lane] = m[3], m[4], m[5]


@inline
def _away_from_zero(x):
    least = max(abs(x), _LEAST)
    return least if x >= ZERO else -least


@inline
def _plus_product(m, a, b, s):
    """m + s (a bᵀ + b aᵀ) / 2."""
    h = s * np.float32(0.5)
    return (
        m[0] + s * a[0] * b[0],
        m[1] + h * (a[0] * b[1] + a[1] * b[0]),
        m[2] + h * (a[0] * b[2] + a[2] * b[0]),
        m[3] + s * a[1] * b[1],
        m[4] + h * (a[1] * b[2] + a[2] * b[1]),
        m[5] + s * a[2] * b[2],
    )


@inline
def spread(m, d, t):
    """The curvature D = m of light along d, a way t farther on."""
    product = m[0] * m[3] - m[1] * m[1] + m[0] * m[5] - m[2] * m[2] + m[3] * m[5] - m[4] * m[4]
    share = ONE / _away_from_zero(ONE + t * (m[0] + m[3] + m[5] + t * product))
    k = t * product
    flat = (m[0] + k, m[1], m[2], m[3] + k, m[4], m[5] + k)
    n = _plus_product(flat, d, d, -k)
    return (n[0] * share, n[1] * share, n[2] * share, n[3] * share, n[4] * share, n[5] * share)


@inline
def from_point(d, t):
    """The curvature of light from a point, along d, a way t off."""
    k = ONE / max(t, _NEAREST)
    return _plus_product((k, ZERO, ZERO, k, ZERO, k), d, d, -k)


@inline
def bent(m, d, out, n, eta, round_):
    """The curvature D = m of light along d once a surface has sent it along `out`; n: normal; eta: ratio of indices, 1
    for a mirror; round_: ∂n/∂x of the surface, the same both ways."""
    # P is left out: what lies along n is taken away by D₂ d₂ = 0 as well.
    k = vec.dot(vec.sub(vec.scale(d, eta), out), n) * round_
    b = (m[0] * eta - k, m[1] * eta, m[2] * eta, m[3] * eta - k, m[4] * eta, m[5] * eta - k)
    share = ONE / _away_from_zero(vec.dot(n, out))
    along = times(b, out)
    b = _plus_product(b, along, n, np.float32(-2) * share)
    return _plus_product(b, n, n, vec.dot(along, out) * share * share)


@inline
def _either(which, a, b):
    return (
        a[0] if which else b[0],
        a[1] if which else b[1],
        a[2] if which else b[2],
        a[3] if which else b[3],
        a[4] if which else b[4],
        a[5] if which else b[5],
    )


@inline
def joined(name, shape, reflected):
    """Name of the chain `name` with one event more, at a shape."""
    # 2, as 0 and 1 are where chains begin.
    longer: Any = np.int32(np.int32(name * np.int32(0x343FD)) + np.int32(2) * shape + np.int32(reflected) + np.int32(2))
    return np.int32(longer ^ ((longer >> np.int32(15)) & np.int32(0x1FFFF)))


@inline
def arrive(work, fronts, wave, block):
    """CURVATURE and CHAIN_NAME of the light of a block that has met its surfaces."""
    words = work.view(np.int32)
    for k in range(CARRIED):
        lanes.copy(fronts[wave & 1], k * at.ROOM + LANES * block, work, CURVATURE + LANES * k)
    for i in range(LANES):
        d, t = get3(work, at.DIRECTION, i), work[at.DISTANCE + i]
        old, new = spread(get6(work, CURVATURE, i), d, t), from_point(d, t)
        put6(work, CURVATURE, i, _either(words[at.CHAIN + i] > 0, old, new))


@inline
def leave(scene, work, fronts, wave, going_on):
    """CURVATURE and CHAIN_NAME behind the surfaces of a block that has been scattered, to wait with its rays behind
    `going_on`."""
    words = work.view(np.int32)
    for i in range(LANES):
        round_ = ONE / work[at.SIZE + i] if words[at.PRIMITIVE + i] >= scene.triangle_count else ZERO
        d, out, n = get3(work, at.DIRECTION, i), get3(work, RAY16 + 16 * DIR, i), get3(work, at.NORMAL, i)
        eta = math.sqrt(work[at.ETA2 + i])
        put6(work, CURVATURE, i, bent(get6(work, CURVATURE, i), d, out, n, eta, round_))
    for i in range(LANES):
        d, out, n = get3(work, at.DIRECTION, i), get3(work, RAY16 + 16 * DIR, i), get3(work, at.NORMAL, i)
        reflected = vec.dot(d, n) * vec.dot(out, n) < ZERO
        first = words[at.CHAIN + i] <= 1  # which counts this event already
        before = np.int32(words[at.DEPTH + i] > 0) if first else words[CHAIN_NAME + i]
        words[CHAIN_NAME + i] = joined(before, words[at.SHAPE + i], reflected)
    alive = lanes.marked(work, at.ALIVE)
    for k in range(CARRIED):
        lanes.pack(work, CURVATURE + LANES * k, alive, fronts[(wave + 1) & 1], k * at.ROOM + going_on)


@inline
def arrive_without(work, fronts, wave, block):
    """`arrive` of particles that carry no wavefront."""


@inline
def leave_without(scene, work, fronts, wave, going_on):
    """`leave` of particles that carry no wavefront."""
