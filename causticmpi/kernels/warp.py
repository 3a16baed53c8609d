"""Samplers of directions and points, each beside its pdf."""

import math

import numpy as np

from causticmpi.kernels.jit import inline
from causticmpi.kernels.vec import INV_PI, INV_TWO_PI, ONE, TWO, TWO_PI, ZERO


@inline
def cosine_hemisphere(u, v):
    """Direction about +z with a density of cos / pi (solid angle)."""
    # cos^2 = 1 - u stays above 0 for u < 1: no direction lies in the surface itself.
    r = math.sqrt(u)
    phi = TWO_PI * v
    return r * math.cos(phi), r * math.sin(phi), math.sqrt(ONE - u)


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
    low, high = 0, cdf.shape[0] - 1
    while low < high:
        middle = (low + high) >> 1
        if u < cdf[middle]:
            high = middle
        else:
            low = middle + 1
    return low


UNIFORM_SPHERE_PDF = np.float32(1 / (4 * math.pi))
