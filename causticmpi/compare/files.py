"""Reading back what a run left: the layers of its picture, its report, its snapshots, and whether it is whole."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from causticmpi import __version__
from causticmpi.compare.plan import Run
from causticmpi.output.directory import EXR, REPORT, UNFINISHED, write_whole

FINISHED, SNAPSHOTS = "finished.json", "snapshots.npz"


@dataclass(frozen=True)
class Layers:
    """Layers of an EXR that causticmpi wrote, (H, W, 3) float64 each."""

    rgb: np.ndarray
    caustic: np.ndarray
    variance: np.ndarray


def read_layers(path: Path) -> Layers:
    """The layers of image.exr or reference.exr. Raises what OpenEXR raises for a file that is none."""
    import OpenEXR  # late: only rank 0 reads

    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
        return Layers(*(_stacked(channels, prefix) for prefix in ("", "caustic.", "variance.")))


def _stacked(channels: dict[str, np.ndarray], prefix: str) -> np.ndarray:
    return np.stack([channels[prefix + axis] for axis in "RGB"], axis=-1).astype(np.float64)


def read_report(directory: Path) -> dict[str, Any]:
    """The run's report.json."""
    report: dict[str, Any] = json.loads((directory / REPORT).read_text())
    return report


def read_snapshots(directory: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pictures (k, H, W, 3) float64, passes (k,) and seconds (k,); see distributed.snapshots."""
    with np.load(directory / SNAPSHOTS) as file:
        pictures = file["pictures"].astype(np.float64)
        return pictures[..., :3] + pictures[..., 3:], file["passes"], file["seconds"]


def run_key(run: Run, scene_hash: str, ranks: int) -> str:
    """sha256 (hex) of all that a run's result depends on, but for the machine: config, scene, ranks, version."""
    plain = msgspec.to_builtins(run.config)
    del plain["output"], plain["scene"]
    known = {"config": plain, "scene": scene_hash, "ranks": ranks, "version": __version__}
    return hashlib.sha256(json.dumps(known, sort_keys=True).encode()).hexdigest()


def is_finished(run: Run, key: str) -> bool:
    """Whether the run's directory holds the whole result of just this run."""
    try:
        found = json.loads((run.directory / FINISHED).read_text())
    except (OSError, ValueError):
        return False
    whole = all((run.directory / name).is_file() for name in (EXR, REPORT))
    return bool(whole and not (run.directory / UNFINISHED).exists() and found.get("key") == key)


def mark_finished(run: Run, key: str) -> None:
    """The last file of a run: from now on it is not repeated."""
    text = json.dumps({"key": key}) + "\n"
    write_whole(run.directory / FINISHED, lambda path: path.write_text(text))
