"""What a renderer's process takes and leaves: its command line, pictures at CPU-time budgets, facts about the run."""

import argparse
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np

from causticmpi.config.command_line import positive
from causticmpi.config.load import load_config, scene_path
from causticmpi.config.records import RenderConfig
from causticmpi.output.directory import write_whole
from causticmpi.scene.data import SceneData
from causticmpi.scene.load import load_scene


@dataclass(frozen=True)
class Task:
    """What one process renders. seconds: CPU-time budgets, ascending; key: goes into the facts, marks the run."""

    config: Path
    method: str
    out: Path
    seconds: tuple[float, ...]
    seed: int = 1
    key: str = ""

    def arguments(self) -> list[str]:
        """The command line that `read_task` reads."""
        seconds = ",".join(f"{s:g}" for s in self.seconds)
        options = ["--seconds", seconds, "--seed", str(self.seed), "--key", self.key]
        return [str(self.config), self.method, str(self.out), *options]


def load(config_file: Path) -> tuple[RenderConfig, SceneData]:
    """A config and its scene. Raises InputError."""
    config = load_config(config_file)
    return config, load_scene(scene_path(config_file, config))


def read_task() -> Task:
    """The task of this process, from its command line."""
    parser = argparse.ArgumentParser()
    parser.add_argument("config", type=Path)
    parser.add_argument("method")
    parser.add_argument("out", type=Path)
    parser.add_argument("--seconds", type=budgets, required=True)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--key", default="")
    return Task(**vars(parser.parse_args()))


def budgets(text: str) -> tuple[float, ...]:
    """`5,15,60` as numbers, ascending; for argparse."""
    return tuple(sorted(positive(word) for word in text.split(",")))


@dataclass
class Recording:
    """Pictures (H, W, 3) float32, radiance, of a growing run: one for each CPU-time budget.

    seconds: CPU time when the picture was complete; samples: per pixel.
    """

    budgets: tuple[float, ...]
    pictures: list[np.ndarray] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    samples: list[float] = field(default_factory=list)

    @property
    def done(self) -> bool:
        """Whether every budget has its picture."""
        return len(self.pictures) == len(self.budgets)

    def due(self, seconds: float, step: float) -> bool:
        """Whether the next budget is nearer to now, `seconds`, than to the next chance, `step` seconds later."""
        return not self.done and seconds + step / 2 >= self.budgets[len(self.pictures)]

    def take(self, picture: np.ndarray, seconds: float, step: float, samples: float) -> None:
        """Take the picture for every budget that is due."""
        while self.due(seconds, step):
            self.pictures.append(picture.astype(np.float32))
            self.seconds.append(seconds)
            self.samples.append(samples)

    def write(self, task: Task, facts: Mapping[str, Any]) -> None:
        """The task's .npz, whole or not at all. facts: plain data."""

        def save(temporary: Path) -> None:
            lists: dict[str, Any] = {k: np.array(v) for k, v in asdict(self).items()}
            with temporary.open("wb") as file:
                np.savez(file, facts=np.array(json.dumps({**facts, "key": task.key})), **lists)

        write_whole(task.out, save)

    @classmethod
    def read(cls, path: Path) -> tuple[Self, dict[str, Any]]:
        """What `write` wrote: recording and facts. Raises OSError, ValueError, KeyError for other files."""
        with np.load(path) as file:
            found = cls(tuple(file["budgets"].tolist()))
            found.pictures = list(file["pictures"])
            found.seconds, found.samples = file["seconds"].tolist(), file["samples"].tolist()
            return found, json.loads(str(file["facts"]))
