"""The state of a run: what its samples depend on, how far it has come and what that took; and whether to go on from it.

Forecast maps are not kept: the seed makes them anew, bit for bit, and their hash tells if it did not.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from causticmpi import __version__
from causticmpi.config.records import Budget, RenderConfig
from causticmpi.errors import InputError
from causticmpi.kernels.jit import source_hash
from causticmpi.output.checkpoint import Checkpoint, find_checkpoint
from causticmpi.output.directory import EXR, PNG, REPORT
from causticmpi.preprocess.forecast import ForecastMaps
from causticmpi.preprocess.guides import Guides
from causticmpi.preprocess.lamp_sight import LampSight

NOT_SAMPLES = ("scene", "camera", "budget", "output")
"""Sections of a config that no sample depends on, or that the scene's hash covers."""
MEND = "go on as it was begun, start anew with --force, or choose another directory with --out"


class State(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A run between two rounds; its sums over passes and ranks are an array of the checkpoint.

    version: of the program and its kernels; config: `sample_keys`; scene: content hash; seeds: one, or those of a
    merged run; maps: hash of the forecast maps. passes, rays, nonfinite: of the merged rounds; rounds: their number,
    round_passes: their length. budget: what the run was asked for; complete: that is spent. Seconds of all starts
    without what was dropped or lost: `preparing` until the first pass, `tracing`, `writing`; by stage in `stages`.
    """

    version: str
    config: dict[str, Any]
    scene: str
    seeds: tuple[int, ...]
    maps: str
    passes: int
    rays: int
    nonfinite: int
    rounds: int
    round_passes: int
    budget: Budget
    complete: bool
    preparing: float
    tracing: float
    writing: float
    stages: dict[str, float]

    @property
    def elapsed(self) -> float:
        """Seconds of the budget that are in the sums."""
        return self.preparing + self.tracing + self.writing

    def covers(self, budget: Budget) -> bool:
        """Whether the budget asks for nothing further."""
        if budget.spp is not None:
            return self.passes >= budget.spp
        spent = self.elapsed
        if self.complete and self.budget.time is not None:
            spent = max(spent, float(self.budget.time))
        return float(budget.time or 0) <= spent


def samples_version() -> str:
    """Version of whatever makes samples: one kernel changed is another version."""
    return f"{__version__} ({source_hash()})"


def sample_keys(config: RenderConfig) -> dict[str, Any]:
    """The config as plain values by dotted key, without what no sample depends on."""
    plain = {name: value for name, value in msgspec.to_builtins(config).items() if name not in NOT_SAMPLES}
    return dict(_flat(json.loads(json.dumps(plain)), ""))


def _flat(value: Any, key: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _flat(inner, f"{key}.{name}" if key else name)
    else:
        yield key, value


def maps_hash(maps: ForecastMaps, guides: Guides, sight: LampSight) -> str:
    """sha256 (hex) of all arrays and numbers of the maps, the guides and of where lamps are seen."""
    digest = hashlib.sha256()
    learned = (*guides.virtual_lights, *guides.light_tracing, guides.paths_per_pixel, *sight)
    for name, value in (*maps._asdict().items(), *enumerate(learned)):
        array = np.ascontiguousarray(value)
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def find_state(directory: Path) -> tuple[State | None, Mapping[str, np.ndarray], list[str]]:
    """Newest usable state of a directory, its arrays, and a line for each checkpoint that is damaged.

    Raises InputError for a checkpoint of another version.
    """
    found, notes = find_checkpoint(directory)
    if found is None:
        return None, {}, notes
    return read_state(found, directory), found.arrays, notes


def read_state(checkpoint: Checkpoint, directory: Path) -> State:
    """The state in a checkpoint. Raises InputError for one of another version, which may mean other things by it."""
    version = checkpoint.facts.get("version")
    if version != samples_version():
        raise InputError(f"its checkpoint is of version {version}, this is {samples_version()}: {MEND}", directory)
    return msgspec.convert(checkpoint.facts, State)


def require_same_run(state: State, config: RenderConfig, scene_hash: str, directory: Path) -> None:
    """Raises InputError unless the state is one of this very config, wanted error, seed and scene."""
    if len(state.seeds) > 1:
        raise InputError(
            f"it holds a merge of the seeds {', '.join(map(str, state.seeds))}, which has no next pass: render another "
            "seed into a directory of its own and merge that too",
            directory,
        )
    difference = unlike(state, sample_keys(config), scene_hash)
    old, new = state.budget.until, config.budget.until
    if not difference and old != new:  # the halves are ended by the very error, or not told apart at all
        difference = f"budget.until {json.dumps(old)}, here {json.dumps(new)}"
    if difference:
        raise InputError(f"its checkpoint has {difference}: {MEND}", directory)


def unlike(state: State, keys: Mapping[str, Any], scene_hash: str, but: tuple[str, ...] = ()) -> str:
    """The first difference in words, "" where there is none. but: keys that may differ."""
    if state.scene != scene_hash:
        return f"another scene (content {state.scene[:12]}, here {scene_hash[:12]})"
    for key in {**keys, **state.config}:
        old, new = state.config.get(key), keys.get(key)
        if old != new and key not in but:
            return f"{key} {json.dumps(old)}, here {json.dumps(new)}"
    return ""


def picture_is_of(directory: Path, passes: int) -> bool:
    """Whether picture and report of this many passes lie there."""
    try:
        report = json.loads((directory / REPORT).read_text())
        return all((directory / name).is_file() for name in (EXR, PNG)) and report.get("passes") == passes
    except (OSError, ValueError, AttributeError):
        return False
