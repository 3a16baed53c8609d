"""What rank 0 keeps of a run, and when: checkpoints and progressive pictures, within their share of the time.

A write that fails in between is told once and tried again at its next turn: the last one may succeed.
"""

import math
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import msgspec
import numpy as np

from causticmpi.distributed.checkpoint import State
from causticmpi.errors import reason
from causticmpi.output.checkpoint import Checkpoint, save_checkpoint

WRITE_SHARE = 0.05
"""Progressive pictures may cost this share of the time, and so may checkpoints."""
FIRST_SAVE, FIRST_SAVE_PER_PIXEL = 0.05, 5e-7
"""Seconds reserved for a checkpoint as long as none has been written."""


class Keeper:
    """Times are seconds of the run (`elapsed`). interval, checkpoint: seconds between pictures, and between checkpoints
    (0: none). directory: made anew if someone removes it. limit: the budget has a time. resumed: the checkpoint there
    is of this run."""

    def __init__(
        self, directory: Path, interval: float, checkpoint: float, slots: int, limited: bool, resumed: bool
    ) -> None:
        self.directory, self.interval, self.checkpoint, self.limited = directory, interval, checkpoint, limited
        self.picture_cost = 0.0
        self.save_cost = FIRST_SAVE + FIRST_SAVE_PER_PIXEL * slots if checkpoint > 0 else 0.0
        self.last_picture = self.last_save = 0.0
        self.for_writing = math.inf
        self._failed: dict[str, str] = {}
        self._told: set[str] = set()
        self._ours = resumed

    def allow(self, left: float, picture: float) -> float:
        """The part of the `left` seconds that is for writing; picture: reserved for one. Fixed before the first pass:
        what hung on the cost of passes would bend the picture."""
        pictures = min(WRITE_SHARE * left, left // self.interval * picture)
        saves = min(WRITE_SHARE * left, left // self.checkpoint * self.save_cost) if self.checkpoint > 0 else 0.0
        self.for_writing = pictures + saves
        return self.for_writing

    def begin(self, elapsed: float) -> None:
        """Tracing begins: nothing but the preparation is lost until now."""
        self.last_save = elapsed

    def picture_due(self, elapsed: float, written_for: float) -> bool:
        """A progressive picture each interval, as far as the time for writing goes; without a time budget, less often
        where writing costs more than its share."""
        since = elapsed - self.last_picture
        if not self.limited:
            return since > max(self.interval, self.picture_cost / WRITE_SHARE)
        return since > self.interval and written_for + self.picture_cost <= self.for_writing

    def save_due(self, elapsed: float, round_seconds: float) -> bool:
        """Whether after one more round a checkpoint would come too late, be that round twice as dear as the last. Where
        a checkpoint costs more than its share it comes less often, and that is told."""
        if self.checkpoint == 0:
            return False
        dearest = self.save_cost / WRITE_SHARE
        if dearest > self.checkpoint:
            self._tell(
                "dear",
                f"a checkpoint takes {self.save_cost:.1f} s: one is written every {dearest:.0f} s instead of every "
                f"{self.checkpoint:g} s",
            )
        return elapsed - self.last_save + 2 * round_seconds + self.save_cost > max(self.checkpoint, dearest)

    def save(self, state: State, arrays: Mapping[str, np.ndarray], taken: float, last: bool) -> None:
        """Write the checkpoint of this state, which is that of `taken` seconds."""
        if self.checkpoint == 0:
            return
        began = time.monotonic()
        checkpoint = Checkpoint(msgspec.to_builtins(state), dict(arrays))
        if self.keep("checkpoint", lambda: save_checkpoint(self.directory, checkpoint, self._ours), last):
            self._ours = True
        self.save_cost = time.monotonic() - began
        self.last_save = taken

    def write_picture(self, write: Callable[[], object], elapsed: Callable[[], float], last: bool) -> None:
        """Write picture and report."""
        began = time.monotonic()
        self.keep("picture", write, last)
        self.picture_cost = time.monotonic() - began
        self.last_picture = elapsed()

    def keep(self, what: str, write: Callable[[], object], last: bool) -> bool:
        """Write something; False if that cannot be done: told now, or at the end by `failure` if it was the last."""
        try:
            if not self.directory.is_dir():
                self.directory.mkdir(parents=True, exist_ok=True)
                self._tell("gone", "the directory was removed while the run went on: it is made anew")
            write()
        except (OSError, RuntimeError) as error:  # OpenEXR raises the latter
            self._failed[what] = reason(error)
            if not last:
                self._tell(what, f"the {what} cannot be written ({reason(error)}): the run goes on and tries again")
            return False
        self._failed.pop(what, None)
        return True

    def failure(self) -> str:
        """One line on what could not be written at the end, "" if all could."""
        if not self._failed:
            return ""
        what = " and ".join(f"the {what} ({why})" for what, why in self._failed.items())
        return (
            f"{self.directory}: could not write {what}; what was whole before is kept: mend it and go on with --resume"
        )

    def _tell(self, key: str, text: str) -> None:
        if key not in self._told:
            self._told.add(key)
            print(f"causticmpi: warning: {self.directory}: {text}", file=sys.stderr, flush=True)
