"""What a config's types cannot say: rules between keys."""

import math

from causticmpi.config.records import Box, Budget, Camera, Film, Vector
from causticmpi.config.units import parse_share, parse_time
from causticmpi.errors import InputError

MAX_SIDE = 65535
"""Pixels per side: beyond it a picture neither fits memory nor the readers of EXR."""
MAX_COORDINATE = 1e18
"""Scene units. Products of two coordinates still fit float32."""
_PARALLEL = 1e-6


def check_film(film: Film) -> None:
    """Raises InputError, without a place, for a crop outside the film or a film no reader can open."""
    for name, side in (("width", film.width), ("height", film.height)):
        if side > MAX_SIDE:
            raise InputError(f"{name}: found {side}; allowed: up to {MAX_SIDE} pixels")
    if film.crop is None:
        return
    x0, y0, x1, y1 = film.crop
    if not (x0 < x1 <= film.width and y0 < y1 <= film.height):
        raise InputError(
            f"crop: found {[x0, y0, x1, y1]}; allowed: [x0, y0, x1, y1] with x0 < x1 <= {film.width} and"
            f" y0 < y1 <= {film.height}; shrink the crop or enlarge the film"
        )


def check_budget(budget: Budget) -> Budget:
    """The budget with `time` in seconds and `until` a number. Raises InputError, without a place, unless it has exactly
    one of time and spp."""
    if budget.time is not None and budget.spp is not None:
        raise InputError("found both time and spp; allowed: exactly one of them; delete one")
    if budget.time is None and budget.spp is None:
        raise InputError("found neither time nor spp; allowed: exactly one of them; write time: 4min or spp: 64")
    time = until = None
    try:
        time = None if budget.time is None else parse_time(budget.time)
    except InputError as error:
        raise InputError(f"time: {error}") from None
    try:
        until = None if budget.until is None else parse_share(budget.until)
    except InputError as error:
        raise InputError(f"until: {error}") from None
    return Budget(time=time, spp=budget.spp, until=until)


def check_box(box: Box) -> None:
    """Raises InputError, without a place, for a box turned inside out, or one without any area."""
    extent = [high - low for low, high in zip(box.min, box.max, strict=True)]
    if min(extent) < 0 or sorted(extent)[1] <= 0:
        raise InputError(
            f"found min {list(box.min)} and max {list(box.max)}; allowed: min below max in at least two of x, y and z,"
            " above it in none; exchange them or enlarge the box"
        )


def check_camera(camera: Camera) -> None:
    """Raises InputError, without a place, for a camera that has no view direction or no upright."""
    for name, vector in (("eye", camera.eye), ("target", camera.target)):
        if max(map(abs, vector)) > MAX_COORDINATE:
            raise InputError(
                f"{name}: found {list(vector)}; allowed: coordinates up to {MAX_COORDINATE:g}, which float32 can use"
            )
    view = _unit((camera.target[0] - camera.eye[0], camera.target[1] - camera.eye[1], camera.target[2] - camera.eye[2]))
    if view is None:
        raise InputError(f"eye and target are the same point {list(camera.eye)}; move one of them")
    up = _unit(camera.up)
    if up is None:
        raise InputError("up: found [0, 0, 0]; allowed: a direction; write for example [0, 1, 0]")
    if math.hypot(*_cross(view, up)) < _PARALLEL:
        raise InputError(
            f"up: found {list(camera.up)}, parallel to the view direction;"
            " allowed: any other direction; choose another axis"
        )


def _unit(v: Vector) -> Vector | None:
    # Scaled by the largest component first, so that neither huge nor tiny vectors over- or underflow.
    largest = max(map(abs, v))
    if largest == 0.0:
        return None
    x, y, z = (component / largest for component in v)
    length = math.hypot(x, y, z)
    return (x / length, y / length, z / length)


def _cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
