"""Checkpoint files: plain facts and arrays under one checksum, written whole or not at all, the previous one kept.

    magic line | length of the facts, 8 bytes little-endian | facts, JSON | arrays, C order | sha256 of all that

The checksum is looked at before anything else is believed. The facts name each array's type and shape.
"""

import contextlib
import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from causticmpi.errors import reason
from causticmpi.output.directory import write_whole

CHECKPOINT, PREVIOUS = "checkpoint", "checkpoint.previous"
MAGIC = b"causticmpi checkpoint\n"
LENGTH = 8
DIGEST = hashlib.sha256().digest_size


class DamagedError(Exception):
    """A checkpoint that cannot be used; the text says which file and why."""


@dataclass(frozen=True)
class Checkpoint:
    """What was written: `facts` as JSON has them, arrays by name."""

    facts: dict[str, Any]
    arrays: dict[str, np.ndarray]


def save_checkpoint(directory: Path, checkpoint: Checkpoint, keep_previous: bool) -> None:
    """Write DIR/checkpoint; keep_previous: the one that is there becomes DIR/checkpoint.previous.

    At any moment one of the two is whole. Raises OSError.
    """

    def write(temporary: Path) -> None:
        _write(temporary, checkpoint)
        if keep_previous:
            with contextlib.suppress(FileNotFoundError):
                os.replace(directory / CHECKPOINT, directory / PREVIOUS)

    write_whole(directory / CHECKPOINT, write)


def find_checkpoint(directory: Path) -> tuple[Checkpoint | None, list[str]]:
    """The newest whole checkpoint of the directory, None where there is none; and a line for each damaged one."""
    notes: list[str] = []
    for name in (CHECKPOINT, PREVIOUS):
        try:
            return read_checkpoint(directory / name), notes
        except FileNotFoundError:
            continue
        except DamagedError as error:
            notes.append(str(error))
    return None, notes


def read_checkpoint(path: Path) -> Checkpoint:
    """Read one file. Raises FileNotFoundError, or DamagedError for one that is truncated, altered or unreadable."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise
    except OSError as error:
        raise DamagedError(f"{path}: cannot be read ({reason(error)})") from None
    body = memoryview(content)[:-DIGEST]
    if len(content) < len(MAGIC) + LENGTH + DIGEST or hashlib.sha256(body).digest() != content[-DIGEST:]:
        raise DamagedError(f"{path}: truncated or altered, its checksum does not fit")
    at = len(MAGIC) + LENGTH
    end = at + int.from_bytes(body[len(MAGIC) : at], "little")
    facts = json.loads(bytes(body[at:end]))
    arrays = {}
    for name, (kind, shape) in facts.pop("arrays").items():
        dtype = np.dtype(kind)
        size = int(np.prod(shape, dtype=np.int64))
        arrays[name] = np.frombuffer(body, dtype, size, end).reshape(shape)
        end += size * dtype.itemsize
    return Checkpoint(facts, arrays)


def _write(path: Path, checkpoint: Checkpoint) -> None:
    arrays = {name: np.ascontiguousarray(array) for name, array in checkpoint.arrays.items()}
    kinds = {name: [array.dtype.newbyteorder("<").str, list(array.shape)] for name, array in arrays.items()}
    facts = json.dumps({**checkpoint.facts, "arrays": kinds}).encode()
    digest = hashlib.sha256()
    with path.open("wb") as file:
        for part in (MAGIC, len(facts).to_bytes(LENGTH, "little"), facts, *map(_bytes, arrays.values())):
            digest.update(part)
            file.write(part)
        file.write(digest.digest())
        file.flush()
        os.fsync(file.fileno())  # on disk before the one that is there is put aside


def _bytes(array: np.ndarray) -> Any:
    """The array's bytes, little-endian, not copied: any buffer does for a file and a hash."""
    return array.astype(array.dtype.newbyteorder("<"), copy=False).reshape(-1).view(np.uint8)
