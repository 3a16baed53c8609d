"""A page's cells: one parameter over values, all contenders at each, and the rivals they are held against."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from causticmpi.errors import InputError
from causticmpi.scene.load import load_scene
from causticmpi.stability.cell import FAR_PASS, Measured, config_for, measure, passes_within, set_up
from causticmpi.stability.judge import judge, seen_caustic
from causticmpi.stability.lies import LIES
from causticmpi.stability.records import Contender, Page, Sweep, Value
from causticmpi.stability.row import Kind, Row, refused
from causticmpi.stability.scenes import build, write_scene

RIVAL_SECONDS, COMMON_RIVAL_SECONDS = 2.0, 8.0
"""A rival gets this many times the CPU time of a contender, more where it serves all cells of a page."""
AGAIN = 8.0
"""A contender whose mean fails its test is measured once more, in this many times the CPU time."""
SEED, RIVAL_SEED = 1, 1001
"""Of the first contender and of the first rival; the second ones have the next, and so on."""
REPEAT_SEEDS = 2000
"""What each further repeat of a page adds to its seeds."""


@dataclass(frozen=True)
class Point:
    """What was measured at one value. failed: reason by contender; refusal: of the scene, empty if it was taken."""

    index: int
    found: list[Measured]
    rivals: list[Measured]
    failed: dict[str, str]
    refusal: str = ""


@dataclass(frozen=True)
class CellKey:
    """Where a contender was measured. repeat: number of the page's repeat; index: of the value of the sweep."""

    repeat: int
    index: int
    label: str


def rivals_are_common(page: Page) -> bool:
    """Whether the scene is one for all values, so that the rivals need to be measured once."""
    return page.sweep is not None and not _is_of_scene(page.sweep)


def _is_of_scene(sweep: Sweep) -> bool:
    return sweep.parameter == "scene" or sweep.parameter.startswith("scene.")


def measure_point(page: Page, place: Path, out: Path, index: int, scale: float, repeat: int = 0) -> Point:
    """One value of the sweep, rivals included where the scene changes.

    place: directory of the page; out: for scenes; scale: of all CPU times; repeat: number of the page's repeat, the
    first of which has the rivals of all. A refused scene, or a method that gives up, is told in the point.
    """
    try:
        file = scene_file(page, place, out, index)
        load_scene(file)
    except InputError as error:
        return Point(index, [], [], {}, str(error))
    found, failed = [], {}
    for i, contender in enumerate(page.contenders):
        try:
            found.append(_measure_contender(page, contender, file, index, _seed(i, repeat), scale))
        except (InputError, ValueError, RuntimeError) as error:
            failed[contender.label] = str(error)
    needs_rivals = repeat == 0 and not rivals_are_common(page)
    return Point(index, found, _measure_rivals(page, file, RIVAL_SECONDS, scale) if needs_rivals else [], failed)


def measure_again(page: Page, place: Path, out: Path, cell: CellKey, scale: float) -> Measured:
    """The contender of one cell by other passes of the same seed, in AGAIN times the CPU time.

    The same seed, so that it has the same forecast: were it that which makes the mean wrong, it would again. For place,
    out and scale see `measure_point`.
    """
    file = scene_file(page, place, out, cell.index)
    i = [c.label for c in page.contenders].index(cell.label)
    seed = _seed(i, cell.repeat)
    return _measure_contender(page, page.contenders[i], file, cell.index, seed, AGAIN * scale, FAR_PASS)


def _seed(contender: int, repeat: int) -> int:
    """Of a contender by its number on the page."""
    return SEED + contender + REPEAT_SEEDS * repeat


def point_seconds(page: Page, scale: float, repeat: int) -> float:
    """CPU seconds that `measure_point` takes, about, without those of forecasts."""
    own_rivals = repeat == 0 and not rivals_are_common(page)
    return scale * page.seconds * (len(page.contenders) + own_rivals * RIVAL_SECONDS * len(page.truth.rivals))


def rivals_seconds(page: Page, scale: float) -> float:
    """CPU seconds that `measure_rivals` takes, about."""
    return scale * page.seconds * COMMON_RIVAL_SECONDS * len(page.truth.rivals)


def rivals_key(page: Page, place: Path) -> str:
    """What `measure_rivals` depends on: the same for pages that can share them."""
    known = page.truth.rivals, page.room, page.set, page.side, page.seconds, page.batches, page.batch_passes
    return f"{place} {known}"


def measure_rivals(page: Page, place: Path, out: Path, scale: float) -> list[Measured]:
    """The rivals of all cells of a page whose scene is one for all values."""
    return _measure_rivals(page, scene_file(page, place, out, 0), COMMON_RIVAL_SECONDS, scale)


def _measure_rivals(page: Page, file: Path, factor: float, scale: float) -> list[Measured]:
    return [
        _measure_one(page, rival.label, file, {**page.set, **rival.set}, RIVAL_SEED + i, factor * scale)
        for i, rival in enumerate(page.truth.rivals)
    ]


def _measure_contender(
    page: Page, contender: Contender, file: Path, index: int, seed: int, factor: float, first_pass: int = 0
) -> Measured:
    """At one value of the sweep, by its index; for the rest see `_measure_one`."""
    assert page.sweep is not None
    value = page.sweep.values[index]
    lie = str(value) if page.sweep.parameter == "photons" else "none"
    settings = _settings(page, value, contender)
    return _measure_one(page, contender.label, file, settings, seed, factor, lie, first_pass)


def _measure_one(
    page: Page,
    label: str,
    file: Path,
    settings: Mapping[str, Any],
    seed: int,
    factor: float,
    lie: str = "none",
    first_pass: int = 0,
) -> Measured:
    """factor: of the page's CPU time or passes; lie: a key of `LIES`; first_pass: its number, the others follow."""
    bench = set_up(file, config_for(page.side, seed, settings), lie)
    try:
        if page.batch_passes is None:
            passes = passes_within(bench, page.seconds * factor) / page.batches
        else:
            passes = page.batch_passes * factor
        return measure(bench, label, max(1, round(passes)), page.batches, first_pass)
    finally:
        bench.close()


Repeat = Sequence[Point]
"""All points of a page by one set of seeds, in the order of the values."""


def settled_rows(
    page: Page, repeats: Sequence[Repeat], rivals: Sequence[Measured], again: Callable[[CellKey], Measured]
) -> list[list[Row]]:
    """The judged rows of all values, by repeat. A contender whose mean is wrong is measured once more and judged anew.

    A biased mean is wrong again, all the more so in a longer time. Not so one that was too dark where none of the rare
    bright hits came that are due in a square of the picture. Its own passes cannot tell: that square shows no hit, and
    the even noise of others hides what skew there is. again: see `measure_again`.
    """
    rows = _rows_by_repeat(page, repeats, rivals)
    # More than once round: what is seen of the caustics in a second measurement has a say in other verdicts.
    while wrong := _wrong_at_first(page, rows):
        found = {key: replace(again(key), again=True) for key in wrong}
        repeats = [
            [replace(p, found=[found.get(CellKey(repeat, p.index, m.label), m) for m in p.found]) for p in points]
            for repeat, points in enumerate(repeats)
        ]
        rows = _rows_by_repeat(page, repeats, rivals)
    return rows


def _wrong_at_first(page: Page, rows: Sequence[Sequence[Row]]) -> list[CellKey]:
    """Cells that are wrong and not measured again yet, of rows by repeat."""
    assert page.sweep is not None
    values = page.sweep.values
    return [
        CellKey(repeat, values.index(row.value), row.label)
        for repeat, own in enumerate(rows)
        for row in own
        if row.kind is Kind.WRONG and not row.again
    ]


def _rows_by_repeat(page: Page, repeats: Sequence[Repeat], rivals: Sequence[Measured]) -> list[list[Row]]:
    """All use the rivals of the first repeat."""
    return [
        all_rows(page, [replace(p, rivals=first.rivals) for p, first in zip(points, repeats[0], strict=True)], rivals)
        for points in repeats
    ]


def all_rows(page: Page, points: Sequence[Point], rivals: Sequence[Measured]) -> list[Row]:
    """The judged rows of all values. rivals: those that all cells share."""
    seen = [seen_caustic([*point.found, *point.rivals, *rivals]) for point in points]
    if page.constant_caustics:
        seen = [float(np.median([caustic for caustic in seen if caustic > 0] or [0.0]))] * len(points)
    return [row for point, caustic in zip(points, seen, strict=True) for row in _rows(page, point, rivals, caustic)]


def _rows(page: Page, point: Point, rivals: Sequence[Measured], caustic: float) -> list[Row]:
    assert page.sweep is not None
    value = page.sweep.values[point.index]
    if point.refusal:
        return [refused(value, position(value), c.label, point.refusal) for c in page.contenders]
    x = position(value)
    if value == "auto" and point.found:
        x = point.found[0].bound if page.sweep.parameter == "iws.bound" else point.found[0].radius
    rows = judge(page, value, x, point.found, point.rivals or rivals, caustic) if point.found else []
    rows += [refused(value, x, label, why) for label, why in point.failed.items()]
    order = [c.label for c in page.contenders]
    return sorted(rows, key=lambda row: order.index(row.label))


def scene_file(page: Page, place: Path, out: Path, index: int) -> Path:
    """The scene of one cell, written for this value where it comes from a template."""
    if page.room is None:
        assert page.sweep is not None
        return place / str(page.sweep.values[index])
    if page.room.template is None:
        assert page.room.file is not None
        return place / page.room.file
    scene = build(page.room.template, _parameters(page, index))
    return write_scene(scene, out / "scenes" / f"{index}.yaml")


def _parameters(page: Page, index: int) -> dict[str, Any]:
    """Of the template at one value of the sweep."""
    assert page.room is not None
    parameters = dict(page.room.set)
    if page.sweep is not None and page.sweep.parameter.startswith("scene."):
        parameters[page.sweep.parameter.removeprefix("scene.")] = _plain(page.sweep.values[index])
    return parameters


def _check_room(page: Page, place: Path) -> None:
    if page.room is None:
        if page.sweep is None or page.sweep.parameter != "scene":
            raise InputError("room: found none; allowed: none only where `sweep.parameter` is scene")
        files = [str(value) for value in page.sweep.values]
    else:
        if (page.room.template is None) == (page.room.file is None):
            raise InputError("room: found both or neither of template and file; allowed: one of them")
        files = [] if page.room.file is None else [page.room.file]
    for file in files:
        if not (place / file).is_file():
            raise InputError(f"room.file: found {file}, which does not exist; allowed: a scene file")


def check_page(page: Page, place: Path) -> None:
    """Raises InputError for a page that could not be run: scene, parameter, settings of every contender."""
    _check_room(page, place)
    if (page.sweep is None) != (page.kind != "sweep"):
        raise InputError(f"sweep: a page of kind {page.kind} {'needs' if page.sweep is None else 'has no'} sweep")
    labels = [c.label for c in page.contenders]
    if page.baseline is not None and page.baseline not in labels:
        raise InputError(f'baseline: found "{page.baseline}"; allowed: {", ".join(labels)}')
    if page.claim is not None:
        if page.baseline is None:
            raise InputError("claim: found a claim without a baseline; allowed: with `baseline`")
        for label in (page.claim.of, *page.claim.fixed):
            if label not in labels:
                raise InputError(f'claim: found "{label}"; allowed: {", ".join(labels)}')
    for index, value in enumerate(page.sweep.values if page.sweep else [0.0]):
        if page.sweep and page.sweep.parameter == "photons" and value not in LIES:
            raise InputError(f'sweep.values: found "{value}"; allowed: {", ".join(LIES)}')
        if page.room is not None and page.room.template is not None:
            build(page.room.template, _parameters(page, index))
        for contender in (*page.contenders, *page.truth.rivals):
            try:
                config_for(page.side, 1, _settings(page, value, contender))
            except msgspec.ValidationError as error:
                raise InputError(
                    f"{contender.label}, {page.sweep and page.sweep.parameter} = {value}: {error}"
                ) from None


def _settings(page: Page, value: Value, contender: Contender) -> dict[str, Any]:
    """A contender's config by dotted keys at one value of the sweep."""
    sweep = page.sweep
    if sweep is None or sweep.parameter == "photons" or _is_of_scene(sweep):
        return {**page.set, **contender.set}
    return {**page.set, sweep.parameter: _plain(value), **contender.set}


def _plain(value: Value) -> Value | int:
    """A whole number as an integer: the record of a page makes all numbers floats."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def position(value: Value) -> float:
    """Where a value stands on the chart's axis: bins of a table by their number; nan for words."""
    if isinstance(value, list):
        return float(math.prod(value))
    return math.nan if isinstance(value, str) else float(value)
