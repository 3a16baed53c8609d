"""The MPI world. Importing this module loads and initializes MPI; `world.open_world` does so under a launcher only.

Every MPI burns its core in a blocking wait, so that 19 waiting ranks slow down the one that works. Hence only
non-blocking calls are made here, polled with a sleep; the few blocking ones (splitting, freeing) follow a polled
barrier, when all ranks are known to be there. Sleeping also lets Python's signal handlers run.
"""

import atexit
import os
import pickle
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NoReturn, TypeVar, cast

import numpy as np

# Open MPI's UCX component complains on every rank where it finds no fast network; windows are only shared here.
os.environ.setdefault("OMPI_MCA_osc", "^ucx")

from mpi4py import MPI  # noqa: E402

from causticmpi.distributed.watchdog import TRACING, WRITING, Watchdog, given_up_in_time  # noqa: E402
from causticmpi.distributed.world import AgreedInputError, Arrays, Common, Shapes, World, require_summable  # noqa: E402
from causticmpi.errors import InputError  # noqa: E402

T = TypeVar("T")

SHORTEST_SLEEP = 50e-6
LONGEST_SLEEP = 2e-3
BULK_SLEEP = 100e-6
BULK_POLLS = 2000

REDUCE_CHUNK = 1 << 20
"""Elements per reduction: bounds the library's temporary memory and keeps counts far from 2^31."""

PICKLE_CHUNK = 1 << 28
FAILURE_TAG = 1
FAILURE_PATIENCE = 0.3
FAILURE_PROBES = 20
ENDED_WITHIN = 5.0
"""Seconds a launcher may take to end a rank."""


while_waiting: list[Callable[[], None]] = []
"""What a rank does now and then as long as it waits for others."""


def wait(request: MPI.Request, longest: float = LONGEST_SLEEP) -> None:
    """Wait for a request asleep: polls after 50 us at first, then ever less often, at least every `longest` s."""
    pause = SHORTEST_SLEEP
    while not request.Test():
        time.sleep(pause)
        for action in while_waiting:
            action()
        pause = min(1.5 * pause, longest)


def wait_bulk(request: MPI.Request) -> None:
    """Wait for a transfer whose partners are all there (after a barrier): every poll moves a piece of the data.

    Polls yielding the core at first, then asleep for at most 100 us: longer sleeps would throttle the transfer.
    """
    for _ in range(BULK_POLLS):
        if request.Test():
            return
        os.sched_yield()
    wait(request, BULK_SLEEP)


def broadcast_bytes(comm: MPI.Intracomm, data: bytes | None, root: int) -> bytes:
    """Collective on `comm`. The root's bytes: length first, then chunks."""
    length = np.array([len(data) if data is not None else 0], dtype=np.int64)
    wait(comm.Ibcast(length, root))
    block = np.empty(int(length[0]), dtype=np.uint8)
    if data is not None:
        block[:] = np.frombuffer(data, dtype=np.uint8)
    for start in range(0, len(block), PICKLE_CHUNK):
        wait(comm.Ibcast(block[start : start + PICKLE_CHUNK], root))
    return block.tobytes()


def sum_over(comm: MPI.Intracomm, array: np.ndarray) -> np.ndarray | None:
    """Collective on `comm`. On its rank 0 a new array, the sum over ranks; None elsewhere."""
    source = np.ascontiguousarray(array).reshape(-1)
    total = np.empty_like(source) if comm.rank == 0 else None
    wait(comm.Ibarrier())
    for start in range(0, len(source), REDUCE_CHUNK):
        part = slice(start, start + REDUCE_CHUNK)
        wait_bulk(comm.Ireduce(source[part], None if total is None else total[part], MPI.SUM, 0))
    return None if total is None else total.reshape(array.shape)


class MpiWorld(World):
    """All processes of MPI_COMM_WORLD; the contract is World's.

    comm     all ranks
    node     the ranks that share memory with this one
    leaders  the lowest rank of each node, rank 0 first; MPI.COMM_NULL on other ranks
    leader, leader_of  the leader of this rank's node, and of every rank's, by rank among all
    """

    def __init__(self, ranks_per_node: int | None = None) -> None:
        self.comm = MPI.COMM_WORLD
        self.rank, self.size = self.comm.rank, self.comm.size
        self.library = MPI.Get_library_version().splitlines()[0].split(", package")[0].strip()
        self.barrier()
        node = self.comm.Split_type(MPI.COMM_TYPE_SHARED, key=self.rank)
        if ranks_per_node is not None:
            node = node.Split(node.rank // ranks_per_node, node.rank)
        self.node = cast(MPI.Intracomm, node)
        self.node_rank, self.node_size = self.node.rank, self.node.size
        leaders = self.comm.Split(0 if self.is_node_leader else MPI.UNDEFINED, self.rank)
        self.leaders = cast(MPI.Intracomm, leaders)
        self.leader = int(self.node.Get_group().Translate_ranks([0], self.comm.Get_group())[0])
        everyone: list[tuple[str, int]] = self.broadcast(self.gather((MPI.Get_processor_name(), self.leader)))
        self._hosts = [host for host, _ in everyone]
        self.leader_of = np.array([leader for _, leader in everyone])
        self.node_count = len(set(self.leader_of.tolist()))
        self._closed = False
        self._watchdog: Watchdog | None = None
        self._shared: list[Any] = []
        self._handing_out: Any = None
        # Runs before mpi4py finalizes MPI: windows have to be freed by then, and a late rank is awaited asleep.
        atexit.register(self.close)

    def hosts(self) -> list[str]:
        return list(self._hosts)

    def broadcast(self, obj: Any, root: int = 0) -> Any:
        data = broadcast_bytes(self.comm, pickle.dumps(obj) if self.rank == root else None, root)
        return obj if self.rank == root else pickle.loads(data)

    def gather(self, obj: Any) -> list[Any] | None:
        data = np.frombuffer(pickle.dumps(obj), dtype=np.uint8)
        lengths = np.empty(self.size, dtype=np.int64) if self.is_root else None
        wait(self.comm.Igather(np.array([len(data)], dtype=np.int64), lengths, 0))
        if lengths is None:
            wait(self.comm.Igatherv(data, None, 0))
            return None
        ends = np.cumsum(lengths)
        block = np.empty(int(ends[-1]), dtype=np.uint8)
        wait(self.comm.Igatherv(data, [block, lengths.tolist(), (ends - lengths).tolist(), MPI.BYTE], 0))
        return [pickle.loads(part.tobytes()) for part in np.split(block, ends[:-1])]

    def share(self, arrays: Arrays | None) -> Arrays:
        from causticmpi.distributed.shared_arrays import share

        shared = share(self, arrays)
        self._shared.append(shared)
        return shared

    def hold_in_common(self, shapes: Shapes) -> Common:
        from causticmpi.distributed.node_memory import hold_in_common

        common = hold_in_common(self, shapes)
        self._shared.append(common)
        return common

    def reduce_sum(self, array: np.ndarray) -> np.ndarray | None:
        require_summable(array)
        return sum_over(self.comm, array)

    def all_min(self, value: int) -> int:
        return self._all(value, MPI.MIN)

    def all_max(self, value: int) -> int:
        return self._all(value, MPI.MAX)

    def _all(self, value: int, operation: MPI.Op) -> int:
        result = np.empty(1, dtype=np.int64)
        wait(self.comm.Iallreduce(np.array([value], dtype=np.int64), result, operation))
        return int(result[0])

    def hand_out(self, count: int) -> Iterator[int]:
        from causticmpi.distributed.handing_out import HandingOut

        if self._handing_out is None:
            with given_up_in_time(f"rank {self.rank} of {self.size} on {self._hosts[self.rank]}"):
                self._handing_out = HandingOut(self)
        return self._handing_out.begin(count)

    def barrier(self) -> None:
        wait(self.comm.Ibarrier())

    def watch(self, on: bool) -> None:
        if on:
            self._watchdog = Watchdog(self.comm, self._hosts)
            while_waiting.append(self.pulse)
            return
        self.barrier()  # in the ring still: a rank can stop after its last batch too
        while_waiting.remove(self.pulse)
        with given_up_in_time(f"rank {self.rank} of {self.size} on {self._hosts[self.rank]}"):
            self.barrier()  # nobody speaks any more
        assert self._watchdog is not None
        self._watchdog.drain()
        self._watchdog = None

    def pulse(self, writing: bool | None = None) -> None:
        word = None if writing is None else WRITING if writing else TRACING
        if self._watchdog is not None and not self._watchdog.pulse(word):
            time.sleep(0.1)  # the launcher passes stderr on
            self.abort(1)

    def agree(self, error: InputError | None) -> None:
        lowest = self.all_min(self.size if error is None else self.rank)
        if lowest < self.size:
            raise AgreedInputError(self.broadcast(str(error), root=lowest)) from error

    def first_on_node(self, action: Callable[[], T], parts: Sequence[Callable[[], object]] = ()) -> T:
        if self.node_size > 1:
            for part in parts[self.node_rank :: self.node_size]:
                part()
        wait(self.node.Ibarrier())
        result: list[T] = []
        refusal: InputError | None = None
        if self.is_node_leader:
            try:
                result.append(action())
            except InputError as error:
                refusal = error
        # A leader that fails never comes here. It ends the others, who wait asleep: told of it, one of them could be
        # the first to print, and the reason would be lost.
        self.agree(refusal)
        return result[0] if result else action()

    def is_first_failure(self) -> bool:
        """True if this failing rank is the one to print: a defect often shows on all ranks at once.

        Failing ranks tell all others and wait a moment: who hears of an earlier failure, or of a lower rank, is silent.
        """
        for _ in range(FAILURE_PROBES):  # a message that has come may take several calls to show
            if self.comm.Iprobe(MPI.ANY_SOURCE, FAILURE_TAG):
                return False
            time.sleep(0.001)
        for other in range(self.size):
            if other != self.rank:
                self.comm.Isend(np.empty(0, dtype=np.uint8), other, FAILURE_TAG)
        end = time.monotonic() + FAILURE_PATIENCE
        while time.monotonic() < end:
            for lower in range(self.rank):
                if self.comm.Iprobe(lower, FAILURE_TAG):
                    return False
            time.sleep(0.02)
        return True

    def abort(self, code: int) -> NoReturn:
        sys.stdout.flush()
        sys.stderr.flush()
        self.comm.Abort(code)
        # MPICH comes back once its launcher is told to end all ranks. Until then this one sends nothing: others could
        # take it for what they wait for, and go on with sums that lack its share.
        time.sleep(ENDED_WITHIN)
        os._exit(code)

    def release(self) -> None:
        for shared in self._shared:
            shared.free()
        self._shared.clear()

    def close(self) -> None:
        if self._closed or MPI.Is_finalized():
            return
        self._closed = True
        self.release()
        if self._handing_out is not None:
            self._handing_out.free()
        self.barrier()
        # Never used again, and an unfreed communicator is reported as a leak by some libraries.
        if self.leaders != MPI.COMM_NULL:
            self.leaders.Free()
        self.node.Free()
