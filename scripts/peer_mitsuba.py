#!/usr/bin/env python3
"""Path tracing of causticmpi beside Mitsuba 3 (`path`) in one run: paths per CPU second, one core.

    python scripts/peer_mitsuba.py configs/cornell.yaml [--rounds 5] [--tessellate LEVEL]

needs `pip install -e '.[peers]'` and an LLVM library (16 or later; DRJIT_LIBLLVM_PATH names one). Errors at equal
time, other methods and renderers: scripts/peers. Both render the same triangles, spheres, camera and lights;
--tessellate gives Mitsuba icospheres of that level instead of its own spheres. Rounds are interleaved; the ratio is
taken within each round.
"""

import argparse
import statistics
import time

import numpy as np

from causticmpi.bench.subjects import Subject
from causticmpi.peers.mitsuba import SAMPLES, choose_variant, mitsuba_scene


def main() -> None:
    """Run the rounds and print a line for each renderer and one for the ratio."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--tessellate", type=int, metavar="LEVEL")
    arguments = parser.parse_args()
    variant, note = choose_variant()
    import drjit as dr
    import mitsuba as mi

    mi.set_variant(variant)
    dr.set_thread_count(1)
    subject = Subject(arguments.config)
    film = subject.config.film
    scene = mitsuba_scene(mi, subject.scene.data, film.width, film.height, arguments.tessellate)
    np.array(mi.render(scene, spp=SAMPLES, seed=0))
    ours, theirs = [], []
    for i in range(arguments.rounds):
        subject.path_tracing()
        ours.append(subject.path_rates[-1])
        began = time.process_time()
        picture = np.array(mi.render(scene, spp=SAMPLES, seed=1 + i))
        seconds = time.process_time() - began
        theirs.append(film.width * film.height * SAMPLES / seconds / 1e6)
    mean = subject.film.reshape(-1, 2, 3).sum(axis=1).mean() / len(ours)
    ratios = [a / b for a, b in zip(ours, theirs, strict=True)]
    for name, values in (("causticmpi pt", ours), (f"mitsuba {mi.__version__} path, {note}", theirs)):
        print(
            f"{name:24} {statistics.median(values):.3f} Mpaths per CPU second ({min(values):.3f} - {max(values):.3f})"
        )
    print(f"{'ratio':24} {statistics.median(ratios):.2f} ({min(ratios):.2f} - {max(ratios):.2f})")
    print(f"{'mean radiance':24} ours {mean:.4f}, theirs {picture.mean():.4f}")


if __name__ == "__main__":
    main()
