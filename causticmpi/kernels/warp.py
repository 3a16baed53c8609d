"""Samplers of directions and points, each beside its pdf."""

import math

import numpy as np

from causticmpi.kernels.jit import inline
from causticmpi.kernels.vec import HALF, INV_PI, INV_TWO_PI, ONE, TWO, TWO_PI, ZERO

QUARTER = np.float32(0.25)
_S3, _S5, _S7, _S9, _S11 = (np.float32((-1) ** (n // 2) / math.factorial(n)) for n in (3, 5, 7, 9, 11))
_C2, _C4, _C6, _C8, _C10, _C12 = (np.float32((-1) ** (n // 2) / math.factorial(n)) for n in (2, 4, 6, 8, 10, 12))
"""Taylor coefficients: over a quarter turn the first one left out is below the rounding of float32."""


@inline
def turn(v):
    """Cosine and sine of v turns, 0 <= v < 1, to 2e-7: polynomials, so that loops over lanes become vector code."""
    y = v - HALF
    b = QUARTER - abs(y)  # cos(2 pi |y|) = sin(2 pi b), sin(2 pi |y|) = cos(2 pi b), |b| <= 1/4
    x = TWO_PI * b
    x2 = x * x
    sine = x * (ONE + x2 * (_S3 + x2 * (_S5 + x2 * (_S7 + x2 * (_S9 + x2 * _S11)))))
    cosine = ONE + x2 * (_C2 + x2 * (_C4 + x2 * (_C6 + x2 * (_C8 + x2 * (_C10 + x2 * _C12)))))
    return -sine, -cosine if y > ZERO else cosine


_A1, _A3, _A5, _A7, _A9, _A11, _A13, _A15 = (
    np.float32(a)
    for a in (
        0.159154837, -0.0530461206, 0.0317459411, -0.0221362511,
        0.0153459824, -0.00889865443, 0.00347955095, -0.000645291662,
    )
)  # fmt: skip
"""Odd powers of arctan(x) / (2 pi), |x| <= 1: least largest error, 6e-9."""


@inline
def turns(x, y):
    """The inverse of `turn`: v in [0, 1) of the direction (x, y), to 1e-7; 0 for (0, 0)."""
    a, b = abs(x), abs(y)
    greater, less = max(a, b), min(a, b)
    t = less / greater if greater > ZERO else ZERO
    t2 = t * t
    high = _A9 + t2 * (_A11 + t2 * (_A13 + t2 * _A15))
    v = t * (_A1 + t2 * (_A3 + t2 * (_A5 + t2 * (_A7 + t2 * high))))
    v = QUARTER - v if b > a else v
    v = HALF - v if x < ZERO else v
    v = ONE - v if y < ZERO else v
    return v if v < ONE else ZERO


@inline
def cosine_hemisphere(u, v):
    """Direction about +z with a density of cos / pi (solid angle)."""
    # cos^2 = 1 - u stays above 0 for u < 1: no direction lies in the surface itself.
    r = math.sqrt(u)
    c, s = turn(v)
    return r * c, r * s, math.sqrt(ONE - u)


@inline
def cosine_hemisphere_pdf(cosine):
    """1/sr; 0 below the horizon."""
    return max(ZERO, cosine) * INV_PI


@inline
def phong_lobe(u, v, exponent):
    """Direction about +z with a density of (n+1)/(2 pi) cos^n (solid angle)."""
    cosine = (ONE - u) ** (ONE / (exponent + ONE))
    sine = math.sqrt(max(ZERO, ONE - cosine * cosine))
    c, s = turn(v)
    return sine * c, sine * s, cosine


@inline
def phong_lobe_pdf(cosine, exponent):
    """1/sr; 0 below the horizon of the lobe."""
    if cosine <= ZERO:
        return ZERO
    return (exponent + ONE) * INV_TWO_PI * cosine**exponent


@inline
def triangle_barycentrics(u, v):
    """Uniform point of a triangle as the weights of its second and third vertex; density 1/area (area)."""
    s = math.sqrt(u)
    return s * (ONE - v), s * v


@inline
def uniform_sphere(u, v):
    """Uniform direction; density 1/(4 pi) (solid angle)."""
    z = ONE - TWO * u
    r = math.sqrt(max(ZERO, ONE - z * z))
    c, s = turn(v)
    return r * c, r * s, z


@inline
def pick(cdf, u):
    """Index i with cdf[i-1] <= u < cdf[i] by bisection; never a row of zero width for 0 <= u < cdf[-1]."""
    low, left = 0, cdf.shape[0]
    while left > 1:  # no branch that hangs on u: half of them would be foretold wrongly
        half = left >> 1
        low += half * (cdf[low + half - 1] <= u)
        left -= half
    return low


UNIFORM_SPHERE_PDF = np.float32(1 / (4 * math.pi))
