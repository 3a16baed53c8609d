"""Signals that ask a run to stop only set a flag; the ranks agree on it between batches and save."""

import signal
import sys
import time
from types import FrameType, TracebackType
from typing import Any, Self

STOPPING = (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1)

IMPATIENCE = 0.5
"""Seconds: a terminal's Ctrl-C may arrive twice (from it and from a launcher), a second press comes later."""


class StopFlag:
    """Which signal asked to stop: `raised` is its number, 0 for none. `with StopFlag() as flag: ...`

    SIGTERM, SIGINT, SIGUSR1 set the flag, any number of times; SIGCONT, which batch systems send along, is ignored. A
    second Ctrl-C at a terminal interrupts at once (KeyboardInterrupt).
    """

    def __init__(self) -> None:
        self._raised = 0
        self._interrupted_at: float | None = None
        self._previous: dict[int, Any] = {}

    @property
    def raised(self) -> int:
        """Number of the first signal received, 0 for none."""
        return self._raised

    def install(self) -> Self:
        """Take the signals over. Raises ValueError outside the main thread."""
        for number in STOPPING:
            self._previous[number] = signal.signal(number, self._handle)
        self._previous[signal.SIGCONT] = signal.signal(signal.SIGCONT, signal.SIG_IGN)
        return self

    def restore(self) -> None:
        """Give the signals back to whoever had them."""
        for number, handler in self._previous.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)
        self._previous.clear()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self._raised = self._raised or number
        if number != signal.SIGINT:
            return
        now = time.monotonic()
        if self._interrupted_at is None:
            self._interrupted_at = now
        elif now - self._interrupted_at > IMPATIENCE and sys.stdin is not None and sys.stdin.isatty():
            raise KeyboardInterrupt

    def __enter__(self) -> Self:
        return self.install()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.restore()
