"""Materials: the non-specular ones (Lambert, Phong) with value, sampler and pdf; the specular ones as a scattering
step.

All directions point away from the surface; normals are turned to the side of the eye before they come here.
Phong-like gloss, energy conserving for reflectance + specular <= 1 [Lafortune, Willems 1994]:
    f = kd/pi + ks (n+2)/(2 pi) cos^n(alpha),   alpha between w_i and the mirror image of w_o.
"""

import math

import numpy as np

from causticmpi.kernels import vec, warp
from causticmpi.kernels.jit import inline
from causticmpi.kernels.material_kinds import MIRROR, PHONG
from causticmpi.kernels.vec import HALF, INV_PI, INV_TWO_PI, ONE, TWO, ZERO


@inline
def evaluate(scene, material, n, wo, wi):
    """BRDF f [1/sr], an RGB tuple; wo and wi above the horizon of n is the caller's duty."""
    f = vec.scale(vec.row(scene.reflectance, material), INV_PI)
    if scene.kind[material] == PHONG:
        c = vec.dot(vec.reflect(wo, n), wi)
        if c > ZERO:
            e = scene.exponent[material]
            f = vec.add(f, vec.scale(vec.row(scene.specular, material), (e + TWO) * INV_TWO_PI * c**e))
    return f


@inline
def lobe_share(scene, material):
    """Probability of sampling the Phong lobe rather than the cosine."""
    if scene.kind[material] != PHONG:
        return ZERO
    ks = vec.max3(vec.row(scene.specular, material))
    kd = vec.max3(vec.row(scene.reflectance, material))
    return ks / (ks + kd) if ks + kd > ZERO else ZERO


@inline
def sample(scene, material, n, wo, choice, u, v):
    """Direction with density `pdf`; it may lie below the horizon, where the BRDF counts nothing."""
    if choice < lobe_share(scene, material):
        return vec.to_world(warp.phong_lobe(u, v, scene.exponent[material]), vec.reflect(wo, n))
    return vec.to_world(warp.cosine_hemisphere(u, v), n)


@inline
def pdf(scene, material, n, wo, wi):
    """Density of `sample` (solid angle)."""
    share = lobe_share(scene, material)
    p = (ONE - share) * warp.cosine_hemisphere_pdf(vec.dot(n, wi))
    if share > ZERO:
        p += share * warp.phong_lobe_pdf(vec.dot(vec.reflect(wo, n), wi), scene.exponent[material])
    return p


@inline
def sample_weight(scene, material, n, wo, choice, u, v):
    """Direction of `sample` and f cos / pdf; black below the horizon."""
    if scene.kind[material] != PHONG:
        return vec.to_world(warp.cosine_hemisphere(u, v), n), vec.row(scene.reflectance, material)
    wi = sample(scene, material, n, wo, choice, u, v)
    cosine = vec.dot(n, wi)
    p = pdf(scene, material, n, wo, wi)
    if cosine <= ZERO or p <= ZERO:
        return wi, vec.BLACK
    return wi, vec.scale(evaluate(scene, material, n, wo, wi), cosine / p)


@inline
def albedo(scene, material):
    """Upper bound of the reflected fraction, RGB."""
    return vec.add(vec.row(scene.reflectance, material), vec.row(scene.specular, material))


@inline
def peak(scene, material):
    """Largest pi f of the material over all directions, at least 1: how much sharper than white Lambert it can be."""
    if scene.kind[material] != PHONG:
        return ONE
    ks = vec.max3(vec.row(scene.specular, material))
    kd = vec.max3(vec.row(scene.reflectance, material))
    return max(ONE, kd + ks * (scene.exponent[material] + TWO) * HALF)


@inline
def fresnel(cosine, eta):
    """Unpolarized reflectance of a smooth dielectric, and the cosine inside.

    cosine: of the incident side, > 0; eta: n_incident / n_transmitted. Total internal reflection: (1, 0).
    """
    sine2 = eta * eta * max(ZERO, ONE - cosine * cosine)
    if sine2 >= ONE:
        return ONE, ZERO
    inner = math.sqrt(ONE - sine2)
    s = (eta * cosine - inner) / (eta * cosine + inner)
    p = (cosine - eta * inner) / (cosine + eta * inner)
    return HALF * (s * s + p * p), inner


@inline
def scatter_specular(scene, material, n, direction, u):
    """One specular event: new direction, reflectance or transmittance / probability (RGB), eta, whether it refracted
    and the probability of that.

    n: front normal (out of the denser side); direction: of the arriving ray; u: uniform.
    eta = n_incident/n_transmitted seen along the ray. Radiance carried back along an eye path that refracts scales with
    eta^2 [Veach 1997, sec. 5.2]; the flux of a particle does not. The caller applies it.
    """
    cosine = -vec.dot(direction, n)
    if scene.kind[material] == MIRROR:
        return vec.along(direction, n, TWO * cosine), vec.row(scene.reflectance, material), ONE, False, ONE
    ior = scene.ior[material]
    side = n
    eta = ONE / ior
    if cosine < ZERO:  # arriving from the denser side
        side, eta, cosine = vec.neg(n), ior, -cosine
    reflected, inner = fresnel(cosine, eta)
    if u < reflected:
        return vec.along(direction, side, TWO * cosine), vec.WHITE, ONE, False, reflected
    out = vec.along(vec.scale(direction, eta), side, eta * cosine - inner)
    return vec.normalize(out), vec.WHITE, eta, True, ONE - reflected


ROULETTE_START = 16
SURVIVAL = np.float32(0.95)
"""Light trapped in lossless glass: from this many specular bounces in a row on, each survives with this probability."""
