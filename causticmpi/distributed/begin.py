"""What rank 0 reads and finds to be sound before any rank works: config, scene, directory, the run to go on with."""

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from causticmpi.config.records import RenderConfig
from causticmpi.distributed.checkpoint import State, find_state, picture_is_of, require_same_run
from causticmpi.distributed.clock import Stopwatch
from causticmpi.distributed.until import ended
from causticmpi.distributed.world import World
from causticmpi.errors import InputError
from causticmpi.output.directory import UNFINISHED, Claim, check_directory, claim_directory
from causticmpi.preprocess.aim import emission_aim
from causticmpi.render.memory import check_memory
from causticmpi.scene.content import with_camera
from causticmpi.scene.data import SceneData
from causticmpi.scene.load import load_scene


@dataclass(frozen=True)
class Request:
    """What rank 0 read from the command line. resume: go on from the directory's checkpoint; command: for the
    provenance."""

    config: RenderConfig
    scene_file: Path
    force: bool
    command: tuple[str, ...]
    resume: bool = False


@dataclass(frozen=True)
class Input:
    """What rank 0 found to be sound; other ranks have the request alone. state, arrays: of the run to go on with."""

    request: Request
    scene: SceneData | None = None
    state: State | None = None
    arrays: Mapping[str, np.ndarray] | None = None


def sound_scene(config: RenderConfig, scene_file: Path, ranks: int = 1) -> SceneData:
    """The scene as the config wants it seen. ranks: on this node. Raises InputError for whatever of these cannot be
    rendered here."""
    scene = load_scene(scene_file)
    if config.camera is not None:
        scene = with_camera(scene, config.camera)
    emission_aim(config.forecast.aim, scene)
    check_memory(config, scene, ranks)
    return scene


def read_input(world: World, read_request: Callable[[], Request], watch: Stopwatch) -> Input:
    """Rank 0 reads everything that can be wrong before a rank does any work; all ranks learn of the verdict."""
    error: InputError | None = None
    given = None
    if world.is_root:
        try:
            with watch.stage("load"):
                request = read_request()
                scene = sound_scene(request.config, request.scene_file, world.node_size)
            check_directory(request.config.output.directory, force=request.force, resume=request.resume)
            given = _with_state(Input(request, scene)) if request.resume else Input(request, scene)
        except InputError as found:
            error = found
    world.agree(error)
    request = world.broadcast(given.request if given is not None else None)
    return given if given is not None else Input(request)


def _with_state(given: Input) -> Input:
    """The input with the state of the run to go on with, if there is one. Raises InputError for that of another run."""
    config, scene = given.request.config, given.scene
    assert scene is not None
    directory = Path(config.output.directory)
    state, arrays, damaged = find_state(directory)
    for line in damaged:
        print(f"causticmpi: warning: {line}", file=sys.stderr)
    if state is None:
        print(f"causticmpi: {directory}: no {'usable ' if damaged else ''}checkpoint, starting afresh", file=sys.stderr)
        return given
    require_same_run(state, config, scene.content_hash, directory)
    return replace(given, state=state, arrays=arrays)


def nothing_to_do(given: Input) -> bool:
    """Whether the run to be resumed has all that the budget asks for, its picture too; says which is the case."""
    config, state = given.request.config, given.state
    directory = Path(config.output.directory)
    if state is None or given.arrays is None:
        return False
    reached = ended(given.arrays)
    if not (reached or state.covers(config.budget)) or not picture_is_of(directory, state.passes):
        print(f"causticmpi: {directory}: going on from the {state.passes} passes of its checkpoint", file=sys.stderr)
        return False
    (directory / UNFINISHED).unlink(missing_ok=True)
    done = f"{state.passes} pass{'' if state.passes == 1 else 'es'}"
    why = "the budget asks for no more and the picture stays as it is; extend the run by a larger --time or --spp"
    if reached:
        why = f"its halves reached the wanted error {config.budget.until} and the picture stays as it is"
    print(f"{directory}: holds {done} in {state.elapsed:.1f} s already, {why}", flush=True)
    return True


def claim(world: World, request: Request) -> Claim | None:
    """Rank 0 takes the directory, once nothing of the input is left that could be wrong."""
    error: InputError | None = None
    claim = None
    if world.is_root:
        try:
            claim = claim_directory(request.config.output.directory, force=request.force, resume=request.resume)
        except InputError as found:
            error = found
    world.agree(error)
    return claim
