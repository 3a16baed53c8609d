"""The output directory: who may write there, and files written whole or not at all."""

import contextlib
import os
import secrets
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from causticmpi.errors import InputError, reason
from causticmpi.output.exr import AttributeValue, write_exr
from causticmpi.output.picture import Picture
from causticmpi.output.png import write_png
from causticmpi.output.report import write_report

EXR, PNG, REPORT, UNFINISHED = "image.exr", "image.png", "report.json", "unfinished"
RESULTS = (EXR, PNG, REPORT)
STATE = ("checkpoint*", UNFINISHED)
TEMPORARY = ".causticmpi-*.tmp"


@dataclass(frozen=True)
class Claim:
    """A directory that is ours to write to.

    stale: (path, inode, mtime in ns) of checkpoints and markers of an old run that --force is to replace.
    """

    directory: Path
    stale: tuple[tuple[Path, int, int], ...] = ()

    def discard_stale(self) -> None:
        """Remove what the old run left beside its results; call it after the first `write_run`, never earlier.

        Otherwise a later --resume would take up the old run. Files rewritten since the claim are ours and stay.
        """
        for path, inode, mtime in self.stale:
            with contextlib.suppress(OSError):
                status = path.lstat()
                if (status.st_ino, status.st_mtime_ns) == (inode, mtime):
                    path.unlink()


def check_directory(path: str | os.PathLike[str], force: bool = False, resume: bool = False) -> None:
    """Raise InputError where a run cannot be written to `path`; leaves nothing behind, no directory either.

    Refused: a file, a place that cannot be written to (tried, because permissions tell root nothing), and a
    directory that holds a run, unless `force` or `resume`.
    """
    directory = _refuse_run(path, force, resume)
    made = _try_writing(directory)
    for parent in made:
        with contextlib.suppress(OSError):  # not empty: someone else is using it by now
            parent.rmdir()


def claim_directory(path: str | os.PathLike[str], force: bool = False, resume: bool = False) -> Claim:
    """As `check_directory`, but create the directory and keep it. An old run's files stay until replaced.

    Temporary files that a killed run left are removed when `force` or `resume` says the directory is ours.
    Raises InputError.
    """
    directory = _refuse_run(path, force, resume)
    _try_writing(directory)
    stale = []
    if force or resume:
        for leftover in directory.glob(TEMPORARY):
            leftover.unlink(missing_ok=True)
    if force and not resume:
        for pattern in STATE:
            for old in directory.glob(pattern):
                if not old.is_dir():
                    status = old.lstat()
                    stale.append((old, status.st_ino, status.st_mtime_ns))
    return Claim(directory, tuple(stale))


def write_whole(path: str | os.PathLike[str], writer: Callable[[Path], object]) -> None:
    """Have `writer` write a temporary file in the same directory, then put it in place of `path` in one step.

    `path` holds the old content or the new one, whenever the machine stops. Whatever `writer` raises is passed on,
    and the temporary file is removed. Raises OSError where the directory cannot be written to.
    """
    path = Path(path)
    temporary = path.with_name(f".causticmpi-{path.name}-{secrets.token_hex(4)}.tmp")
    try:
        # Not mkstemp: its files are for the owner only, a result is for whomever the umask allows.
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        writer(temporary)
        _sync(temporary)
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise
    with contextlib.suppress(OSError):  # some file systems cannot sync a directory; the file itself is safe
        _sync(path.parent)


def write_run(
    directory: str | os.PathLike[str],
    picture: Picture,
    report: Mapping[str, Any],
    attributes: Mapping[str, AttributeValue],
) -> float:
    """Write image.exr, image.png and report.json, each whole; the report last, so it never tells of missing pictures.

    The report's seconds.write and seconds.total are raised by the time the two pictures took. Returns the seconds
    that all three took. `report` itself is not changed. Raises what `write_exr`, `write_png`, `write_report` raise.
    """
    directory, start = Path(directory), time.perf_counter()
    write_whole(directory / EXR, lambda path: write_exr(path, picture, attributes))
    write_whole(directory / PNG, lambda path: write_png(path, picture.rgb, bool(report.get("biased"))))
    spent = time.perf_counter() - start
    seconds = dict(report["seconds"])
    for stage in ("write", "total"):
        seconds[stage] += spent
    write_whole(directory / REPORT, lambda path: write_report(path, {**report, "seconds": seconds}))
    return time.perf_counter() - start


def _refuse_run(path: str | os.PathLike[str], force: bool, resume: bool) -> Path:
    directory = Path(path)
    mend = "choose another directory with --out"
    try:
        if directory.exists() and not directory.is_dir():
            raise InputError(f"it is a file, a directory is needed: {mend}", directory)
        if not directory.is_dir():
            return directory
        found = sorted(entry.name for pattern in (*RESULTS, *STATE) for entry in directory.glob(pattern))
        blocked = [name for name in found if name in RESULTS and (directory / name).is_dir()]
    except (OSError, ValueError) as error:
        raise InputError(f"cannot be used ({reason(error)}): {mend}", directory) from error
    if blocked:
        raise InputError(f"{blocked[0]} is a directory there: remove it, or {mend}", directory)
    if found and not (force or resume):
        raise InputError(
            f"it holds a run already ({', '.join(found[:3])}{', ...' if len(found) > 3 else ''}): "
            "replace it with --force, have a render go on with it by --resume, or choose another directory with --out",
            directory,
        )
    return directory


def _try_writing(directory: Path) -> list[Path]:
    """Create the directory and a file in it, remove the file. Returns the directories made, innermost first."""
    made: list[Path] = []
    try:
        missing = [parent for parent in (directory, *directory.parents) if not parent.exists()]
        for parent in reversed(missing):
            try:
                parent.mkdir()
            except FileExistsError:
                if not parent.is_dir():  # a dangling link, say; a directory someone else just made is fine
                    raise
                continue
            made.insert(0, parent)
        probe = directory / f".causticmpi-probe-{secrets.token_hex(4)}.tmp"
        try:
            os.close(os.open(probe, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
        finally:
            probe.unlink(missing_ok=True)
    except (OSError, ValueError) as error:
        for parent in made:
            with contextlib.suppress(OSError):
                parent.rmdir()
        raise InputError(
            f"cannot be written to ({reason(error)}): choose another directory with --out", directory
        ) from error
    return made


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
