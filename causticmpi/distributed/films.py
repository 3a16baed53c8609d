"""The films of a run, which the ranks of a node hold together: one of the merged rounds, one of the round being traced.

All ranks of a node add to the same film of the round. Once it is whole, each of them merges its part of the rows: what
a round costs is that of one film a node, however many ranks there are, and sums are reduced between nodes alone.
"""

import time
from collections.abc import Mapping

import numpy as np

from causticmpi.distributed.world import World
from causticmpi.render.film import Film, film_arrays


class Films:
    """merged: sums of the merged rounds; pending: of the round being traced; second: of the second half of the merged
    passes, for `budget.until` (without pixels otherwise). Their counts (`rays`, `nonfinite`) are of this rank alone."""

    def __init__(self, world: World, slots: int, quantum: float, light: bool, halves: bool = False) -> None:
        """Collective. slots: pixels; quantum, light: see Film; halves: whether `second` is wanted."""
        sizes = {"merged": slots, "pending": slots, "second": slots if halves else 0}
        shapes = {
            f"{name} {array}": shape
            for name, count in sizes.items()
            for array, shape in film_arrays(count, light).items()
        }
        self._common = world.hold_in_common(shapes)

        def idle() -> None:
            time.sleep(50e-6)
            world.pulse()

        def film(name: str) -> Film:
            arrays = {array: self._common.arrays[f"{name} {array}"] for array in ("sums", "touched", "locks")}
            part = (self._common.rank, self._common.size)
            return Film(sizes[name], quantum, light, shared=arrays, part=part, idle=idle)

        self.merged, self.pending, self.second = film("merged"), film("pending"), film("second")

    def merge(self, passes: int, second: bool) -> None:
        """Merge the round, once all ranks have met at its end; nobody may trace before they have met again.

        passes: of the round; second: whether they are of the second half.
        """
        self._common.sync()
        if second:
            self.second.merge(self.pending)
        self.merged.merge(self.pending)
        self.merged.passes += passes
        self.pending.clear()
        self._common.sync()

    def take_up(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Begin with the sums in a checkpoint; on one rank alone, before the first round ends."""
        self.merged.sums[:] = arrays["sums"]
        self.merged.touched[:] = True
        if self.second.slots > 0:
            self.second.sums[:] = arrays["second"]
            self.second.touched[:] = True

    def total(self) -> np.ndarray | None:
        """Collective, after a meeting. The merged sums of all ranks on the root, None elsewhere; not to be written, and
        as they are until the ranks meet again."""
        self._common.sync()
        return self._common.total("merged sums")

    def total_of_second(self) -> np.ndarray | None:
        """As `total`, of the second half."""
        self._common.sync()
        return self._common.total("second sums")
