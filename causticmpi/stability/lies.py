"""Forecasts that lie: photons changed before they are clustered. The picture must not mind, or the program refuse."""

from collections.abc import Callable

import numpy as np

from causticmpi.preprocess.photons import CausticPoints

Lie = Callable[[CausticPoints, np.random.Generator], CausticPoints]


def _copy(points: CausticPoints) -> CausticPoints:
    return CausticPoints(*(array.copy() for array in points))


def truth(points: CausticPoints, _: np.random.Generator) -> CausticPoints:
    """No lie."""
    return points


def moved(points: CausticPoints, random: np.random.Generator) -> CausticPoints:
    """Every photon lies where another one landed."""
    order = random.permutation(len(points.power))
    return points._replace(position=points.position[order])


def rotated(points: CausticPoints, _: np.random.Generator) -> CausticPoints:
    """Directions turned by 120 degrees about (1, 1, 1)."""
    return points._replace(direction=np.ascontiguousarray(np.roll(points.direction, 1, axis=1)))


def one_direction(points: CausticPoints, _: np.random.Generator) -> CausticPoints:
    """All photons come from one direction: all in one bin."""
    made = _copy(points)
    made.direction[:] = 0.48, 0.6, 0.64
    return made


def below(points: CausticPoints, _: np.random.Generator) -> CausticPoints:
    """Directions from below the surface."""
    return points._replace(direction=-points.direction)


def wild_powers(points: CausticPoints, random: np.random.Generator) -> CausticPoints:
    """Powers over twelve decades."""
    made = _copy(points)
    made.power[:] *= np.exp(random.normal(0, 5, len(made.power)))[:, None].astype(np.float32)
    return made


def no_power(points: CausticPoints, _: np.random.Generator) -> CausticPoints:
    """Photons without power."""
    return points._replace(power=np.zeros_like(points.power))


def one_point(points: CausticPoints, _: np.random.Generator) -> CausticPoints:
    """All photons at one place."""
    made = _copy(points)
    made.position[:] = made.position[0]
    made.normal[:] = made.normal[0]
    return made


def not_a_number(points: CausticPoints, _: np.random.Generator) -> CausticPoints:
    """Every tenth direction is nan."""
    made = _copy(points)
    made.direction[::10] = np.nan
    return made


def infinite(points: CausticPoints, _: np.random.Generator) -> CausticPoints:
    """One photon has infinite power."""
    made = _copy(points)
    made.power[0] = np.inf
    return made


LIES: dict[str, Lie] = {
    "none": truth,
    "wrong light": truth,  # the photons are shot in a room whose light stands elsewhere: see cell.py
    "moved": moved,
    "rotated": rotated,
    "one bin": one_direction,
    "below": below,
    "wild powers": wild_powers,
    "no power": no_power,
    "one point": one_point,
    "nan": not_a_number,
    "infinite": infinite,
}
