"""Every collective, checked on every rank; prints "ok RANK" at the end. Argument: ranks per pretended node, or 0."""

import sys
import time
from functools import partial

import numpy as np
from reporting import say, say_shared_files

from causticmpi.distributed.failure import install_abort_hook
from causticmpi.distributed.mpi_world import MpiWorld
from causticmpi.distributed.shared_arrays import SharedArrays, share
from causticmpi.distributed.world import open_world


def reference() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(7)
    return {
        "vertices": rng.random((1001, 3)).astype(np.float32),
        "strided": rng.integers(0, 1000, (40, 60))[::2, ::3],
        "empty": np.zeros((0, 3), dtype=np.int32),
        "scalar": np.array(2.5),
        "flags": rng.random(13) < 0.5,
        "fortran": np.asfortranarray(rng.random((5, 7))),
    }


def check_share(world: MpiWorld, chunk_bytes: int) -> None:
    expected = reference()
    shared = share(world, expected if world.is_root else None, chunk_bytes)
    check_equal(shared, expected)
    addresses = [a.ctypes.data for a in shared.values()]
    ends = [a.ctypes.data + a.nbytes for a in shared.values()]
    assert all(address % 64 == 0 for address in addresses)
    assert all(following - end >= 64 for end, following in zip(ends, addresses[1:], strict=False))
    check_one_copy(world, shared)
    shared.free()
    assert not shared


def check_equal(shared: SharedArrays, expected: dict[str, np.ndarray]) -> None:
    assert list(shared) == list(expected)
    for name, array in expected.items():
        assert shared[name].dtype == array.dtype and shared[name].shape == array.shape, name
        assert np.array_equal(shared[name], array), name
        assert not shared[name].flags.writeable and shared[name].flags.c_contiguous, name


def check_one_copy(world: MpiWorld, shared: SharedArrays) -> None:
    """What a node's leader writes into the block, its own rank + 1, all ranks of that node see, and no other node."""
    assert shared.block is not None
    leader = world.rank - world.node_rank
    shared.block.publish()
    if world.is_node_leader:
        shared.block.bytes[:4] = np.frombuffer(np.float32(world.rank + 1).tobytes(), dtype=np.uint8)
    shared.block.publish()
    assert shared["vertices"][0, 0] == leader + 1, (shared["vertices"][0, 0], leader)
    world.barrier()


def check_sums(world: MpiWorld) -> None:
    ranks = world.size * (world.size + 1) // 2
    for dtype, shape in ((np.float64, (300, 1201, 3)), (np.int64, (5,)), (np.float64, (0,)), (np.int64, ())):
        array = np.full(shape, world.rank + 1, dtype=dtype)
        array.reshape(-1)[-1:] += 1
        total = world.reduce_sum(array)
        assert (total is not None) == world.is_root
        if total is not None:
            expected = np.full(shape, ranks, dtype=dtype)
            expected.reshape(-1)[-1:] += world.size
            assert total.shape == shape and total.dtype == dtype and np.array_equal(total, expected)
    try:
        world.reduce_sum(np.zeros(3, dtype=np.float32))
    except TypeError:
        return
    raise AssertionError("float32 was summed")


def check_small_exchanges(world: MpiWorld) -> None:
    last = world.size - 1
    assert world.broadcast({"from": world.rank} if world.rank == last else None, root=last) == {"from": last}
    assert world.broadcast([0] * 100_000 if world.is_root else None) == [0] * 100_000
    assert world.all_min(world.rank + 5) == 5 and world.all_max(-world.rank) == 0
    assert world.all_max(2**62 + world.rank) == 2**62 + last
    gathered = world.gather("x" * world.rank)
    assert gathered == (["x" * rank for rank in range(world.size)] if world.is_root else None)
    assert len(world.hosts()) == world.size
    world.agree(None)


def check_first_on_node(world: MpiWorld) -> None:
    def action() -> tuple[float, float]:
        start = time.monotonic()
        time.sleep(0.3 if world.is_node_leader else 0)
        return start, time.monotonic()

    spans = world.gather((world.rank - world.node_rank, world.node_rank, world.first_on_node(action)))
    for leader, node_rank, (start, _) in spans or []:
        assert spans is not None
        assert node_rank == 0 or start >= spans[leader][2][1], "ran before its node's leader had finished"


def check_parts_of_what_is_first_on_a_node(world: MpiWorld) -> None:
    """Ranks of a node share the parts out and end them all before its leader begins; a rank alone has no use for it."""
    done: list[tuple[int, float]] = []

    def part(number: int) -> None:
        time.sleep(0.1 * number)
        done.append((number, time.monotonic()))

    began = world.first_on_node(time.monotonic, [partial(part, number) for number in range(3)])
    node = world.node.gather((began, done))
    if node is not None:
        shares = [list(range(3))[rank :: world.node_size] if world.node_size > 1 else [] for rank in range(len(node))]
        assert [[number for number, _ in theirs] for _, theirs in node] == shares, node
        assert all(end <= node[0][0] for _, theirs in node for _, end in theirs), "began before the parts were done"


def check_handing_out(world: MpiWorld) -> None:
    """Every piece to one rank, whoever is slow; nothing is kept back for a leader who is asleep over its first one."""
    for count in (0, 1, 60 * world.size, 7):
        taken = []
        for piece in world.hand_out(count):
            taken.append(piece)
            if world.is_node_leader and world.node_size > 1 and count > 7:
                time.sleep(0.3)
        world.barrier()
        shares = world.gather(taken)
        if shares is not None:
            assert sorted(piece for share in shares for piece in share) == list(range(count)), count
            assert count <= 7 or world.node_size == 1 or len(shares[0]) < 30, [len(share) for share in shares]


def main() -> None:
    per_node = int(sys.argv[1])
    world = open_world(per_node or None)
    install_abort_hook(world)
    assert isinstance(world, MpiWorld)
    assert world.node_count == (-(-world.size // per_node) if per_node else 1)
    assert world.node_rank == world.rank % (per_node or world.size)
    check_small_exchanges(world)
    for chunk_bytes in (1 << 26, 1000):
        check_share(world, chunk_bytes)
    check_sums(world)
    check_first_on_node(world)
    check_parts_of_what_is_first_on_a_node(world)
    check_handing_out(world)
    kept = world.share(reference() if world.is_root else None)
    say_shared_files()
    say("ok", world.rank, kept["scalar"])


if __name__ == "__main__":
    main()
