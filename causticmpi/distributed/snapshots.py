"""Pictures of a growing run, at log-spaced numbers of passes: the points of a convergence curve."""

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from causticmpi.output.directory import write_whole
from causticmpi.render.film import resolve

STEP = math.sqrt(2)
"""Ratio of passes from one picture to the next: seven points a decade."""
KEPT = 12
"""Pictures kept, the latest ones: a decade and a half of passes."""


@dataclass
class Snapshots:
    """When to take a picture (`due`, on every rank) and the pictures (rank 0 only).

    When depends on the number of passes alone, never on what they cost, which would bend the pictures.
    pictures: (slots, 6) float32 each, L_d then L_c; passes; seconds: wall clock of the budget until then.
    """

    pictures: list[np.ndarray] = field(default_factory=list)
    passes: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    _next: float = 1.0

    def due(self, passes: int) -> bool:
        """Whether a picture of this many passes is wanted; each answer moves the mark on."""
        if passes < self._next:
            return False
        self._next = STEP * passes
        return True

    def take(self, sums: np.ndarray, passes: int, seconds: float) -> None:
        """Keep the picture of these sums (see render.film)."""
        diffusive, caustic, _ = resolve(sums, passes)
        self.pictures.append(np.concatenate([diffusive, caustic], axis=1).astype(np.float32))
        self.passes.append(passes)
        self.seconds.append(seconds)
        for kept in (self.pictures, self.passes, self.seconds):
            del kept[:-KEPT]

    def write(self, path: Path, height: int, width: int) -> None:
        """An .npz with `pictures` (k, height, width, 6) float32, `passes` and `seconds` (k,), whole or not at all."""
        stacked = np.array(self.pictures, np.float32).reshape(-1, height, width, 6)

        def save(temporary: Path) -> None:
            with temporary.open("wb") as file:
                np.savez(file, pictures=stacked, passes=np.array(self.passes), seconds=np.array(self.seconds))

        write_whole(path, save)
