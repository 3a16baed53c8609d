"""Other renderers beside ours: error against CPU time on the same scenes, one thread each, a chart and a table a scene.

Finished runs are kept, so a stopped comparison goes on.
"""

import argparse
import functools
import hashlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import msgspec

from causticmpi import __version__
from causticmpi.compare.charts import as_png, require_matplotlib
from causticmpi.compare.metrics import ReferencePicture
from causticmpi.compare.page import save
from causticmpi.compare.tables import to_csv, to_markdown
from causticmpi.config.command_line import Parser, count, one_line, positive
from causticmpi.config.load import load_config
from causticmpi.config.records import RenderConfig
from causticmpi.errors import InputError
from causticmpi.kernels.jit import cache_directory
from causticmpi.peers.chart import chart
from causticmpi.peers.recording import Recording, Task, budgets, load
from causticmpi.peers.references import find_reference, from_halves
from causticmpi.peers.results import ALL, Contender, Point, misplaced, points_of, raw_table, table
from causticmpi.peers.scenes import common_scene

SCENES = "cornell,ring,pool,figurines"
HALVES = (900_001, 900_002)
"""Seeds of a reference's halves: no run of a comparison uses them."""
NOTE = (
    "One thread; CPU seconds of rendering, with whatever a renderer prepares for it (our photons, clusters and trees; "
    "LuxCore's tree of rays and photons), without importing, loading and compiling. relMSE: mean of squared error over "
    "reference^2 + 0.01, all pixels; trimmed: without the worst 0.1 %; the reference's noise is subtracted. Mean "
    "radiance: difference to the reference's, with its standard error where pixels are independent. Depth 24, box "
    "filter, no clamping. LuxCore has spheres as meshes."
)
SET_HERE = ("scene", "method", "budget", "seed", "output")
"""Keys of a config that the comparison sets, or that change no picture."""
NEEDED = {"mitsuba": ("mitsuba",), "luxcore": ("pyluxcore",), "ours": ()}


def read_arguments(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line of `scripts/peers`."""
    parser = Parser(prog="scripts/peers", description=__doc__)
    parser.add_argument("--scenes", default=SCENES, help=f"names in configs/, or config files (default {SCENES})")
    parser.add_argument("--seconds", type=budgets, default=budgets("5,15,60"), help="CPU-time budgets (5,15,60)")
    parser.add_argument("--scale", type=positive, default=1.0, help="factor of all times, the reference's too")
    parser.add_argument("--only", default="", help="such as ours,mitsuba:path: renderers or their methods")
    parser.add_argument("--seeds", type=count, default=1, help="runs of each method; tables show medians")
    parser.add_argument("--references", type=Path, help="folder of SCENE.npz (half1, half2) or SCENE/reference.exr")
    parser.add_argument("--reference-seconds", type=positive, default=300.0, help="CPU time of each half (300)")
    parser.add_argument("--tessellate", type=int, metavar="LEVEL", help="spheres as icospheres, for all renderers")
    parser.add_argument("--out", type=Path, default=Path("out/peers"), help="output directory (out/peers)")
    parser.add_argument("--show", action="store_true", help="run nothing: tables and charts of what there is")
    return parser.parse_args(argv)


def contenders(only: str) -> list[Contender]:
    """All methods whose name begins with one of `only`, a list with commas. Raises InputError for none."""
    wanted = [word for word in only.split(",") if word]
    found = [c for c in ALL if not wanted or any(c.name == w or c.name.startswith(f"{w}:") for w in wanted)]
    if not found:
        raise InputError(f"--only: found {only}; allowed: ours, mitsuba, luxcore, {', '.join(c.name for c in ALL)}")
    for contender in found:
        for package in NEEDED[contender.module]:
            if find_spec(package) is None:
                raise InputError(f"{contender.name} needs the package {package}: pip install '.[peers]' in the clone")
    return found


def keyed(task: Task, module: str | None) -> Task:
    """The task with its key: sha256 (hex) of scene, film, budgets, seed, method and the code that runs them.

    The code: versions of the packages of `module`; for ours also config and kernels; nothing for None.
    """
    config, scene_hash = _loaded(task.config)
    plain = msgspec.to_builtins(config)
    known = [scene_hash, plain["film"], task.seconds, task.seed, task.method]
    known += [version(package) for package in NEEDED.get(module or "", ())]
    if module == "ours":
        kept = {name: value for name, value in plain.items() if name not in SET_HERE}
        known += [kept, cache_directory().name, __version__]
    return replace(task, key=hashlib.sha256(json.dumps(known).encode()).hexdigest())


@functools.cache
def _loaded(config_file: Path) -> tuple[RenderConfig, str]:
    """A config and its scene's content hash; meshes are read once for all runs."""
    config, scene = load(config_file)
    return config, scene.content_hash


def finished(task: Task) -> bool:
    """Whether the task's file holds just this run."""
    try:
        return Recording.read(task.out)[1]["key"] == task.key
    except (OSError, ValueError, KeyError):
        return False


def start(module: str, task: Task) -> subprocess.Popen[bytes]:
    """The renderer's process; what it prints goes into a file beside the recording."""
    one_thread = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    command = [sys.executable, "-m", f"causticmpi.peers.{module}", *task.arguments()]
    with task.out.with_suffix(".log").open("wb") as log:
        return subprocess.Popen(command, env={**os.environ, **one_thread}, stdout=log, stderr=log)


def make_reference(config: Path, folder: Path, seconds: float) -> ReferencePicture:
    """Two independent halves by our `iws+cf`, at once on two cores, kept in `folder`.

    They stay when kernels change: a reference does not depend on how fast it was made.
    """
    tasks = [Task(config, "iws+cf", folder / f"reference-{seed}.npz", (seconds,), seed) for seed in HALVES]
    tasks = [keyed(task, None) for task in tasks]
    started = [(task, start("ours", task)) for task in tasks if not finished(task)]
    for task, process in started:
        if process.wait() != 0:
            raise SystemExit(f"the reference failed: see {task.out.with_suffix('.log')}")
    first, second = (Recording.read(task.out)[0].pictures[-1] for task in tasks)
    return from_halves(first, second)


def compare_scene(name: str, config_file: Path, arguments: argparse.Namespace) -> list[Point]:
    """All that is missing of one scene; its points, and its table as Markdown and CSV."""
    folder = arguments.out / name
    config, changes = common_scene(config_file, folder, arguments.tessellate)
    seconds = tuple(arguments.scale * s for s in arguments.seconds)
    film = load_config(config).film
    reference = None
    if arguments.references is not None:
        reference = find_reference(arguments.references, name, (film.height, film.width))
    notes = [NOTE, f"Changed: {changes}." if changes else ""]
    if reference is None:
        half = arguments.scale * arguments.reference_seconds
        notes.append(f"Reference: our iws+cf, two halves of {half:g} CPU seconds, other seeds.")
        say(f"{name}: reference, two halves of {half:g} CPU seconds")
        reference = make_reference(config, folder, half)
    points = []
    for seed in range(1, arguments.seeds + 1):
        for contender in arguments.contenders:
            out = folder / f"{contender.module}-{contender.method}-{seed}.npz"
            task = keyed(Task(config, contender.method, out, seconds, seed), contender.module)
            found, told = _points(contender, task, reference, arguments.show)
            points += found
            notes += told
    if points:
        made = table(name, points, [note for note in notes if note])
        save(arguments.out / f"{name}.md", to_markdown(made).encode())
        save(arguments.out / f"{name}.csv", to_csv(raw_table(name, points)).encode())
    return points


def _points(contender: Contender, task: Task, reference: ReferencePicture, show: bool) -> tuple[list[Point], list[str]]:
    """The points of one run, which is made if it is missing, and what there is to say about it."""
    if not finished(task):
        if show:
            return [], []
        began = time.monotonic()
        if start(contender.module, task).wait() != 0 or not finished(task):
            say(f"  {contender.name} FAILED: see {task.out.with_suffix('.log')}")
            return [], [f"{contender.renderer} {contender.label} failed."]
        say(f"  {contender.name}, seed {task.seed}: {time.monotonic() - began:.0f} s of wall clock")
    points = points_of(contender, task.seed, task.out, reference)
    last = points[-1]
    mean = f"mean {100 * last.mean_difference:+.2f} %"
    say(f"  {contender.name}: relMSE {last.relmse:.3g} at {last.seconds:.1f} s, {mean}")
    moved = misplaced(task.out, reference)
    return points, [f"{contender.renderer} {contender.label} {moved}." if moved else ""]


def compare(arguments: argparse.Namespace) -> None:
    """Every scene in turn; after each, the table and the charts of all so far."""
    require_matplotlib()
    arguments.contenders = contenders(arguments.only)
    files = [Path(s) if s.endswith(".yaml") else Path(f"configs/{s}.yaml") for s in arguments.scenes.split(",")]
    whole = len(files) * len(arguments.contenders) * arguments.seeds * arguments.scale * arguments.seconds[-1]
    say(f"at most {whole / 60:.0f} CPU minutes of runs, references apart")
    results: dict[str, list[Point]] = {}
    for file in files:
        points = compare_scene(file.stem, file, arguments)
        if points:
            results[file.stem] = points
            save(arguments.out / f"{file.stem}.png", as_png(chart({file.stem: points})))
    if results:
        save(arguments.out / "peers.png", as_png(chart(results)))
        say(f"{arguments.out}: peers.png, and a table (.md, .csv) and a chart (.png) for each scene")


def say(line: str) -> None:
    """Progress, for people."""
    print(line, flush=True)


def main() -> int:
    """Entry of `python -m causticmpi.peers`; returns the exit code."""
    try:
        compare(read_arguments())
    except InputError as error:
        print(one_line(error, "peers"), file=sys.stderr)
        return 2
    return 0
