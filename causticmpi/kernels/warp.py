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
    phi = TWO_PI * v
    return sine * math.cos(phi), sine * math.sin(phi), cosine


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
    phi = TWO_PI * v
    return r * math.cos(phi), r * math.sin(phi), z


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
