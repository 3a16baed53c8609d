"""What a stability page may say, as frozen records: one file, one question."""

from typing import Annotated, Any, Literal

from msgspec import Meta

from causticmpi.config.records import Positive, PositiveInt, Record

Settings = dict[str, Any]
Value = float | str | bool | list[int]


class Room(Record):
    """A scene from a template (`causticmpi.stability.scenes`) with parameters, or a scene file of one's own.

    template: name of the kind of room; file: a scene file, relative to the page; set: parameters of the template.
    """

    template: str | None = None
    file: str | None = None
    set: Settings = {}


class Sweep(Record):
    """One parameter over values.

    parameter: `scene.NAME` of the template, `scene` for scene files relative to the page, a key of the render config
    such as `iws.bound`, or `photons`, which tells lies about the forecast's photons (`causticmpi.stability.lies`);
    values: at least one; name: for people; start: the value that a user gets without asking, marked in the chart.
    """

    parameter: str
    values: Annotated[list[Value], Meta(min_length=1)]
    name: str
    start: Value | None = None


class Contender(Record):
    """A method under a label.

    label: for people; set: overrides of the config.
    """

    label: Annotated[str, Meta(min_length=1, max_length=40)]
    set: Settings


class Claim(Record):
    """What several seeds are asked (`causticmpi.stability.seeds`): how often is `of` below 0.95 of the baseline, or
    below 0.9 of the best of `fixed`?

    of: label of a contender; fixed: labels of its rivals.
    """

    of: str
    fixed: Annotated[list[str], Meta(min_length=1)]


class Truth(Record):
    """What every cell is held against: contenders in order of preference, or a known radiance.

    rivals: the first that sees enough light is used, see `causticmpi.stability.judge`; exact: radiance of every pixel.
    """

    rivals: list[Contender] = []
    exact: float | None = None


class Page(Record):
    """A whole page.

    title, question: for people; contenders: methods that are measured; room: the scene, unless the sweep is over scene
    files; sweep: of a parameter; truth: what errors are measured against; set: overrides of every contender's config.
    kind: `sweep` of a parameter, `long` runs of one pixel, `coverage` of stated intervals, `until` stops.
    reads: how the verdict is formed: `rivals` compares methods along the sweep, `setting` finds the best value,
    `exact` names the values at which the known answer is missed, `floor` the bias of biased methods, `bounded` what
    paths cost, `lies` what wrong forecasts do.
    side: pixels of the square film; seconds: CPU time of each contender in each cell; batches: independent parts of
    that time; batch_passes: passes of each batch, in place of seconds: then means and their tests are the same on any
    machine; equal_time: CPU seconds at which errors are compared, preprocess included; baseline: label of the contender
    whom others should beat; claim: table of efficiencies over seeds; constant_caustics: L_c has the same mean all along
    the sweep, so that less means missed; runs: of `coverage` and `until`; passes: of each of these runs; samples: of
    `long`.
    """

    title: str
    question: str
    contenders: Annotated[list[Contender], Meta(min_length=1)]
    room: Room | None = None
    kind: Literal["sweep", "long", "coverage", "until"] = "sweep"
    reads: Literal["rivals", "setting", "exact", "floor", "bounded", "lies"] = "rivals"
    sweep: Sweep | None = None
    truth: Truth = Truth()
    set: Settings = {}
    side: PositiveInt = 48
    seconds: Positive = 3.0
    # With 4 batches of 4 paths t-tests at 1e-4 called right means wrong in 0.8 % of the cells, with 8 in none of 1024.
    batches: Annotated[int, Meta(ge=8)] = 16
    batch_passes: PositiveInt | None = None
    equal_time: Positive = 60.0
    baseline: str | None = None
    claim: Claim | None = None
    constant_caustics: bool = False
    runs: PositiveInt = 40
    passes: PositiveInt = 64
    samples: PositiveInt = 1_000_000
