"""What a compare config may say, as frozen records: one record per YAML section, defaults included."""

from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from causticmpi.config.records import Budget, Count, Positive, PositiveInt, Record

Overrides = dict[str, Any]
"""{"forecast.sampling": "two"}: keys of a render config and their values, as `--set` takes them."""
Rectangle = tuple[Count, Count, Count, Count]


class Scene(Record):
    """One part of the comparison. Paths are relative to the compare config.

    config: a render config; name: of the part, else the config's; title: for people; set: overrides of the config;
    variants: labels of those that run here, else all; budgets, seeds: instead of the comparison's; closeups: rectangles
    [x0, y0, x1, y1] of the film; reference: a directory with a reference of one's own; paper: key of the paper's
    numbers to print beside ours (`causticmpi.compare.paper`).
    """

    config: str
    name: str | None = None
    title: str | None = None
    set: Overrides = {}
    variants: list[str] | None = None
    budgets: Annotated[list[str | float], Meta(min_length=1)] | None = None
    seeds: PositiveInt | None = None
    closeups: list[Rectangle] = []
    reference: str | None = None
    paper: Literal["cornell", "figurines", "ring"] | None = None


class Variant(Record):
    """A method under a label.

    label: unlike all others, up to 40 letters, digits and `+.,() _-`; set: overrides of every scene's config;
    timing_only: one short run tells what a pass costs, and nothing is said of its error (`iws`, which has no caustics).
    """

    label: Annotated[str, Meta(min_length=1, max_length=40, pattern=r"^[A-Za-z0-9][A-Za-z0-9+.,() _-]*$")]
    set: Overrides
    timing_only: bool = False


class Batches(Record):
    """Independent renders that differ in their seed.

    set: overrides of the scene's config; budget: of each; batches: how many.
    """

    set: Overrides
    budget: Budget
    batches: Annotated[int, Meta(ge=4, description="a t-test needs a variance")] = 8


class Reference(Record):
    """How references are made.

    estimate: batches of one unbiased method, whose mean is the reference; check: those of another, against which a
    t-test holds it; directory: where they are kept, for any comparison, relative to the current directory like
    `output`; seed: of the first batch, far from the seeds of the runs; block: side in pixels of the squares whose means
    are compared.
    """

    estimate: Batches
    check: Batches
    directory: Annotated[str, Meta(min_length=1)] = "out/references"
    seed: Annotated[int, Meta(ge=0, le=2**62)] = 1_000_000
    block: PositiveInt = 16


class CompareConfig(Record):
    """A whole compare config.

    scenes: parts of the comparison; variants: methods that are compared; budgets: wall-clock times that every variant
    gets on the same ranks; reference: how references are made; title: of the report; scale: factor of all budgets;
    seeds: runs of each; mask_level: radiance of the reference's caustic layer above which a pixel belongs to the
    caustic mask; output: directory of runs and report, relative to the current directory.
    """

    scenes: Annotated[list[Scene], Meta(min_length=1)]
    variants: Annotated[list[Variant], Meta(min_length=1)]
    budgets: Annotated[list[str | float], Meta(min_length=1)]
    reference: Reference
    title: str = "Equal-time comparison"
    scale: Positive = 1.0
    seeds: PositiveInt = 1
    mask_level: Positive = 0.05
    output: Annotated[str, Meta(min_length=1)] = "out/compare"


def plain_text(overrides: Overrides) -> list[str]:
    """Overrides in the form of the command line: ["forecast.sampling=two"]."""
    return [
        f"{key}={value if isinstance(value, str) else msgspec.json.encode(value).decode()}"
        for key, value in overrides.items()
    ]
