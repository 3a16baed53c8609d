"""`causticmpi inspect`: two pictures, a table on the terminal, the same numbers as JSON."""

import json
import sys
from pathlib import Path

from PIL import Image, PngImagePlugin

from causticmpi.config.records import RenderConfig
from causticmpi.distributed.begin import sound_scene
from causticmpi.distributed.clock import Stopwatch
from causticmpi.inspect.figures import clusters_by_rank, photon_shooting
from causticmpi.inspect.findings import find
from causticmpi.inspect.numbers import numbers, table
from causticmpi.inspect.scenery import Scenery
from causticmpi.output.directory import write_whole

SHOOTING, CLUSTERS, NUMBERS = "figure1-photon-shooting.png", "figure2-clusters-by-rank.png", "inspect.json"


def inspect(config: RenderConfig, scene_file: Path, directory: Path) -> int:
    """Inspect a scene under a config; files of an earlier inspection in `directory` are replaced. Returns 0, raises
    InputError before anything is written."""
    watch = Stopwatch()
    with watch.stage("load"):
        scene = sound_scene(config, scene_file)
    print(f"causticmpi: inspecting {scene_file}", file=sys.stderr, flush=True)
    found = find(config, scene, watch)
    scenery = Scenery(found)
    directory.mkdir(parents=True, exist_ok=True)
    shooting = photon_shooting(found, scenery)
    _write_picture(directory / SHOOTING, *shooting)
    if found.statistics is not None:
        _write_picture(directory / CLUSTERS, *clusters_by_rank(found, scenery))
    else:
        (directory / CLUSTERS).unlink(missing_ok=True)
    told = numbers(found)
    text = json.dumps(told, indent=2, allow_nan=False) + "\n"
    write_whole(directory / NUMBERS, lambda path: path.write_text(text, encoding="utf-8"))
    for warning in found.forecasting.warnings:
        print(f"causticmpi: warning: {warning}", file=sys.stderr)
    print(table(told))
    print(f"{directory}: {', '.join(path.name for path in sorted(directory.glob('figure?-*.png')))}, {NUMBERS}")
    return 0


def _write_picture(path: Path, image: Image.Image, caption: str) -> None:
    """As PNG, the caption in its tEXt chunk Description."""
    info = PngImagePlugin.PngInfo()
    info.add_text("Description", caption)
    write_whole(path, lambda file: image.save(file, "PNG", pnginfo=info))
