"""Films that ranks hold together, against plain sums over ranks; prints "ok RANK". Arguments: ranks per pretended node,
or 0; "short" where shared memory is pretended to be too small."""

import sys

import numpy as np
from reporting import say, say_shared_files

from causticmpi.distributed import node_memory
from causticmpi.distributed.failure import install_abort_hook
from causticmpi.distributed.films import Films
from causticmpi.distributed.world import World, open_world
from causticmpi.errors import InputError
from causticmpi.render.film import BLOCK, Film

QUANTUM = 2.0**-36


def passes(rank: int, slots: int, rounds: int) -> np.ndarray:
    """What a rank traces, (rounds, slots, 6); the last round of odd ranks is empty."""
    values = np.random.default_rng([rank, slots]).random((rounds, slots, 6)).astype(np.float32)
    values[-1] *= rank % 2 == 0
    return values


def check_films(world: World, slots: int) -> None:
    """Rounds of which each rank traces a pass and the light paths of another, the second and third in the second half.

    All ranks add to the same rows at once.
    """
    rounds = 3
    films = Films(world, slots, QUANTUM, light=True, halves=True)
    for number, one in enumerate(passes(world.rank, slots, rounds)):
        light = one[:, :3].copy()
        films.pending.rays += 1
        films.pending.add_pass(one)
        films.pending.add_light(light)
        world.barrier()
        films.merge(world.size, second=number > 0)
        world.barrier()
    whole, second = films.total(), films.total_of_second()
    assert (films.merged.passes, films.merged.rays) == (rounds * world.size, rounds)
    if not world.is_root:
        assert whole is None and second is None
    else:
        wanted = Film(slots, QUANTUM, light=True), Film(slots, QUANTUM, light=True)
        for rank in range(world.size):
            for number, one in enumerate(passes(rank, slots, rounds)):
                for film in wanted[: 2 if number else 1]:
                    film.add_pass(one.copy())
                    film.add_light(one[:, :3].copy())
        assert whole is not None and np.array_equal(whole, wanted[0].sums)
        assert second is not None and np.array_equal(second, wanted[1].sums)
    world.barrier()
    assert not films.pending.sums.any() and not films.pending.touched.any()
    world.barrier()
    say_shared_files()
    world.release()


def main() -> None:
    per_node, short = int(sys.argv[1]), "short" in sys.argv[2:]
    if short:
        node_memory.shortage = lambda *_: InputError("node 7: no room") if world.rank == 0 else None
    with open_world(per_node or None) as world:
        install_abort_hook(world)
        for slots in (1, BLOCK - 1, 5 * BLOCK + 7):  # fewer blocks than ranks, too
            check_films(world, slots)
        say("ok", world.rank)


if __name__ == "__main__":
    main()
