"""How far a render has come, told by rank 0: a bar on a terminal, a line now and then in a batch log."""

import contextlib
import os
import sys
import time
from typing import Any, Self, TextIO

# Plain lines: seconds between two of them, at first and once FIRST_PHASE seconds have passed.
FIRST_INTERVAL, LATER_INTERVAL, FIRST_PHASE = 10.0, 60.0, 60.0
# Seconds between two drawings of the bar: no one reads faster, and drawing costs about a millisecond.
DRAW_INTERVAL = 0.1


class Progress:
    """Progress towards a budget of wall-clock seconds or of samples per pixel (either may be None: unknown).

    stream: where to write, standard error unless given; a terminal gets a bar (drawn by `rich`, imported only then),
    anything else plain lines, about one per 10 s in the first minute, then one per minute.

    Telling is a courtesy: a stream that breaks ends it, never the render. Not for several threads.
    """

    def __init__(
        self,
        total_seconds: float | None,
        total_spp: int | None,
        stream: TextIO | None = None,
    ) -> None:
        self._total_seconds, self._total_spp = total_seconds, total_spp
        self._stream = stream if stream is not None else sys.stderr
        self._name = "starting"
        self._seen: set[str] = set()
        self._pending = ""
        self._last_line = 0.0  # in `elapsed` seconds
        self._last_drawn = 0.0  # in `time.monotonic` seconds
        self._bar: Any = None
        self._silent = self._stream is None  # a program without a standard error
        if not self._silent and _is_terminal(self._stream):
            self._bar = _open_bar(self._stream)
            self._task = self._bar.add_task(self._name, total=1.0, status="")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def stage(self, name: str) -> None:
        """Say what is being done now ("photons"). A plain stream is told of each stage once."""
        if name == self._name:
            return
        self._name = name
        if self._bar is not None:
            self._draw(description=name)
        elif name not in self._seen:
            self._line(name)
        self._seen.add(name)

    def update(
        self,
        elapsed: float,
        passes: int,
        spp: float,
        rays_per_second: float,
        estimated_relmse: float | None,
        factor: float | None = None,
    ) -> None:
        """Tell the state of the picture; call it as often as is handy.

        elapsed: wall-clock seconds of the budget; passes, spp: done so far; rays_per_second: of all ranks;
        estimated_relmse: None while it is unknown (fewer than two passes); factor: that it may be off by.
        """
        left = self._seconds_left(elapsed, spp)
        time_left = "time left unknown" if left is None else f"{clock(left)} left"
        rate = f"{_si(rays_per_second)}rays/s"
        error = "unknown" if estimated_relmse is None else f"{estimated_relmse:.3g}"
        error += "" if estimated_relmse is None or factor is None else f" within x {factor:.2f}"
        if self._bar is not None:  # short: it shares 80 columns with the bar
            samples = f"{spp:g} spp" if self._total_spp is None else f"{spp:g}/{self._total_spp} spp"
            status = f"{time_left}, {samples}, {rate}, relMSE {error}"
            self._draw(completed=self._fraction(elapsed, spp), status=status)
            return
        self._pending = ", ".join(
            (
                clock(elapsed) + ("" if self._total_seconds is None else f" of {clock(self._total_seconds)}"),
                time_left,
                f"{spp:g} spp" if self._total_spp is None else f"{spp:g} of {self._total_spp} spp",
                f"{passes} pass{'' if passes == 1 else 'es'}",
                rate,
                f"estimated relMSE {error}",
            )
        )
        if elapsed - self._last_line >= (FIRST_INTERVAL if elapsed <= FIRST_PHASE else LATER_INTERVAL):
            self._last_line = elapsed
            self._tell_pending()

    def close(self) -> None:
        """Leave the last state on the screen or in the log, and the terminal as it was. Twice does no harm."""
        if self._bar is not None:
            with contextlib.suppress(OSError, ValueError):
                self._bar.stop()  # draws the last state
            self._bar, self._silent = None, True
        elif self._pending:
            self._tell_pending()

    def _fraction(self, elapsed: float, spp: float) -> float:
        """Of the budget that is further used up, in [0, 1]."""
        shares = [0.0]
        if self._total_seconds:
            shares.append(elapsed / self._total_seconds)
        if self._total_spp:
            shares.append(spp / self._total_spp)
        return min(max(shares), 1.0)

    def _seconds_left(self, elapsed: float, spp: float) -> float | None:
        """Until the first budget is used up; samples are extrapolated at this run's rate so far."""
        lefts = []
        if self._total_seconds is not None:
            lefts.append(self._total_seconds - elapsed)
        if self._total_spp is not None and spp > 0:
            lefts.append((self._total_spp - spp) * elapsed / spp)
        return max(min(lefts), 0.0) if lefts else None

    def _tell_pending(self) -> None:
        line, self._pending = f"{self._name}: {self._pending}", ""
        self._line(line)

    def _line(self, text: str) -> None:
        if not self._silent:
            try:
                self._stream.write(f"causticmpi: {text}\n")
                self._stream.flush()
            except (OSError, ValueError):  # gone or closed
                self._silent = True

    def _draw(self, **fields: Any) -> None:
        if not self._silent:
            try:
                self._bar.update(self._task, **fields)
                now = time.monotonic()
                if now - self._last_drawn >= DRAW_INTERVAL or "description" in fields:
                    self._last_drawn = now
                    self._bar.refresh()
            except (OSError, ValueError):
                self._silent = True


def _is_terminal(stream: TextIO) -> bool:
    try:
        return stream.isatty() and os.environ.get("TERM", "").lower() not in ("dumb", "unknown")
    except ValueError:  # closed
        return False


def _open_bar(stream: TextIO) -> Any:
    from rich.console import Console
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn
    from rich.progress import Progress as Bar

    class Screen(Console):
        def on_broken_pipe(self) -> None:
            raise  # noqa: PLE0704  (inside the except block of the caller; the original would exit the program)

    # No refresh thread: this process renders, and a thread would take its core. `update` draws.
    bar = Bar(
        TextColumn("{task.description}"),
        BarColumn(bar_width=12),
        TaskProgressColumn(),
        TextColumn("{task.fields[status]}", markup=False),
        console=Screen(file=stream),
        auto_refresh=False,
        redirect_stdout=False,
        redirect_stderr=False,
    )
    bar.start()
    return bar


def clock(seconds: float) -> str:
    """Seconds as m:ss, or h:mm:ss from an hour on."""
    minutes, rest = divmod(int(seconds + 0.5), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _si(number: float) -> str:
    for limit, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if number >= limit:
            return f"{number / limit:.3g} {letter}"
    return f"{number:.3g} "
