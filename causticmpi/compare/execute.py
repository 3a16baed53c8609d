"""The runs of a comparison under one MPI launch, one after the other; what is finished is never repeated."""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from causticmpi.compare.files import FINISHED, SNAPSHOTS, is_finished, mark_finished, run_key
from causticmpi.compare.plan import Plan, Run, reference_runs
from causticmpi.compare.reference import (
    ReferencePicture,
    assemble,
    read_reference,
    reference_directory,
    told,
)
from causticmpi.distributed.begin import Request, sound_scene
from causticmpi.distributed.clock import Stopwatch
from causticmpi.distributed.job import render_one
from causticmpi.distributed.signals import StopFlag
from causticmpi.distributed.snapshots import Snapshots
from causticmpi.distributed.warmup import warm_up, warm_up_parts
from causticmpi.distributed.world import World
from causticmpi.errors import InputError
from causticmpi.output.directory import UNFINISHED, check_directory, write_whole
from causticmpi.output.progress import clock
from causticmpi.render.methods import FORECASTING
from causticmpi.scene.content import has_specular

UNTIMED = 60.0
"""Seconds assumed of a run whose budget counts samples, for the time left."""


@dataclass(frozen=True)
class Scenes:
    """What rank 0 knows of every part's scene: its content hash, and whether caustics can occur."""

    hashes: Mapping[str, str]
    specular: Mapping[str, bool]


@dataclass(frozen=True)
class Task:
    """A run to make, the key that marks it as finished, and whether it leaves snapshots."""

    run: Run
    key: str
    snapshots: bool


@dataclass(frozen=True)
class Outcome:
    """What is left for rank 0 to do: signal that stopped the runs (0: all done); references by part, on rank 0."""

    plan: Plan
    signal: int
    references: Mapping[str, ReferencePicture]


def execute(world: World, read_plan: Callable[[], Plan], command: tuple[str, ...], references_only: bool) -> Outcome:
    """Collective. Make the references that are missing, then the runs that are missing.

    Raises AgreedInputError for bad input, before any run is started.
    """
    plan, scenes, references = _read(world, read_plan)
    wanted: list[Task] = world.broadcast(_missing_batches(world, plan, scenes, references) if world.is_root else None)
    with StopFlag() as flag:
        runs: list[Task] = (
            [] if references_only else world.broadcast(_missing_runs(world, plan, scenes) if world.is_root else None)
        )
        _warm_up(world, [task.run for task in (*wanted, *runs)], scenes)
        signal = _make(world, wanted, command, flag, "reference")
        if signal == 0 and world.is_root:
            for part in plan.parts:
                if part.name not in references:
                    references[part.name] = _assembled(plan, part.name, scenes)
        if signal == 0:
            signal = _make(world, runs, command, flag, "run")
    if world.is_root:
        _leave_word(plan, signal)
    return Outcome(plan, signal, references)


def _read(world: World, read_plan: Callable[[], Plan]) -> tuple[Plan, Scenes, dict[str, ReferencePicture]]:
    """Rank 0 reads all input; every rank gets the plan."""
    error: InputError | None = None
    plan: Plan | None = None
    scenes = Scenes({}, {})
    references: dict[str, ReferencePicture] = {}
    if world.is_root:
        try:
            plan = read_plan()
            check_directory(plan.directory, force=True)
            scenes = _examine(plan, world.node_size)
            for part in plan.parts:
                directory = reference_directory(plan, part, scenes.hashes[part.name])
                found = read_reference(directory, part, scenes.hashes[part.name])
                if found is not None:
                    references[part.name] = found
        except InputError as found_error:
            error = found_error
    world.agree(error)
    return world.broadcast(plan), world.broadcast(scenes), references


def _examine(plan: Plan, ranks: int) -> Scenes:
    hashes, specular = {}, {}
    for part in plan.parts:
        scene = sound_scene(part.base, part.scene_file, ranks)
        hashes[part.name], specular[part.name] = scene.content_hash, has_specular(scene)
    return Scenes(hashes, specular)


def _missing_batches(
    world: World, plan: Plan, scenes: Scenes, references: Mapping[str, ReferencePicture]
) -> list[Task]:
    tasks: dict[Path, list[Task]] = {}
    for part in plan.parts:
        scene_hash = scenes.hashes[part.name]
        directory = reference_directory(plan, part, scene_hash)
        if part.name in references or directory in tasks:  # parts may share a reference
            continue
        found = [
            Task(run, run_key(run, scene_hash, world.size), False) for run in reference_runs(plan, part, directory)
        ]
        tasks[directory] = [task for task in found if not is_finished(task.run, task.key)]
    return [task for missing in tasks.values() for task in missing]


def _missing_runs(world: World, plan: Plan, scenes: Scenes) -> list[Task]:
    tasks = [Task(run, run_key(run, scenes.hashes[run.part], world.size), True) for run in plan.runs]
    return [task for task in tasks if not is_finished(task.run, task.key)]


def _assembled(plan: Plan, name: str, scenes: Scenes) -> ReferencePicture:
    part = next(part for part in plan.parts if part.name == name)
    directory = reference_directory(plan, part, scenes.hashes[name])
    found = read_reference(directory, part, scenes.hashes[name])  # another part may have made it
    if found is None:
        batches = reference_runs(plan, part, directory)
        found = assemble(part, batches, directory, scenes.hashes[name], plan.config.reference.block)
    print(f"{directory}: {told(found.facts)}", flush=True)
    if not found.facts["agrees"]:
        print(f"causticmpi: warning: {directory}: the two methods of the reference disagree", file=sys.stderr)
    return found


def _warm_up(world: World, runs: Sequence[Run], scenes: Scenes) -> None:
    """Compile and load all kernels before the first budget starts, so that no run pays for those after it."""
    kinds = {(run.config.method, run.config.forecast, scenes.specular[run.part]): run for run in runs}
    wanted = [(run.config, specular and method in FORECASTING) for (method, _, specular), run in kinds.items()]

    def all_kinds() -> None:
        for config, forecasting in wanted:
            warm_up(config, world.is_root, forecasting)

    def in_turn(parts: Sequence[Callable[[], None]]) -> None:
        for part in parts:
            part()

    # As many parts as one kind has: kinds share most kernels, and rank 1 is warm for what renders give it.
    parts = zip(*(warm_up_parts(*kind) for kind in wanted), strict=True)
    world.first_on_node(all_kinds, [partial(in_turn, part) for part in parts])


def _make(world: World, tasks: Sequence[Task], command: tuple[str, ...], flag: StopFlag, kind: str) -> int:
    """Collective. Run the tasks in order; returns the signal that stopped them, or 0."""
    began, done = time.monotonic(), 0.0
    whole = sum(_expected(task) for task in tasks)
    for number, task in enumerate(tasks, 1):
        stopped = world.all_max(flag.raised)
        if stopped:
            return stopped
        run = task.run
        if world.is_root:
            pace = (time.monotonic() - began) / done if done > 0 else 1.0
            left = clock(pace * (whole - done))
            budget = f"{run.seconds:g} s" if run.seconds is not None else f"{run.config.budget.spp} samples per pixel"
            what = f"{run.part}, {run.label}, {budget}, seed {run.seed}"
            print(f"{kind} {number} of {len(tasks)}, about {left} left: {what}", flush=True)
            (run.directory / FINISHED).unlink(missing_ok=True)
        snapshots = Snapshots() if task.snapshots else None
        read_request = partial(Request, run.config, run.scene_file, True, command)
        signal = render_one(world, read_request, Stopwatch(from_now=True), flag, snapshots)
        if signal:
            return signal
        if world.is_root:
            _finish(task, snapshots)
        done += _expected(task)
    return 0


def _finish(task: Task, snapshots: Snapshots | None) -> None:
    x0, y0, x1, y1 = task.run.config.film.window
    if snapshots is not None:
        snapshots.write(task.run.directory / SNAPSHOTS, y1 - y0, x1 - x0)
    mark_finished(task.run, task.key)


def _expected(task: Task) -> float:
    return task.run.seconds if task.run.seconds is not None else UNTIMED


def _leave_word(plan: Plan, signal: int) -> None:
    """The file that tells a batch script to start the comparison again, there exactly while it is unfinished."""
    plan.directory.mkdir(parents=True, exist_ok=True)
    path = plan.directory / (UNFINISHED if plan.scene is None else f"{UNFINISHED}-{plan.scene}")
    if signal:
        write_whole(path, lambda file: file.write_text(f"stopped by signal {signal}\n"))
    else:
        path.unlink(missing_ok=True)
