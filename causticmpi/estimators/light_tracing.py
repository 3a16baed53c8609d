"""Light tracing: caustics on diffuse surfaces that the eye sees directly, drawn by particles from the lights.

Wherever a particle meets S and then a diffuse surface in plain sight, its light goes straight onto the picture. These
splats own all of L_c there (`owns`), L S+ D E as well as L D S+ D E; caustics seen in or through something specular,
and those on gloss, no particle can draw: they are left to the forecast. The two never count the same path.
"""

from causticmpi.kernels import particles, rng, vec
from causticmpi.kernels.camera import film_position
from causticmpi.kernels.embree import visible
from causticmpi.kernels.emission import emit
from causticmpi.kernels.jit import inline, kernel
from causticmpi.kernels.material_kinds import DIFFUSE
from causticmpi.kernels.vec import INV_PI, ZERO


@inline
def owns(scene, material):
    """Whether splats draw the caustics on a directly seen surface of this material: on gloss they would spike."""
    return scene.kind[material] == DIFFUSE


@inline
def _splat(scene, camera, rays, window, at, film):
    """Draw the reflected flux of a particle's vertex onto the pixel that sees it. Returns shadow rays traced.

    A pixel is the mean of radiance over its area a = step^2 on the film at distance 1; the surface in it measures
    a r^2 cos^3(camera) / cos(at), r the distance of the eye.
    """
    eye = vec.row(camera, 0)
    d = vec.sub(at.p, eye)
    cosine = -vec.dot(at.n, d)  # times r
    if cosine <= ZERO:
        return 0
    x, y, depth = film_position(camera, d)
    if not (depth > ZERO and window[0] <= x < window[2] and window[1] <= y < window[3]):
        return 0
    if not visible(scene.handle, rays, vec.along(at.p, at.n, at.offset), eye):
        return 1
    right = vec.row(camera, 2)
    weight = cosine / (depth * depth * depth * vec.dot(right, right)) * INV_PI
    light = vec.scale(vec.mul(at.flux, vec.row(scene.reflectance, at.material)), weight)
    slot = (int(y) - window[1]) * (window[2] - window[0]) + int(x) - window[0]
    for c in range(3):
        film[slot, c] += light[c]
    return 1


@kernel
def trace_light_paths(scene, camera, rays, guide, window, seed, pass_index, first, last, share, film):
    """Particles first … last-1 of a pass from guided emission, each of `share` of the power of the lights.

    window: x0, y0, x1, y1 of the film, half open, int64; adds radiance to film (slots, 3) float32. Returns rays traced.
    """
    traced = 0
    for particle in range(first, last):
        key = rng.make_key(seed, rng.LIGHT_PATH, pass_index, particle)
        u, v = rng.uniform2(key, particles.EMIT_POINT)
        w, _ = rng.uniform2(key, 2)
        s, t = rng.uniform2(key, particles.EMIT_DIRECTION)
        p, n, offset, _, direction, flux = emit(scene, guide, u, v, w, s, t)
        flux = vec.scale(flux, share)
        origin = vec.along(p, n, offset)
        bounce = 0
        while vec.max3(flux) > ZERO:
            u, v = particles.scatter_uniforms(key, bounce)
            at, origin, direction, flux, more = particles.next_vertex(
                scene, rays, origin, direction, flux, key, bounce, u, v
            )
            traced += more
            if at.primitive >= 0 and at.events > 0 and owns(scene, at.material):
                traced += _splat(scene, camera, rays, window, at, film)
            bounce += 1
    return traced
