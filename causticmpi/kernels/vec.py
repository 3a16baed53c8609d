"""Three-vectors as tuples of three float32: they live in registers."""

import math

import numpy as np

from causticmpi.kernels.jit import inline

ZERO, ONE, TWO, HALF = np.float32(0), np.float32(1), np.float32(2), np.float32(0.5)
ALMOST_ONE = np.float32(0.99999994)
"""The largest float32 below 1."""
PI = np.float32(math.pi)
TWO_PI = np.float32(2 * math.pi)
INV_PI = np.float32(1 / math.pi)
INV_TWO_PI = np.float32(0.5 / math.pi)
INFINITY = np.float32(np.inf)
BLACK = (ZERO, ZERO, ZERO)
WHITE = (ONE, ONE, ONE)


@inline
def row(array, i):
    """Row i of an (n, >=3) array."""
    return array[i, 0], array[i, 1], array[i, 2]


@inline
def add(a, b):
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@inline
def sub(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inline
def mul(a, b):
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@inline
def scale(a, s):
    return a[0] * s, a[1] * s, a[2] * s


@inline
def along(origin, direction, t):
    return origin[0] + t * direction[0], origin[1] + t * direction[1], origin[2] + t * direction[2]


@inline
def neg(a):
    return -a[0], -a[1], -a[2]


@inline
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inline
def cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inline
def normalize(a):
    return scale(a, ONE / math.sqrt(dot(a, a)))


@inline
def max3(a):
    return max(a[0], max(a[1], a[2]))


@inline
def luminance(a):
    """Rec.709 luminance of linear radiance."""
    return np.float32(0.2126) * a[0] + np.float32(0.7152) * a[1] + np.float32(0.0722) * a[2]


@inline
def frame(n):
    """Tangent and bitangent of the unit normal n [Duff et al., JCGT 6(1), 2017]."""
    s = math.copysign(ONE, n[2])
    a = -ONE / (s + n[2])
    b = n[0] * n[1] * a
    return (ONE + s * n[0] * n[0] * a, s * b, -s * n[0]), (b, s + n[1] * n[1] * a, -n[1])


@inline
def to_world(local, n):
    """Direction given in the frame of n."""
    t, b = frame(n)
    return (
        local[0] * t[0] + local[1] * b[0] + local[2] * n[0],
        local[0] * t[1] + local[1] * b[1] + local[2] * n[1],
        local[0] * t[2] + local[1] * b[2] + local[2] * n[2],
    )


@inline
def to_local(world, n):
    """Direction in the frame of n."""
    t, b = frame(n)
    return dot(world, t), dot(world, b), dot(world, n)


@inline
def reflect(w, n):
    """Mirror image of w (pointing away from the surface) about n."""
    d = TWO * dot(w, n)
    return d * n[0] - w[0], d * n[1] - w[1], d * n[2] - w[2]


@inline
def closest_axis(n):
    """Which of the six half axes a vector is closest to: 0 for +x, 1 for -x, … 5 for -z."""
    ax, ay, az = abs(n[0]), abs(n[1]), abs(n[2])
    axis, sign = 2, n[2]
    if ax >= ay and ax >= az:
        axis, sign = 0, n[0]
    elif ay >= az:
        axis, sign = 1, n[1]
    return 2 * axis + (1 if sign < ZERO else 0)
