"""Images of lamps: where the eye sees the middle of a lamp, by which mirrors and lenses, and how large it looks there.

A look at a random place of a pixel seldom meets the image of a small lamp in a ball of glass, the less so the fainter
the reflections it takes. But one that misses the lamp tells how to meet it: the events of its chain held fixed,
Newton's method moves its place in the picture until its ray goes through the lamp's middle, as manifolds are walked
between two vertices of a path [Jakob and Marschner 2012]; here from the eye, once for all passes. An image that is not
found, as in facets and at rims, is left to looks at random places.
"""

import math
from typing import NamedTuple

import numpy as np

from causticmpi.kernels import bsdf, vec
from causticmpi.kernels.camera import primary_ray
from causticmpi.kernels.embree import intersect, ray_buffer
from causticmpi.kernels.eye_path import emitted, scatter_along_eye_path
from causticmpi.kernels.jit import inline, kernel
from causticmpi.kernels.material_kinds import MIRROR
from causticmpi.kernels.traced_scene import TracedScene, hit_point, is_specular
from causticmpi.kernels.vec import ALMOST_ONE, INFINITY, ONE, WHITE, ZERO
from causticmpi.kernels.warp import turn
from causticmpi.scene.data import SceneData

STRAIGHT = 1
"""Events of a look that meets nothing specular: each adds a bit behind the others, 1 if it reflects."""
MOST_EVENTS = 12
FAINTEST = np.float32(1e-5)
"""Of a lamp's radiance, that of an image that is looked for."""
MOST_LAMPS = 16
"""The strongest."""
STARTS = 16384
"""Places of the picture that the search starts from, at least; one in every pixel at least."""
MOST_IMAGES = 2048
CORNERS = 6.0
"""Squared size of the ellipse of an image, over the variance of the lamp's points along an axis: that of a square goes
through its corners."""
_STEPS = 8
_REACH, _FARTHEST = 2.0, 4.0
"""Longest first step, and the way from its start that a search may go, over the distance of starts: farther off, other
starts are nearer."""
_SMALLEST, _LARGEST = 0.002, 2.0
"""Half axes of an ellipse [pixels]: rounding of places in a large picture, and as far as an image near a fold may pass
for an ellipse."""
_DIFFERENCE = 0.02
"""Between places whose rays tell a derivative [pixels]."""
_MET = 0.01
"""Squared distance from the middle of the lamp that is near enough, over the variance of its points."""
_SAME = 0.25
"""Images by the same events so near, of the squared half axes of one, are one."""
_LOOKS = 9
"""Places of an ellipse that are tried: one sees the lamp, or the image is hidden."""


class Lamps(NamedTuple):
    """Shapes that shine: middle (n, 3); variance (n, 6) of their points: xx, xy, xz, yy, yz, zz [units²]."""

    middle: np.ndarray
    variance: np.ndarray


class LampImages(NamedTuple):
    """Ellipses in a picture. place (n, 2) float64: film position of the middle; axes (n, 2, 2): half axes as columns
    [pixels]; events (n,) int64: see STRAIGHT; chance (n,): that a look there has these events."""

    place: np.ndarray
    axes: np.ndarray
    events: np.ndarray
    chance: np.ndarray


def lamps_of(scene: SceneData) -> Lamps:
    """Shapes that shine, the MOST_LAMPS strongest."""
    shining = np.flatnonzero(scene.primitive_emission >= 0)
    sphere = shining >= len(scene.triangles)
    corners = scene.vertices[scene.triangles[shining[~sphere]]].astype(np.float64)
    balls = scene.spheres[shining[sphere] - len(scene.triangles)].astype(np.float64)
    edges = corners[:, 1:] - corners[:, :1]
    sides = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    area = np.concatenate([sides / 2, 4 * math.pi * balls[:, 3] ** 2])
    middle = np.concatenate([corners.mean(axis=1), balls[:, :3]])
    away = corners - middle[: len(corners), None]
    inner = np.zeros((len(shining), 3, 3))
    inner[: len(corners)] = np.einsum("ikc,ikd->icd", away, away) / 12
    inner[len(corners) :] = np.eye(3) * (balls[:, 3] ** 2 / 4)[:, None, None]  # of the disk that is seen
    shapes, shape = np.unique(scene.primitive_shape[shining], return_inverse=True)
    power = np.bincount(shape, weights=area * scene.emission[scene.primitive_emission[shining]].max(axis=1))
    strongest = np.sort(np.argsort(-power, kind="stable")[:MOST_LAMPS])
    middles, variances = np.zeros((len(shapes), 3)), np.zeros((len(shapes), 6))
    for i in strongest:
        own = shape == i
        share = area[own] / area[own].sum()
        middles[i] = share @ middle[own]
        off = middle[own] - middles[i]
        whole = np.einsum("i,icd->cd", share, inner[own] + off[:, :, None] * off[:, None])
        variances[i] = whole[np.triu_indices(3)]
    return Lamps(middles[strongest].astype(np.float32), variances[strongest].astype(np.float32))


@inline
def length_of(events):
    """How many there are."""
    count = 0
    while events > STRAIGHT:
        events >>= 1
        count += 1
    return count


@inline
def _follow(scene, camera, rays, x, y, events):
    """A look at a film position whose events are given. Returns whether there are such, and its last ray: origin,
    direction, primitive (-1: none) and distance of what it meets; its throughput and how likely its events are."""
    origin, direction = primary_ray(camera, np.float32(x), np.float32(y))
    primitive, t = intersect(scene.handle, scene.triangle_count, rays, origin, direction, INFINITY)
    throughput, chance, alive = WHITE, ONE, True
    for left in range(length_of(events) - 1, -1, -1):
        if primitive < 0 or not is_specular(scene.kind[scene.material[primitive]]):
            alive = False
            break
        reflects = (events >> left) & 1
        p, n, offset = hit_point(scene, primitive, origin, direction, t)
        share = bsdf.reflected_share(scene, scene.material[primitive], n, direction)
        arriving, u = vec.dot(direction, n), ZERO if reflects else ALMOST_ONE
        origin, direction, throughput = scatter_along_eye_path(scene, primitive, n, p, offset, direction, throughput, u)
        if (arriving * vec.dot(direction, n) < ZERO) != (reflects == 1):
            alive = False
            break
        chance *= share if reflects else ONE - share
        primitive, t = intersect(scene.handle, scene.triangle_count, rays, origin, direction, INFINITY)
    return alive, origin, direction, primitive, t, throughput, chance


@inline
def _miss(origin, direction, middle, normal, tangents):
    """By how much a ray misses a lamp's middle, on the plane through it: along the two tangents; ahead: whether it gets
    there."""
    slope, way = vec.dot(direction, normal), vec.dot(vec.sub(middle, origin), normal)
    off = vec.sub(vec.along(origin, direction, way / slope), middle)
    return vec.dot(off, tangents[0]), vec.dot(off, tangents[1]), (slope > ZERO) & (way > ZERO)


@inline
def _across(variance, a, b):
    """aᵀ V b."""
    return (
        variance[0] * a[0] * b[0]
        + variance[1] * (a[0] * b[1] + a[1] * b[0])
        + variance[2] * (a[0] * b[2] + a[2] * b[0])
        + variance[3] * a[1] * b[1]
        + variance[4] * (a[1] * b[2] + a[2] * b[1])
        + variance[5] * a[2] * b[2]
    )


@inline
def _ellipse(xx, xy, yy):
    """Direction of the longer axis of a covariance, and both half axes."""
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    gap = math.sqrt(half * half + xy * xy)
    angle = 0.5 * math.atan2(xy, half)
    longer, shorter = math.sqrt(CORNERS * (mean + gap)), math.sqrt(CORNERS * max(0.0, mean - gap))
    longer, shorter = min(_LARGEST, max(_SMALLEST, longer)), min(_LARGEST, max(_SMALLEST, shorter))
    return math.cos(angle), math.sin(angle), longer, shorter


@inline
def _approach(scene, camera, rays, x, y, events, middle, variance, spacing):
    """Newton's method from a film position. Returns whether it comes to a lamp's middle; where; direction of the longer
    axis of the image, and half axes [pixels]; how likely the events are."""
    first_x, first_y, h = x, y, _DIFFERENCE
    found, c, s, longer, shorter, likely = False, 1.0, 0.0, 0.0, 0.0, ONE
    for step in range(_STEPS):
        alive, o, d, _, _, _, chance = _follow(scene, camera, rays, x, y, events)
        alive1, o1, d1, _, _, _, _ = _follow(scene, camera, rays, x + h, y, events)
        alive2, o2, d2, _, _, _, _ = _follow(scene, camera, rays, x, y + h, events)
        if not (alive and alive1 and alive2):
            break
        tangents = vec.frame(d)
        a, b, ahead = _miss(o, d, middle, d, tangents)
        a1, b1, ahead1 = _miss(o1, d1, middle, d, tangents)
        a2, b2, ahead2 = _miss(o2, d2, middle, d, tangents)
        if not (ahead and ahead1 and ahead2):
            break
        # The miss moves by (ax, bx) a pixel to the right and by (ay, by) a pixel down.
        ax, bx, ay, by = float(a1 - a) / h, float(b1 - b) / h, float(a2 - a) / h, float(b2 - b) / h
        whole = ax * by - ay * bx
        if whole == 0:
            break
        aa = float(_across(variance, tangents[0], tangents[0]))
        ab = float(_across(variance, tangents[0], tangents[1]))
        bb = float(_across(variance, tangents[1], tangents[1]))
        if a * a + b * b <= _MET * (aa + bb):
            share = 1 / (whole * whole)
            xx = share * (by * by * aa - 2 * by * ay * ab + ay * ay * bb)
            xy = share * (-by * bx * aa + (by * ax + ay * bx) * ab - ay * ax * bb)
            yy = share * (bx * bx * aa - 2 * bx * ax * ab + ax * ax * bb)
            c, s, longer, shorter = _ellipse(xx, xy, yy)
            found, likely = True, chance
            break
        right, down = (ay * b - by * a) / whole, (bx * a - ax * b) / whole
        if step == 0 and right * right + down * down > (_REACH * spacing) ** 2:
            break
        x, y = x + right, y + down
        if (x - first_x) ** 2 + (y - first_y) ** 2 > (_FARTHEST * spacing) ** 2:
            break
    return found, x, y, c, s, longer, shorter, likely


@inline
def _shines(scene, camera, rays, x, y, c, s, longer, shorter, events):
    """Whether a lamp is seen at one of a few places of an ellipse, by the events."""
    seen = False
    for k in range(_LOOKS):
        u, v = turn(np.float32(k) / np.float32(_LOOKS))
        far = 0.5 if k else 0.0
        right, down = far * longer * u, far * shorter * v
        at_x, at_y = x + c * right - s * down, y + s * right + c * down
        alive, origin, direction, primitive, t, throughput, chance = _follow(scene, camera, rays, at_x, at_y, events)
        if alive and primitive >= 0:
            _, n, _ = hit_point(scene, primitive, origin, direction, t)
            light = vec.mul(emitted(scene, primitive, n, direction), throughput)
            seen |= vec.max3(light) * chance > ZERO
    return seen


@kernel
def _search(scene, camera, rays, starts, spacing, middles, variances, waiting, found):
    """Fill found (rows, 9) float64: place, direction of the longer axis, half axes, chance, events, lamp; from starts
    (n, 2) [pixels], so far apart. waiting (2 * MOST_EVENTS + 2,) int64: workspace. Returns how many there are."""
    count = 0
    for i in range(starts.shape[0]):
        waiting[0], top = STRAIGHT, 1
        while top > 0:
            top -= 1
            events = waiting[top]
            alive, _, _, primitive, _, throughput, chance = _follow(
                scene, camera, rays, starts[i, 0], starts[i, 1], events
            )
            if not alive or vec.max3(throughput) * chance < FAINTEST:
                continue
            if primitive >= 0 and is_specular(scene.kind[scene.material[primitive]]):
                if length_of(events) < MOST_EVENTS:
                    waiting[top] = 2 * events + 1
                    top += 1
                    if scene.kind[scene.material[primitive]] != MIRROR:
                        waiting[top] = 2 * events
                        top += 1
                continue
            for lamp in range(middles.shape[0]):
                middle, variance = vec.row(middles, lamp), variances[lamp]
                near, x, y, c, s, longer, shorter, likely = _approach(
                    scene, camera, rays, starts[i, 0], starts[i, 1], events, middle, variance, spacing
                )
                if not near or count == found.shape[0]:
                    continue
                known = False
                for k in range(count):
                    right, down = x - found[k, 0], y - found[k, 1]
                    along = (found[k, 2] * right + found[k, 3] * down) / found[k, 4]
                    beside = (found[k, 2] * down - found[k, 3] * right) / found[k, 5]
                    same = found[k, 7] == events and found[k, 8] == lamp
                    known |= same and along * along + beside * beside < _SAME
                if not known and _shines(scene, camera, rays, x, y, c, s, longer, shorter, events):
                    row = found[count]
                    row[0], row[1], row[2], row[3], row[4], row[5] = x, y, c, s, longer, shorter
                    row[6], row[7], row[8] = likely, events, lamp
                    count += 1
    return count


def find_images(scene: SceneData, traced: TracedScene, camera: np.ndarray, width: int, mask: np.ndarray) -> LampImages:
    """Images of the lamps in a picture, from its pixels where a lamp may be seen: mask (pixels,)."""
    seen = np.flatnonzero(mask)
    parts = max(1, math.isqrt(STARTS // max(1, len(seen))))
    inner = (np.arange(parts) + 0.5) / parts
    corner = np.stack([seen % width, seen // width], axis=1).astype(np.float64)
    starts = (corner[:, None, None] + np.stack(np.meshgrid(inner, inner), axis=-1)).reshape(-1, 2)
    found, waiting = np.zeros((MOST_IMAGES, 9)), np.zeros(2 * MOST_EVENTS + 2, np.int64)
    count = _search(traced, camera, ray_buffer(), starts, 1 / parts, *lamps_of(scene), waiting, found)
    x, y, c, s, longer, shorter, chance, events, _ = found[:count].T
    axes = np.stack([np.stack([c * longer, -s * shorter], axis=1), np.stack([s * longer, c * shorter], axis=1)], axis=1)
    return LampImages(np.stack([x, y], axis=1), axes, events.astype(np.int64), chance.copy())


def no_images() -> LampImages:
    """None is known."""
    return LampImages(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, np.int64), np.zeros(0))


def on_other_film(images: LampImages, size: tuple[int, int], other: tuple[int, int]) -> LampImages:
    """The images of a picture, width and height `size`, in one of other width and height that shows the same."""
    scale = other[1] / size[1]  # the field of view is that of the height, about the same middle
    return images._replace(
        place=(images.place - np.array(size) / 2) * scale + np.array(other) / 2, axes=images.axes * scale
    )
