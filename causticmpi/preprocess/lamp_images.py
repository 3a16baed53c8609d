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

from causticmpi.kernels import vec
from causticmpi.kernels.camera import primary_ray
from causticmpi.kernels.embree import intersect, ray_buffer
from causticmpi.kernels.eye_path import choose_along_eye_path, emitted
from causticmpi.kernels.jit import inline, kernel
from causticmpi.kernels.material_kinds import MIRROR
from causticmpi.kernels.traced_scene import TracedScene, hit_point, is_specular
from causticmpi.kernels.vec import ALMOST_ONE, INFINITY, ONE, WHITE, ZERO
from causticmpi.kernels.warp import turn
from causticmpi.preprocess.lamps import across, lamps_of, miss
from causticmpi.scene.data import SceneData
from causticmpi.scene.tracing import SHAPE

STRAIGHT = 1
"""Events of a look that meets nothing specular: each adds a bit behind the others, 1 if it reflects."""
MOST_EVENTS = 12
"""Of the chain of an image that is looked for."""
FAINTEST = np.float32(1e-5)
"""Of a lamp's radiance, that of an image that is looked for."""
STARTS = 32768
"""Places of the picture that the search starts from, at most, unless it has more pixels to be searched."""
MOST_IMAGES = 2048
"""What else is found is left to chance."""
WIDE = 4.0
"""Squared half axis of the ellipse of an image, over the variance of the lamp's points: that of a square reaches a
little beyond its sides."""
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
_LOOKS, _ENOUGH = 9, 3
"""Places of an ellipse that are tried, and how many must see the lamp: of an image in a facet there is little."""


class LampImages(NamedTuple):
    """Ellipses in a picture. place (n, 2) float64: film position of the middle; axes (n, 2, 2): half axes as columns
    [pixels]; events (n,) int64: see STRAIGHT; chance (n,): that a look there has these events."""

    place: np.ndarray
    axes: np.ndarray
    events: np.ndarray
    chance: np.ndarray


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
        p, n, offset = hit_point(scene, primitive, origin, direction, t)
        wanted = (events >> left) & 1
        origin, direction, throughput, reflected, share = choose_along_eye_path(
            scene, primitive, n, p, offset, direction, throughput, ZERO if wanted else ALMOST_ONE
        )
        if reflected != (wanted == 1):
            alive = False
            break
        chance *= share
        primitive, t = intersect(scene.handle, scene.triangle_count, rays, origin, direction, INFINITY)
    return alive, origin, direction, primitive, t, throughput, chance


@inline
def _ellipse(xx, xy, yy):
    """Of a covariance: direction of the longer axis, and both half axes."""
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    gap = math.sqrt(half * half + xy * xy)
    angle = 0.5 * math.atan2(xy, half)
    longer, shorter = math.sqrt(WIDE * (mean + gap)), math.sqrt(WIDE * max(0.0, mean - gap))
    longer, shorter = min(_LARGEST, max(_SMALLEST, longer)), min(_LARGEST, max(_SMALLEST, shorter))
    return math.cos(angle), math.sin(angle), longer, shorter


@inline
def _three(scene, camera, rays, x, y, events, o, d):
    """The last ray (o, d) of a look at a film position with those of looks a little to the right and below it. Returns
    whether these have the events as well; the last ray of each and how far they are apart [pixels]."""
    h, k = _DIFFERENCE, _DIFFERENCE
    right, p, e, _, _, _, _ = _follow(scene, camera, rays, x + h, y, events)
    if not right:  # at a rim
        h = -h
        right, p, e, _, _, _, _ = _follow(scene, camera, rays, x + h, y, events)
    down, q, f, _, _, _, _ = _follow(scene, camera, rays, x, y + k, events)
    if not down:
        k = -k
        down, q, f, _, _, _, _ = _follow(scene, camera, rays, x, y + k, events)
    return right & down, (o, d, p, e, q, f, h, k)


@inline
def _slopes(three, middle, tangents):
    """How looks miss a lamp's middle. Returns whether they get so far; the miss along two tangents, and what it changes
    by a pixel to the right and a pixel down."""
    o, d, p, e, q, f, h, k = three
    a, b, ahead = miss(o, d, middle, d, tangents)
    a1, b1, ahead1 = miss(p, e, middle, d, tangents)
    a2, b2, ahead2 = miss(q, f, middle, d, tangents)
    change = float(a1 - a) / h, float(b1 - b) / h, float(a2 - a) / k, float(b2 - b) / k
    return ahead & ahead1 & ahead2, float(a), float(b), change


@inline
def _image(variance, change, tangents):
    """Variance of a lamp's points across the ray, and the ellipse of its image, from what `_slopes` tells."""
    ax, bx, ay, by = change
    aa = float(across(variance, tangents[0], tangents[0]))
    ab = float(across(variance, tangents[0], tangents[1]))
    bb = float(across(variance, tangents[1], tangents[1]))
    share = 1 / (ax * by - ay * bx) ** 2
    xx = share * (by * by * aa - 2 * by * ay * ab + ay * ay * bb)
    xy = share * (-by * bx * aa + (by * ax + ay * bx) * ab - ay * ax * bb)
    yy = share * (bx * bx * aa - 2 * bx * ax * ab + ax * ax * bb)
    return aa + bb, _ellipse(xx, xy, yy)


@inline
def _approach(scene, camera, rays, x, y, three, chance, events, middle, variance, spacing, lit):
    """Newton's method from a film position, whose looks are `three`. Returns whether it comes to a lamp's middle;
    where; the ellipse [pixels]; how likely the events are.

    lit: the lamp is seen where it starts: then, if the middle is not to be had, the image is there.
    """
    first_x, first_y = x, y
    found, here, likely, ellipse = False, False, ONE, (1.0, 0.0, _SMALLEST, _SMALLEST)
    for step in range(_STEPS):
        if step > 0:
            alive, o, d, _, _, _, chance = _follow(scene, camera, rays, x, y, events)
            if not alive:
                break
            known, three = _three(scene, camera, rays, x, y, events, o, d)
            if not known:
                break
        tangents = vec.frame(three[1])
        ahead, a, b, change = _slopes(three, middle, tangents)
        ax, bx, ay, by = change
        whole = ax * by - ay * bx
        if not ahead or whole == 0:
            break
        size2, turned = _image(variance, change, tangents)
        if step == 0:
            likely, ellipse = chance, turned
            here = lit and turned[3] < _LARGEST  # chance meets larger ones, and other starts the middle
            if lit:
                spacing = max(spacing, turned[2])  # the middle may lie as far
        if a * a + b * b <= _MET * size2:
            found, likely, ellipse = True, chance, turned
            break
        right, down = (ay * b - by * a) / whole, (bx * a - ax * b) / whole
        if step == 0 and right * right + down * down > (_REACH * spacing) ** 2:
            break
        x, y = x + right, y + down
        if (x - first_x) ** 2 + (y - first_y) ** 2 > (_FARTHEST * spacing) ** 2:
            break
    if not found:
        x, y, found = first_x, first_y, here
    return found, x, y, ellipse, likely


@inline
def _shines(scene, camera, rays, x, y, c, s, longer, shorter, events):
    """Whether a lamp is seen at enough of a few places of an ellipse, by the events."""
    seen = 0
    for k in range(_LOOKS):
        u, v = turn(np.float32(max(0, k - 1)) / np.float32(_LOOKS - 1))
        far = 0.5 if k else 0.0
        right, down = far * longer * u, far * shorter * v
        at_x, at_y = x + c * right - s * down, y + s * right + c * down
        alive, origin, direction, primitive, t, throughput, _ = _follow(scene, camera, rays, at_x, at_y, events)
        if alive and primitive >= 0:
            _, n, _ = hit_point(scene, primitive, origin, direction, t)
            seen += vec.max3(vec.mul(emitted(scene, primitive, n, direction), throughput)) > ZERO
    return seen >= _ENOUGH


@inline
def _is_known(found, count, x, y, events, lamp):
    """Whether a place by these events is one of `count` images of the lamp."""
    known = False
    for k in range(count):
        right, down = x - found[k, 0], y - found[k, 1]
        along = (found[k, 2] * right + found[k, 3] * down) / found[k, 4]
        beside = (found[k, 2] * down - found[k, 3] * right) / found[k, 5]
        of_it = found[k, 7] == events and found[k, 8] == lamp
        known |= of_it and along * along + beside * beside < _SAME
    return known


@kernel
def _search(scene, camera, rays, starts, spacing, middles, variances, shapes, waiting, found):
    """Fill found (rows, 9) float64: place, direction of the longer axis, half axes, chance, events, lamp; from starts
    (n, 2) [pixels], so far apart. waiting (2 * MOST_EVENTS + 2,) int64: workspace. Returns how many there are."""
    count = 0
    for i in range(starts.shape[0]):
        waiting[0], top = STRAIGHT, 1
        while top > 0:
            top -= 1
            events = waiting[top]
            alive, o, d, primitive, _, throughput, chance = _follow(
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
            known, three = _three(scene, camera, rays, starts[i, 0], starts[i, 1], events, o, d)
            for lamp in range(middles.shape[0] if known else 0):
                middle, variance = vec.row(middles, lamp), variances[lamp]
                lit = primitive >= 0 and scene.surface.view(np.int32)[primitive, SHAPE] == shapes[lamp]
                place = starts[i, 0], starts[i, 1], three, chance, events
                near, x, y, ellipse, likely = _approach(scene, camera, rays, *place, middle, variance, spacing, lit)
                if not near or count == found.shape[0]:
                    continue
                c, s, longer, shorter = ellipse
                if not _is_known(found, count, x, y, events, lamp) and _shines(
                    scene, camera, rays, x, y, c, s, longer, shorter, events
                ):
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
    lamps = lamps_of(scene)
    own = lamps.middle, lamps.variance, lamps.shape
    count = _search(traced, camera, ray_buffer(), starts, 1 / parts, *own, waiting, found)
    found = found[:count]
    x, y, c, s, longer, shorter, chance, events, _ = found[np.isfinite(found).all(axis=1)].T
    axes = np.stack([np.stack([c * longer, -s * shorter], axis=1), np.stack([s * longer, c * shorter], axis=1)], axis=1)
    return LampImages(np.stack([x, y], axis=1), axes, events.astype(np.int64), chance.copy())


def no_images() -> LampImages:
    """None is known."""
    return LampImages(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, np.int64), np.zeros(0))


def places_on_other_film(places: np.ndarray, size: tuple[int, int], other: tuple[int, int]) -> np.ndarray:
    """Places [pixels] of a picture, width and height `size`, in one of other width and height that shows the same: its
    field of view is that of the height, about the same middle. places: (n, 2), or (n, 1) for the same on both axes."""
    moved: np.ndarray = (places - np.array(size) / 2) * (other[1] / size[1]) + np.array(other) / 2
    return moved


def on_other_film(images: LampImages, size: tuple[int, int], other: tuple[int, int]) -> LampImages:
    """The images of a picture, width and height `size`, in one of other width and height that shows the same."""
    place = places_on_other_film(images.place, size, other)
    return images._replace(place=place, axes=images.axes * (other[1] / size[1]))
