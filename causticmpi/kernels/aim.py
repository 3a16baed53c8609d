"""Emission from a light towards a box, mixed with natural emission [CF sec. 3.2]: sampler and density side by side.

An aimed direction leads to a uniform point of those faces of the box that are seen from the light's point. It is one
half of a mixture whose other half is the natural cosine, and every particle carries flux over the density of the whole
mixture: the expected flux along every path, also one that never comes near the box, is that of natural emission.
An aim is an array (7,) float32: least corner, greatest corner, share of aimed particles.
"""

import numpy as np

from causticmpi.kernels import vec, warp
from causticmpi.kernels.jit import inline
from causticmpi.kernels.vec import ALMOST_ONE, INV_PI, ONE, PI, ZERO

NATURAL = np.zeros(7, np.float32)
"""No aim: cosine emission alone."""
_TOLERANCE = np.float32(1e-5)


@inline
def _face(aim, p, axis):
    """Coordinate and area of the face across an axis that p sees; the area is 0 where it sees none."""
    low, high = aim[axis], aim[3 + axis]
    if low <= p[axis] <= high:
        return low, ZERO
    b, c = (axis + 1) % 3, (axis + 2) % 3
    return low if p[axis] < low else high, (aim[3 + b] - aim[b]) * (aim[3 + c] - aim[c])


@inline
def _area(aim, p):
    """Area of all faces that p sees; 0 inside the box."""
    return _face(aim, p, 0)[1] + _face(aim, p, 1)[1] + _face(aim, p, 2)[1]


@inline
def aimed_share(aim, p, n):
    """Share of aimed particles at p: 0 inside the box, and where all of it lies behind the plane of normal n."""
    if aim[6] <= ZERO or _area(aim, p) <= ZERO:
        return ZERO
    support = ZERO
    for c in range(3):
        support += max(n[c] * (aim[c] - p[c]), n[c] * (aim[3 + c] - p[c]))
    return aim[6] if support > ZERO else ZERO


@inline
def sample_aimed(aim, p, choice, u, v):
    """Unit direction from p, outside the box, to it, with `aimed_pdf`."""
    target = choice * _area(aim, p)
    axis = 0
    area = _face(aim, p, 0)[1]
    while axis < 2 and (target >= area or area <= ZERO):
        target -= area
        axis += 1
        area = _face(aim, p, axis)[1]
    at = _face(aim, p, axis)[0]
    b, c = (axis + 1) % 3, (axis + 2) % 3
    x = at - p[axis]
    y = aim[b] + u * (aim[3 + b] - aim[b]) - p[b]
    z = aim[c] + v * (aim[3 + c] - aim[c]) - p[c]
    if axis == 0:
        d = (x, y, z)
    elif axis == 1:
        d = (z, x, y)
    else:
        d = (y, z, x)
    return vec.normalize(d)


@inline
def aimed_pdf(aim, p, direction):
    """Density of `sample_aimed` (solid angle); 0 for directions that miss the box.

    The face through which a ray enters is the last of those planes that it crosses.
    """
    entry, axis = ZERO, -1
    for c in range(3):
        at, _ = _face(aim, p, c)
        if (p[c] < aim[c] or p[c] > aim[3 + c]) and direction[c] != ZERO:
            t = (at - p[c]) / direction[c]
            if t > entry:
                entry, axis = t, c
    if axis < 0:
        return ZERO
    cosine = ZERO
    for c in range(3):
        if c == axis:
            cosine = abs(direction[c])
            continue
        x = p[c] + entry * direction[c]
        slack = _TOLERANCE * (entry + abs(p[c]))
        if x < aim[c] - slack or x > aim[3 + c] + slack:
            return ZERO
    return entry * entry / (cosine * _area(aim, p))


@inline
def emission(aim, p, n, choice, u, v):
    """Direction of a particle from p on a light of normal n, and cos / density of the mixture (pi if natural)."""
    share = aimed_share(aim, p, n)
    if share <= ZERO:
        return vec.to_world(warp.cosine_hemisphere(u, v), n), PI
    if choice < share:
        direction = sample_aimed(aim, p, min(choice / share, ALMOST_ONE), u, v)
    else:
        direction = vec.to_world(warp.cosine_hemisphere(u, v), n)
    cosine = vec.dot(n, direction)
    if cosine <= ZERO:
        return direction, ZERO
    return direction, cosine / ((ONE - share) * cosine * INV_PI + share * aimed_pdf(aim, p, direction))
