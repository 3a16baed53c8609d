"""Cells of the stability laboratory: what is measured of one method on one scene."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from stability_tools import BATCHES, PASSES, page

from causticmpi.compare.statistics import FEW_HITS
from causticmpi.stability import cell, sweep
from causticmpi.stability.cell import Bench, config_for, measure
from causticmpi.stability.lies import LIES
from causticmpi.stability.scenes import build, write_scene


def test_hits_are_counted_by_passes_and_without_colour(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(1)

    def whole_pass(_method: object, _index: int, _pixels: object, film: np.ndarray) -> int:
        film[:, :3] += 1
        film[:2, 3:] += random.poisson(20 / PASSES / 2, size=(2, 1))
        return 1

    monkeypatch.setattr(cell, "whole_pass", whole_pass)
    monkeypatch.setattr(cell, "of_scene", lambda *_: ())
    scene, config = SimpleNamespace(brightest=1.0, data=None), config_for(8, 1, {"method": "iws+cf"})
    bench = Bench(scene, config, None, None, 1.0, 0.0, np.arange(64))  # type: ignore[arg-type]
    found = measure(bench, "cf", PASSES // BATCHES, BATCHES)
    assert 10 < found.hits < 40 < FEW_HITS and found.passes == PASSES


def test_kernels_without_maps_are_warmed_up_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They have signatures of their own, which would be compiled in the first pass."""
    warmed: list[bool] = []
    monkeypatch.setattr(cell, "warm_up", lambda _config, _root, forecasting: warmed.append(forecasting))
    monkeypatch.setattr(cell, "_COMPILED", set())
    file = write_scene(build("box", {}), tmp_path / "box.yaml")
    for photons in (300, 0, 0):
        settings = {"method": "iws+cf", "forecast.photons": photons, "forecast.clusters": 4, "forecast.pilot": False}
        cell.set_up(file, config_for(8, 1, settings)).close()
    assert warmed == [True, False]


def test_a_slow_first_pass_has_no_say_in_how_many_follow(monkeypatch: pytest.MonkeyPatch) -> None:
    ends = iter([0.0, 10.0, 10.0, 10.1])
    monkeypatch.setattr(cell, "time", SimpleNamespace(process_time=lambda: next(ends)))
    bench = SimpleNamespace(pixels=np.arange(4), add_pass=lambda *_: 1)
    assert cell.passes_within(bench, 4.0) == pytest.approx(40)  # type: ignore[arg-type]


def test_measured_again_by_other_passes_of_the_same_seed(tmp_path: Path) -> None:
    made = page(
        side=8, batch_passes=2, batches=8, sweep={"parameter": "iws.paths", "name": "paths", "values": [8, 16]},
        contenders=[{"label": "cf", "set": {"method": "iws+cf", "forecast.photons": 300, "forecast.clusters": 4}}],
        baseline=None,
    )  # fmt: skip
    (first,) = sweep.measure_point(made, tmp_path, tmp_path, 1, 1.0, 1).found
    again = sweep.measure_again(made, tmp_path, tmp_path, sweep.CellKey(1, 1, "cf"), 1.0)
    assert again.label == first.label == "cf" and again.seed == first.seed == 2001
    assert again.passes == 8 * first.passes and not np.isin(again.blocks, first.blocks).any()


def test_photons_that_are_no_numbers_are_refused_others_taken(tmp_path: Path) -> None:
    made = page(
        sweep={"parameter": "photons", "name": "lie", "values": list(LIES)}, side=8, batch_passes=2, batches=8,
        contenders=[{"label": "cf", "set": {"method": "iws+cf", "forecast.photons": 300, "forecast.clusters": 4}}],
        baseline=None,
    )  # fmt: skip
    for index, lie in enumerate(LIES):
        point = sweep.measure_point(made, tmp_path, tmp_path, index, 1.0)
        assert bool(point.failed) == (lie in ("nan", "infinite")), lie
        assert all("not finite" in why for why in point.failed.values())
        assert not any(m.nonfinite for m in point.found)
