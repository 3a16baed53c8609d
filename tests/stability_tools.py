"""Made-up pages, measurements and rows for the tests of the stability laboratory."""

import msgspec
import numpy as np
from rendering import REPOSITORY

from causticmpi.compare.statistics import fewest_hits
from causticmpi.stability.cell import Measured
from causticmpi.stability.records import Page
from causticmpi.stability.row import Kind, Row, Verdict

PAGES = sorted((REPOSITORY / "configs" / "stability").glob("*.yaml"))
"""Those that come along."""
BATCHES, PASSES = 16, 256
BLIND = Verdict(Kind.BLIND, "blind: too few hits to judge (3)")


def page(**more: object) -> Page:
    plain = {
        "title": "T", "question": "Q", "room": {"template": "box"}, "baseline": "pt",
        "contenders": [{"label": "pt", "set": {"method": "pt"}}, {"label": "cf", "set": {"method": "iws+cf"}}],
        "sweep": {"parameter": "scene.light", "name": "light", "values": [1.0, 0.1]},
        "truth": {"rivals": [{"label": "rival", "set": {"method": "pt"}}]},
    }  # fmt: skip
    return msgspec.convert({**plain, **more}, Page)


def measured(label: str, method: str, mean: float = 1.0, noise: float = 0.1, seed: int = 1, **more: object) -> Measured:
    """A made-up measurement: 8 x 8 pixels, batches of normal deviation `noise` about `mean`."""
    random = np.random.default_rng(seed)
    return measured_passes(label, method, mean + noise * 4 * random.normal(size=(PASSES, 8, 8, 3)), **more)


def measured_passes(label: str, method: str, pictures: np.ndarray, **more: object) -> Measured:
    """What `measure` makes of passes (n, 8, 8, 3)."""
    passes = pictures.reshape(-1, 4, 2, 4, 2, 3).mean(axis=(2, 4)).reshape(len(pictures), -1)
    blocks = passes.reshape(BATCHES, -1, 48).mean(axis=1)
    pictures = pictures.reshape(BATCHES, -1, 8, 8, 3).mean(axis=1)
    plain = {
        "label": label, "biased": False, "passes": BATCHES, "seconds": 1.0, "preprocess": 0.0,
        "rays": 1000, "slowest": 1.0, "memory_mb": 100.0, "nonfinite": 0, "rgb": pictures.mean(axis=0),
        "variance": pictures.var(axis=0, ddof=1) / BATCHES, "blocks": blocks,
        "hits": fewest_hits(passes.reshape(-1, 16, 3).sum(axis=2)), "caustic": 0.1, "brightest": 0.5,
        "radius": 0.1, "bound": 1.0, "seed": 7, "by_chance": method == "pt",
    }  # fmt: skip
    return Measured(**{**plain, **more})


def row(value: float, label: str, relmse: float, **more: object) -> Row:
    return Row(**{"value": value, "x": value, "label": label, "biased": False, "relmse": relmse, "p": 0.5, "whole": 1.0,
                  "resolution": 0.01, "difference": 0.001, "fireflies": 1.1, **more})  # fmt: skip
