"""The processes of one run: `open_world()` gives the MPI world, or a serial stand-in that never loads MPI.

Every method marked "collective" is to be called by all ranks in the same order. Errors of single ranks that others
have to know are exchanged with `agree`; anything else that escapes on one rank ends all ranks (see failure.py).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import TracebackType
from typing import Any, NoReturn, Self, TypeVar

import numpy as np

from causticmpi.distributed.environment import announced_size, started_by_launcher
from causticmpi.errors import InputError

T = TypeVar("T")
Arrays = dict[str, np.ndarray]
Shapes = Mapping[str, tuple[type, tuple[int, ...]]]
"""name -> (dtype, shape)."""


class AgreedInputError(InputError):
    """Bad input that every rank knows of: all leave with code 2, the root alone prints the message."""


class Common:
    """Writable arrays, zeros at first, that `size` ranks hold together, this one being number `rank` of them.

    What one writes the others see once all have called `sync`, met (`World.barrier`, `all_max`) and called it again.
    Here: one rank's own, in a world of one.
    """

    rank: int = 0
    size: int = 1

    def __init__(self, shapes: Shapes) -> None:
        self.arrays: Arrays = {name: np.zeros(shape, kind) for name, (kind, shape) in shapes.items()}

    def sync(self) -> None:
        """Local; see above."""

    def total(self, name: str) -> np.ndarray | None:
        """Collective, after a meeting. On the root the sum of this array over all who hold one, None elsewhere; it may
        be the array itself, which nobody may write before the next meeting."""
        return self.arrays[name]

    def free(self) -> None:
        """Collective. The memory is gone afterwards."""
        self.arrays.clear()


class World(ABC):
    """Ranks and what they exchange. A node is the set of ranks that share memory.

    rank, size            this process and the number of processes
    node_rank, node_size  the same within the node
    node_count            number of nodes
    library               the MPI library's version line, "serial" without one
    """

    rank: int = 0
    size: int = 1
    node_rank: int = 0
    node_size: int = 1
    node_count: int = 1
    library: str = "serial"

    @property
    def is_root(self) -> bool:
        """True on rank 0, which reads, prints and writes."""
        return self.rank == 0

    @property
    def is_node_leader(self) -> bool:
        """True on the lowest rank of each node."""
        return self.node_rank == 0

    @abstractmethod
    def hosts(self) -> list[str]:
        """Host name of every rank, in rank order. Local: known since the start."""

    @abstractmethod
    def broadcast(self, obj: Any, root: int = 0) -> Any:
        """Collective. The root's object on every rank, pickled: for small metadata; arrays go through `share`."""

    @abstractmethod
    def gather(self, obj: Any) -> list[Any] | None:
        """Collective. On the root the objects of all ranks in rank order, None elsewhere. Small objects only."""

    @abstractmethod
    def share(self, arrays: Arrays | None) -> Arrays:
        """Collective. Rank 0's arrays on every rank, read-only, C order, held once per node; see shared_arrays.py."""

    @abstractmethod
    def hold_in_common(self, shapes: Shapes) -> Common:
        """Collective. Arrays that the ranks of a node write together; see node_memory.py."""

    @abstractmethod
    def reduce_sum(self, array: np.ndarray) -> np.ndarray | None:
        """Collective. On the root a new array, the sum over ranks; None elsewhere.

        array : float64 or int64, of one shape on all ranks. Raises TypeError for another dtype.
        """

    @abstractmethod
    def all_min(self, value: int) -> int:
        """Collective. The least value of any rank (64-bit integers)."""

    @abstractmethod
    def all_max(self, value: int) -> int:
        """Collective. The largest value of any rank (64-bit integers); agrees on stopping: `all_max(flag.raised)`."""

    @abstractmethod
    def hand_out(self, count: int) -> Iterator[int]:
        """Collective. Each of 0 … count-1 to one rank, the next one whenever a rank asks for it; see handing_out.py.

        Between the last piece and the next handing out all ranks have to meet, in `barrier`, `all_min` or `all_max`.
        """

    @abstractmethod
    def barrier(self) -> None:
        """Collective. Returns once all ranks have come here; waits asleep."""

    def watch(self, on: bool) -> None:  # noqa: B027  (one process has no one to watch)
        """Collective. From now on, or no longer, ranks that fall silent are told of and in the end given up: see
        watchdog.py. While it is on every rank calls `pulse` often, or waits for others."""

    def pulse(self, writing: bool | None = None) -> None:  # noqa: B027
        """This rank is alive. writing: from now on (or no longer) it may be silent for as long as a disk takes."""

    @abstractmethod
    def agree(self, error: InputError | None) -> None:
        """Collective. Raises AgreedInputError on all ranks, with the lowest failing rank's message, if any has one."""

    @abstractmethod
    def first_on_node(self, action: Callable[[], T], parts: Sequence[Callable[[], object]] = ()) -> T:
        """Collective. Run `action` on the node's leader while the others sleep, then on the others; return its result.

        For what is worth doing once per node, such as filling a compile cache. parts: what of it can be done at the
        same time and leaves nothing to do again; ranks that share a node take turns at them first. An InputError of
        `action` on a leader is raised on all ranks as AgreedInputError; any other error, and any of a part, is raised
        where it happened, on a rank that is to end the others.
        """

    @abstractmethod
    def abort(self, code: int) -> NoReturn:
        """End all ranks now, without waiting for them; the launcher returns `code` where it can."""

    @abstractmethod
    def release(self) -> None:
        """Collective. Give back the memory of `share` and `hold_in_common` so far: no rank may use it afterwards."""

    @abstractmethod
    def close(self) -> None:
        """Collective. Free what is shared (arrays of `share` die here); harmless when repeated."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        # Closing waits for all ranks: only where all of them are known to leave.
        if error is None or isinstance(error, AgreedInputError):
            self.close()


class SerialWorld(World):
    """One process, no MPI. Every exchange is the identity."""

    def hosts(self) -> list[str]:
        import socket

        return [socket.gethostname()]

    def broadcast(self, obj: Any, root: int = 0) -> Any:
        return obj

    def gather(self, obj: Any) -> list[Any] | None:
        return [obj]

    def share(self, arrays: Arrays | None) -> Arrays:
        if arrays is None:
            raise ValueError("share: rank 0 has to give the arrays")
        # Same layout and read-only flag as under MPI, so that compiled kernels are compiled for one type only.
        return {name: read_only(np.ascontiguousarray(a).reshape(a.shape)) for name, a in arrays.items()}

    def hold_in_common(self, shapes: Shapes) -> Common:
        return Common(shapes)

    def reduce_sum(self, array: np.ndarray) -> np.ndarray | None:
        require_summable(array)
        return array.copy()

    def all_min(self, value: int) -> int:
        return value

    def all_max(self, value: int) -> int:
        return value

    def hand_out(self, count: int) -> Iterator[int]:
        return iter(range(count))

    def barrier(self) -> None:
        return

    def agree(self, error: InputError | None) -> None:
        if error is not None:
            raise AgreedInputError(str(error)) from error

    def first_on_node(self, action: Callable[[], T], parts: Sequence[Callable[[], object]] = ()) -> T:
        return action()

    def abort(self, code: int) -> NoReturn:
        raise SystemExit(code)

    def release(self) -> None:
        return

    def close(self) -> None:
        return


def read_only(array: np.ndarray) -> np.ndarray:
    """A view that cannot be written through; the array itself stays as it is."""
    view = array.view()
    view.flags.writeable = False
    return view


def require_summable(array: np.ndarray) -> None:
    """Raises TypeError unless float64 or int64: sums of many ranks and passes need the digits."""
    if array.dtype not in (np.float64, np.int64):
        raise TypeError(f"reduce_sum: found {array.dtype}, need float64 or int64")


def open_world(ranks_per_node: int | None = None) -> World:
    """The world this process was started in: serial unless a launcher started more than one process.

    ranks_per_node : splits real nodes further (for tests of transfers between nodes); None takes nodes as they are.
    Raises InputError without a usable MPI under a launcher, and when launcher and MPI library do not fit: each process
    would be a world of its own then, all writing the same output.
    """
    announced, variable = announced_size()
    size_known = bool(variable)
    if not started_by_launcher() or (size_known and announced == 1):
        return SerialWorld()
    try:
        from causticmpi.distributed.mpi_world import MpiWorld
    except (ImportError, RuntimeError) as error:  # no mpi4py, or mpi4py without a libmpi
        raise InputError(
            f"a launcher started {announced if size_known else 'several'} processes ({variable or 'PMIX_RANK'}), but "
            f"MPI cannot be loaded ({str(error).splitlines()[0]}): pip install '.[mpi]' in the clone, or on a cluster "
            "pip install mpi4py and set MPI4PY_LIBMPI to the site's libmpi.so.12"
        ) from error
    world = MpiWorld(ranks_per_node)
    if world.size == 1 and announced > 1:
        world.close()
        raise InputError(
            f"found an MPI world of 1 process, but the launcher started {announced} ({variable}): launcher and MPI "
            f"library ({world.library}) do not fit; use the mpirun that belongs to the library, with srun add "
            "--mpi=pmi2 (MPICH family) or --mpi=pmix (Open MPI), or let -j start the ranks"
        )
    return world
