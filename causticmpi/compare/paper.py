"""The numbers that the paper prints, to stand beside ours [Budge et al. 2008, section 4, Table 1]."""

from dataclasses import dataclass


@dataclass(frozen=True)
class PaperScene:
    """What the paper says of one scene: 20 cores for pictures, one core for the timings of Table 1.

    minutes: the time of the pictures, and of the run that Table 1 tells of; samples: {method: samples per pixel} after
    it; timings in seconds by row of Table 1; photons: forecast photons.
    """

    figure: str
    minutes: float
    samples: dict[str, int] | None
    timings: dict[str, float]
    photons: int


TABLE_1 = (
    "total without caustics",
    "total with caustics",
    "tracing photons",
    "clustering caustics",
    "building kd-trees",
    "creating CDFs",
)
"""Rows of Table 1 in seconds; its last row is the number of forecast photons."""


def _timings(*seconds: float) -> dict[str, float]:
    return dict(zip(TABLE_1, seconds, strict=True))


PAPER = {
    "figurines": PaperScene(
        "Figure 3",
        60,
        {"iws+cf": 1442, "pt": 8891, "iws+pm": 1108},
        _timings(27600, 71600, 117.3, 3.5, 1.28, 2321.6),
        75_000,
    ),
    "cornell": PaperScene(
        "Figure 4", 4, {"iws+cf": 60, "pt": 405, "iws+pm": 99}, _timings(306, 2290, 5.4, 9.4, 4.9, 190), 200_000
    ),
    "ring": PaperScene("Figure 5", 8, None, _timings(869, 2610, 15.7, 47.1, 21.7, 172.1), 1_000_000),
}

TWO_TABLES = (
    "The paper's section 4 says of two tables against one: 16 % fewer samples per second, and a root mean squared "
    "error lower by just over 1 %; of one table smoothed by a Gaussian: convergence very poor."
)
