"""Absolute radiance by another renderer: `python tests/third_party.py [--samples N] [--write]`, extra `peers`.

Mitsuba's path tracer renders the triangles, spheres, camera and light of `cornell` and `ring`, without a limit of
depth; its block means, in independent batches, are kept in third_party.json. The program renders them anew and says how
far they are from the kept ones, or with --write keeps the new ones instead. tests/test_third_party_radiance.py holds
our methods against them; with --ours this program does so with as many samples as you like.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from rendering import REPOSITORY, make_config, prepare
from scipy import stats

from causticmpi.config.records import RenderConfig
from causticmpi.distributed.clock import Stopwatch
from causticmpi.distributed.prepare import prepare_forecast
from causticmpi.distributed.world import SerialWorld
from causticmpi.kernels.pixels import pixel_order
from causticmpi.render.methods import make_method
from causticmpi.scene.data import SceneData
from causticmpi.scene.load import load_scene
from causticmpi.scene.tracing import camera_array

KEPT = Path(__file__).with_name("third_party.json")
SIZE, BLOCKS, BATCHES = 32, 2, 16
"""Pixels of the picture's edge, blocks along it, independent batches of a render."""
BRIGHTEST = {"cornell": 0.8, "ring": float("inf")}
"""Brighter pixels see the light, straight or mirrored, and are left out: whether a sample meets its edge or not is
noise that would hide half a percent."""


def scene_of(name: str) -> SceneData:
    """`cornell` or `ring`, as everyone renders it."""
    return load_scene(REPOSITORY / "scenes" / f"{name}.yaml")


def block_means(batches: np.ndarray, left_out: list[int]) -> np.ndarray:
    """(BATCHES, BLOCKS^2, 3) means of the blocks of pictures (BATCHES, SIZE, SIZE, 3), some pixels left out."""
    kept = np.ones(SIZE * SIZE)
    kept[left_out] = 0
    edge = SIZE // BLOCKS
    shape = (BLOCKS, edge, BLOCKS, edge)
    counts = kept.reshape(shape).sum(axis=(1, 3))
    sums = (batches * kept.reshape(SIZE, SIZE, 1)).reshape(len(batches), *shape, 3).sum(axis=(2, 4))
    return (sums / counts[..., None]).reshape(len(batches), BLOCKS * BLOCKS, 3)


def render_theirs(name: str, samples: int, seed: int) -> tuple[np.ndarray, str]:
    """Mitsuba's pictures (BATCHES, SIZE, SIZE, 3) of `samples` per pixel in all, and its name and version."""
    from causticmpi.peers.mitsuba import choose_variant, mitsuba_scene

    variant, _ = choose_variant()
    import mitsuba

    mi: Any = mitsuba
    mi.set_variant(variant)
    scene = mitsuba_scene(mi, scene_of(name), SIZE, SIZE, None)
    integrator = mi.load_dict({"type": "path", "max_depth": -1, "rr_depth": 5})
    pictures = [
        np.array(mi.render(scene, integrator=integrator, spp=samples // BATCHES, seed=BATCHES * seed + i), np.float64)
        for i in range(BATCHES)
    ]
    return np.stack(pictures), f"Mitsuba {mi.__version__}, {variant}, path"


def render_ours(name: str, config: RenderConfig, passes: int) -> np.ndarray:
    """Our pictures (BATCHES, SIZE, SIZE, 3) of `passes` in all."""
    scene = prepare(scene_of(name))
    maps = prepare_forecast(SerialWorld(), config, scene, Stopwatch()).maps
    method = make_method(config, scene.traced, camera_array(scene.data.camera, SIZE, SIZE), maps, scene.extent)
    pixels = pixel_order((0, 0, SIZE, SIZE), SIZE)
    batches = np.zeros((BATCHES, SIZE * SIZE, 3))
    for batch, index in np.ndindex(BATCHES, passes // BATCHES):
        film = np.zeros((SIZE * SIZE, 6), np.float32)
        method.begin_pass(batch * (passes // BATCHES) + index)
        method.trace(pixels, film)
        batches[batch] += film[:, :3].astype(np.float64) + film[:, 3:]
    return batches.reshape(BATCHES, SIZE, SIZE, 3) / (passes // BATCHES)


def configured(method: str) -> RenderConfig:
    """As many virtual lights a pass as suit a small picture."""
    return make_config(
        method=method, film={"width": SIZE, "height": SIZE}, iws={"paths": 32}, forecast={"photons": 50_000}
    )


def kept(name: str) -> dict[str, Any]:
    """What third_party.json says of a scene; `blocks` as an array."""
    told = json.loads(KEPT.read_text())[name]
    return {**told, "blocks": np.array(told["blocks"])}


def p_values(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Welch's t-test between batches (n, ...) and (m, ...), value by value."""
    return stats.ttest_ind(a, b, axis=0, equal_var=False).pvalue


def difference(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Relative difference a / b - 1 of the means, channels averaged, of every block and of the whole (last), and
    its standard error; a and b (n, blocks, 3) are batches."""
    per_batch = [np.concatenate([x.mean(axis=2), x.mean(axis=(1, 2))[:, None]], axis=1) for x in (a, b)]
    (mean_a, mean_b), (error_a, error_b) = (
        [x.mean(axis=0) for x in per_batch],
        [x.std(axis=0, ddof=1) / np.sqrt(len(x)) for x in per_batch],
    )
    return mean_a / mean_b - 1, np.hypot(error_a / mean_a, error_b / mean_b)


def told(found: np.ndarray, wanted: np.ndarray) -> str:
    """One line on the difference between two renders."""
    ratio, error = (100 * x for x in difference(found, wanted))
    blocks = ", ".join(f"{r:+.2f} ± {e:.2f}" for r, e in zip(ratio[:-1], error[:-1], strict=True))
    least = float(p_values(found, wanted).min())
    corrected = 1 - (1 - least) ** found[0].size
    return f"whole {ratio[-1]:+.3f} ± {error[-1]:.3f} %, blocks {blocks} %; p = {corrected:.2f} (Sidak-corrected)"


def main() -> None:
    """See the head of this file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=1 << 13, help="per pixel, of each scene (default 8192)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--write", action="store_true", help=f"keep the new ones in {KEPT.name}")
    parser.add_argument(
        "--ours", action="store_true", help="render ours instead, pt and iws+cf with a 16th of the samples"
    )
    arguments = parser.parse_args()
    new: dict[str, Any] = {}
    for name in BRIGHTEST:
        if arguments.ours:
            for method, share in (("pt", 1), ("iws+cf", 16)):
                pictures = render_ours(name, configured(method), arguments.samples // share)
                line = told(block_means(pictures, kept(name)["left_out"]), kept(name)["blocks"])
                print(f"{name} {method}, {arguments.samples // share} samples per pixel: {line}", flush=True)
            continue
        began = time.process_time()
        pictures, renderer = render_theirs(name, arguments.samples, arguments.seed)
        seconds = time.process_time() - began
        if arguments.write:
            left_out = np.flatnonzero(pictures.mean(axis=(0, 3)) > BRIGHTEST[name]).tolist()
        else:
            left_out = kept(name)["left_out"]
            print(
                f"{name}: {told(block_means(pictures, left_out), kept(name)['blocks'])}, {seconds:.0f} CPU s",
                flush=True,
            )
        new[name] = {
            "renderer": renderer,
            "samples_per_pixel": arguments.samples,
            "cpu_seconds": round(seconds, 1),
            "scene_hash": scene_of(name).content_hash,
            "left_out": left_out,
            "blocks": np.round(block_means(pictures, left_out), 7).tolist(),
        }
    if arguments.write:
        KEPT.write_text(json.dumps(new) + "\n")


if __name__ == "__main__":
    main()
