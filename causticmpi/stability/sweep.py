"""A page's cells: one parameter over values, all contenders at each, and the rivals they are held against."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from causticmpi.errors import InputError
from causticmpi.scene.load import load_scene
from causticmpi.stability.cell import Measured, config_for, measure, passes_within, set_up
from causticmpi.stability.judge import judge, seen_caustic
from causticmpi.stability.lies import LIES
from causticmpi.stability.records import Contender, Page, Sweep, Value
from causticmpi.stability.row import Row, refused
from causticmpi.stability.scenes import build, write_scene

RIVAL_SECONDS, COMMON_RIVAL_SECONDS = 2.0, 8.0
"""A rival gets this many times the CPU time of a contender, more where it serves all cells of a page."""
SEED, RIVAL_SEED, NEXT_SEED = 1, 1001, 2000


@dataclass(frozen=True)
class Point:
    """What was measured at one value. failed: reason by contender; refusal: of the scene, empty if it was taken."""

    index: int
    found: list[Measured]
    rivals: list[Measured]
    failed: dict[str, str]
    refusal: str = ""


def rivals_are_common(page: Page) -> bool:
    """Whether the scene is one for all values, so that the rivals need to be measured once."""
    return page.sweep is not None and not _is_of_scene(page.sweep)


def _is_of_scene(sweep: Sweep) -> bool:
    return sweep.parameter == "scene" or sweep.parameter.startswith("scene.")


def measure_point(page: Page, place: Path, out: Path, index: int, scale: float, turn: int = 0) -> Point:
    """One value of the sweep, rivals included where the scene changes. scale: of all CPU times; turn: which of several
    seeds, the first of which has the rivals of all.

    place: directory of the page; out: for scenes. A refused scene, or a method that gives up, is told in the point.
    """
    try:
        file = scene_file(page, place, out, index)
        load_scene(file)
    except InputError as error:
        return Point(index, [], [], {}, str(error))
    assert page.sweep is not None
    value = page.sweep.values[index]
    lie = str(value) if page.sweep.parameter == "photons" else "none"
    found, failed = [], {}
    for i, contender in enumerate(page.contenders):
        settings = _settings(page, value, contender)
        try:
            found.append(_one(page, contender.label, file, settings, SEED + i + NEXT_SEED * turn, scale, lie))
        except (InputError, ValueError, RuntimeError) as error:
            failed[contender.label] = str(error)
    needs_rivals = turn == 0 and not rivals_are_common(page)
    return Point(index, found, _rivals(page, file, RIVAL_SECONDS, scale) if needs_rivals else [], failed)


def point_seconds(page: Page, scale: float, turn: int) -> float:
    """CPU seconds that `measure_point` takes, about, without those of forecasts."""
    own_rivals = turn == 0 and not rivals_are_common(page)
    return scale * page.seconds * (len(page.contenders) + own_rivals * RIVAL_SECONDS * len(page.truth.rivals))


def rivals_seconds(page: Page, scale: float) -> float:
    """CPU seconds that `measure_rivals` takes, about."""
    return scale * page.seconds * COMMON_RIVAL_SECONDS * len(page.truth.rivals)


def rivals_of(page: Page, place: Path) -> str:
    """What `measure_rivals` depends on: the same for pages that can share them."""
    made = page.truth.rivals, page.room, page.set, page.side, page.seconds, page.batches, page.batch_passes
    return f"{place} {made}"


def measure_rivals(page: Page, place: Path, out: Path, scale: float) -> list[Measured]:
    """The rivals of all cells of a page whose scene is one for all values."""
    return _rivals(page, scene_file(page, place, out, 0), COMMON_RIVAL_SECONDS, scale)


def _rivals(page: Page, file: Path, factor: float, scale: float) -> list[Measured]:
    return [
        _one(page, rival.label, file, {**page.set, **rival.set}, RIVAL_SEED + i, factor * scale)
        for i, rival in enumerate(page.truth.rivals)
    ]


def _one(
    page: Page, label: str, file: Path, settings: Mapping[str, Any], seed: int, factor: float, lie: str = "none"
) -> Measured:
    """factor: of the page's CPU time or passes."""
    bench = set_up(file, config_for(page.side, seed, settings), lie)
    try:
        if page.batch_passes is None:
            passes = passes_within(bench, page.seconds * factor) / page.batches
        else:
            passes = page.batch_passes * factor
        return measure(bench, label, max(1, round(passes)), page.batches)
    finally:
        bench.close()


def rows_by_seed(page: Page, points: Sequence[Point], rivals: Sequence[Measured], turns: int) -> list[list[Row]]:
    """The judged rows of all values by each seed, whose points follow one another; all use the first seed's rivals."""
    count = len(points) // turns
    made = []
    for turn in range(turns):
        own = [replace(point, rivals=points[i].rivals) for i, point in enumerate(points[turn * count :][:count])]
        made.append(all_rows(page, own, rivals))
    return made


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
