#!/usr/bin/env -S sh -c '"${0%/*}"/setup_venv mpi,peers && exec "${0%/*}"/../.venv/bin/python "$0" "$@"'
"""Path tracing of causticmpi beside Mitsuba 3 (`path`) in one run: paths per CPU second and error at equal time.

    scripts/peer_mitsuba.py configs/cornell.yaml [--rounds 5] [--tessellate LEVEL]

needs an LLVM library (16 or later; DRJIT_LIBLLVM_PATH names one). Errors at equal time, other methods and renderers:
scripts/peers. Both render the same triangles, spheres, camera and lights;
--tessellate gives Mitsuba icospheres of that level instead of its own spheres. Rounds are interleaved, one core.
The error is relMSE x CPU seconds = seconds of a render * mean(variance between renders / (mean^2 + 0.01)): what is left
of it after t seconds is that number over t. The mean is that of squares of 16 pixels in both renderers' pictures, since
a pixel's own mean would hide its fireflies. `trimmed` leaves out the 0.1 % worst pixels, where luck decides.
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
    subject.picture(0)
    np.array(mi.render(scene, spp=SAMPLES, seed=0))
    ours, theirs = Renders("causticmpi pt", 1), Renders(f"mitsuba {mi.__version__} path, {note}", SAMPLES)
    for i in range(arguments.rounds):
        for j in range(SAMPLES):
            ours.add(*subject.picture(1 + SAMPLES * i + j))
        began = time.process_time()
        picture = np.array(mi.render(scene, spp=SAMPLES, seed=1 + i))
        theirs.add(picture.astype(np.float64).reshape(-1, 3), time.process_time() - began)
    mean = smooth((ours.sum / ours.count + theirs.sum / theirs.count) / 2, film.width, film.height)
    for renders in (ours, theirs):
        whole, trimmed = renders.errors(mean)
        print(
            f"{renders.name:24} {renders.paths_per_second() / 1e6:.3f} Mpaths per CPU second; relMSE x seconds "
            f"{whole:.3f}, trimmed {trimmed:.3f}; mean radiance {renders.sum.mean() / renders.count:.4f}"
        )
    rates = ours.paths_per_second() / theirs.paths_per_second()
    factors = [b / a for a, b in zip(ours.errors(mean), theirs.errors(mean), strict=True)]
    print(f"{'ratio':24} paths {rates:.2f}; error {factors[0]:.2f} times less, trimmed {factors[1]:.2f}")


def smooth(picture: np.ndarray, width: int, height: int, side: int = 16) -> np.ndarray:
    """Each pixel of a (height * width, 3) picture as the mean of its square."""
    number = np.arange(height)[:, None] // side * width + np.arange(width) // side
    _, square = np.unique(number.ravel(), return_inverse=True)
    sums = np.stack([np.bincount(square, picture[:, c]) for c in range(3)], axis=1)
    return (sums / np.bincount(square)[:, None])[square]


class Renders:
    """Independent renders of one picture: sums, squares and CPU seconds."""

    def __init__(self, name: str, samples: int) -> None:
        self.name, self.samples = name, samples
        self.sum = self.squares = np.zeros(())
        self.seconds: list[float] = []

    @property
    def count(self) -> int:
        return len(self.seconds)

    def add(self, picture: np.ndarray, seconds: float) -> None:
        self.sum, self.squares = self.sum + picture, self.squares + picture * picture
        self.seconds.append(seconds)

    def paths_per_second(self) -> float:
        return len(self.sum) * self.samples / statistics.median(self.seconds)

    def errors(self, mean: np.ndarray) -> tuple[float, float]:
        """relMSE x CPU seconds, of all pixels and without the 0.1 % worst."""
        variance = (self.squares - self.sum * self.sum / self.count) / (self.count - 1)
        pixels = np.sort((variance / (mean * mean + 0.01)).mean(axis=1)) * statistics.median(self.seconds)
        return float(pixels.mean()), float(pixels[: int(0.999 * len(pixels))].mean())


if __name__ == "__main__":
    main()
