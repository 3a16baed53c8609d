"""Who is silent? While a run traces, each rank tells the next one now and then that it is alive.

A ring: one short message an interval from each rank, however many there are. A rank speaks between batches and while
it waits for others, so one that is stopped, swapped out or on a machine that hangs falls silent, and the next one says
so. A rank that is heard again goes on as if nothing had been; one that stays silent would hold up all others for ever,
so the run is ended, to be resumed from its last checkpoint.
"""

import contextlib
import os
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

TAG = 2
PATIENCE = 300.0
"""Seconds of silence that end a run, unless $CAUSTICMPI_PATIENCE says otherwise."""
TOLD_AFTER, INTERVAL = 0.2, 0.01
"""In parts of the patience: when silence is told, and from one message to the next."""
TRACING, WRITING = 0, 1
"""What a rank says of itself."""
WRITERS = 6
"""A disk may take its time: who writes may be silent for so many times the patience."""


def patience() -> float:
    """Seconds a rank may be silent."""
    try:
        return max(1.0, float(os.environ.get("CAUSTICMPI_PATIENCE", PATIENCE)))
    except ValueError:
        return PATIENCE


class Watchdog:
    """One rank's part of the ring. comm: an mpi4py communicator; hosts: by rank."""

    def __init__(self, comm: Any, hosts: Sequence[str]) -> None:
        self.comm, self.hosts = comm, hosts
        self.next, self.watched = (comm.rank + 1) % comm.size, (comm.rank - 1) % comm.size
        self.patience = patience()
        self.heard_at = time.monotonic()
        self.heard = np.zeros(1, np.uint8)
        self.word = np.zeros(1, np.uint8)
        self.told = False
        self._next_look = self.heard_at
        self._sending: Any = None

    def pulse(self, word: int | None = None) -> bool:
        """Say that this rank is alive and listen to the one before; False if that has to be given up.

        To be called often; does nothing within an interval. word: TRACING or WRITING, said at once.
        """
        now = time.monotonic()
        if word is None and now < self._next_look:
            return True
        if now > self._next_look + TOLD_AFTER * self.patience / 2:
            self.heard_at = now  # this rank was away itself: what came meanwhile may take several looks to show
        self._next_look = now + INTERVAL * self.patience
        if self._sending is None or self._sending.Test():
            self.word[0] = self.word[0] if word is None else word
            self._sending = self.comm.Isend(self.word.copy(), self.next, TAG)
        self._listen(now)
        silent = now - self.heard_at
        if silent > TOLD_AFTER * self.patience and not self.told:
            self.told = True
            self._say(f"has been {'writing' if self.heard[0] == WRITING else 'silent'} for {silent:.0f} s")
        if silent > self.patience * (WRITERS if self.heard[0] == WRITING else 1):
            self._say(
                f"has been silent for {silent:.0f} s: ending all ranks; go on from the last checkpoint by --resume"
            )
            return False
        return True

    def _listen(self, now: float) -> None:
        while self.comm.Iprobe(self.watched, TAG):
            self.comm.Recv(self.heard, self.watched, TAG)
            if self.told:
                self._say(f"is heard again after {now - self.heard_at:.0f} s")
            self.heard_at, self.told = now, False

    def drain(self) -> None:
        """Take what has come; after a barrier."""
        while self.comm.Iprobe(self.watched, TAG):
            self.comm.Recv(self.heard, self.watched, TAG)

    def _say(self, what: str) -> None:
        host = self.hosts[self.watched]
        print(f"causticmpi: rank {self.watched} of {self.comm.size} on {host} {what}", file=sys.stderr, flush=True)


@contextlib.contextmanager
def given_up_in_time(who: str) -> Iterator[None]:
    """End this rank, and by that all, if the block outlasts the patience: for calls that MPI only has in blocking form.

    The ring cannot speak in there, as the main thread waits in the library; a timer's thread can. who: this rank.
    """

    def give_up() -> None:
        print(
            f"causticmpi: {who} has waited {patience():.0f} s for a rank that does not answer: ending all ranks; go on "
            "from the last checkpoint by --resume",
            file=sys.stderr,
            flush=True,
        )
        time.sleep(0.1)  # the launcher passes stderr on
        os._exit(1)

    timer = threading.Timer(patience(), give_up)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
