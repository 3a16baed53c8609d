"""A render is the same picture whatever the number of ranks, and it keeps to its budget."""

import time
from pathlib import Path

import numpy as np
import pytest
from mpi_tools import require_mpi, run_mpi
from program_tools import (
    assert_same_layers,
    compile_kernels,
    read_layers,
    read_report,
    render_here,
    render_mpi,
    render_program,
    rgb,
)

from causticmpi.distributed import clock

COUNTS = ("method", "biased", "passes", "spp", "width", "height", "seed", "nonfinite_samples", "estimated_relmse")


@pytest.fixture(scope="module", autouse=True)
def warm() -> None:
    require_mpi()
    compile_kernels()


@pytest.fixture(scope="module", params=["iws+cf", "pt"])
def alone(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """Method, and the six passes rendered by one process without MPI."""
    out = tmp_path_factory.mktemp("alone") / "out"
    return request.param, render_here(out, "--spp", "6", "--method", request.param)


@pytest.mark.mpi
@pytest.mark.parametrize("ranks", [1, 2, 3])
def test_the_number_of_ranks_does_not_show(alone: tuple[str, Path], ranks: int, tmp_path: Path) -> None:
    method, reference = alone
    render_mpi(ranks, tmp_path / "out", "--spp", "6", "--method", method)
    layers, header = read_layers(tmp_path / "out")
    assert_same_layers(layers, read_layers(reference)[0])
    report, wanted = read_report(tmp_path / "out"), read_report(reference)
    assert {name: report[name] for name in COUNTS} == {name: wanted[name] for name in COUNTS}
    assert report["passes"] == 6 and report["nonfinite_samples"] == 0
    assert report["forecast"] == wanted["forecast"]
    assert report["ranks"] == header["ranks"] == ranks == len(report["memory_mb_per_rank"])
    rays, wanted_rays = report["rays"]["total"], wanted["rays"]["total"]
    if method == "pt":
        assert rays == wanted_rays
    else:  # ranks that share a pass all trace its virtual lights
        assert wanted_rays <= rays < 1.01 * wanted_rays
    seconds = report["seconds"]
    compiling_aside = sum(spent for stage, spent in seconds.items() if stage not in ("total", "warmup"))
    assert 0 < seconds["tracing"] < compiling_aside < seconds["total"]


@pytest.mark.mpi
def test_twenty_ranks(tmp_path: Path) -> None:
    tiny = ("--spp", "3", "--set", "film.width=20", "--set", "film.height=14")
    render_mpi(20, tmp_path / "many", *tiny)
    assert_same_layers(read_layers(tmp_path / "many")[0], read_layers(render_here(tmp_path / "one", *tiny))[0])
    assert read_report(tmp_path / "many")["ranks"] == 20


@pytest.mark.mpi
def test_a_crop_has_the_pixels_of_the_whole(alone: tuple[str, Path], tmp_path: Path) -> None:
    """Any crop of a method whose pixels share nothing; else one along tiles of 4 pixels or the border of the film."""
    method, reference = alone
    x0, y0, x1, y1 = (9, 7, 42, 30) if method == "pt" else (8, 20, 44, 48)
    render_mpi(2, tmp_path / "out", "--spp", "6", "--method", method, "--set", f"film.crop=[{x0}, {y0}, {x1}, {y1}]")
    layers, header = read_layers(tmp_path / "out")
    whole, _ = read_layers(reference)
    assert_same_layers(layers, {name: np.ascontiguousarray(a[y0:y1, x0:x1]) for name, a in whole.items()})
    assert [corner.tolist() for corner in header["dataWindow"]] == [[x0, y0], [x1 - 1, y1 - 1]]
    assert [corner.tolist() for corner in header["displayWindow"]] == [[0, 0], [63, 47]]


def test_the_seed_names_the_picture(alone: tuple[str, Path], tmp_path: Path) -> None:
    method, reference = alone
    again = render_here(tmp_path / "again", "--spp", "6", "--method", method, "--seed", "1")
    other = render_here(tmp_path / "other", "--spp", "6", "--method", method, "--seed", "2")
    wanted, _ = read_layers(reference)
    assert_same_layers(read_layers(again)[0], wanted)
    found, _ = read_layers(other)
    assert np.mean(rgb(found) != rgb(wanted)) > 0.5
    assert found["depth.Z"].tobytes() == wanted["depth.Z"].tobytes()


@pytest.mark.mpi
@pytest.mark.parametrize("way", ["-j 2", "-j2", "plain"])
def test_ways_to_start(way: str, tmp_path: Path) -> None:
    done = render_program(tmp_path / "out", "--spp", "2", *([] if way == "plain" else way.split()))
    assert done.returncode == 0, done.stderr
    ranks = 1 if way == "plain" else 2
    assert read_report(tmp_path / "out")["ranks"] == ranks
    assert done.stdout.startswith(f"{tmp_path / 'out'}: 2 passes in ") and done.stdout.count("\n") == 1
    assert f"on {ranks} rank{'s' if ranks > 1 else ''}, estimated relMSE" in done.stdout
    assert_same_layers(read_layers(tmp_path / "out")[0], read_layers(render_here(tmp_path / "b", "--spp", "2"))[0])


@pytest.mark.mpi
@pytest.mark.parametrize("spp", [1, 5, 13])
def test_samples_are_counted(spp: int, tmp_path: Path) -> None:
    render_mpi(2, tmp_path / "out", "--spp", str(spp), "--method", "pt")
    report = read_report(tmp_path / "out")
    assert report["passes"] == report["spp"] == spp
    if spp == 1:
        layers, header = read_layers(tmp_path / "out")
        assert report["estimated_relmse"] is None and not rgb(layers, "variance.").any()
        assert any("two passes" in warning for warning in report["warnings"]) and "two passes" in header["varianceNote"]


@pytest.mark.mpi
def test_a_time_budget_is_kept(tmp_path: Path) -> None:
    began = time.monotonic()
    render_mpi(2, tmp_path / "out", "--time", "5s")
    outside = time.monotonic() - began
    report = read_report(tmp_path / "out")
    assert 3 < report["seconds"]["total"] < 7 and report["passes"] > 1
    assert report["seconds"]["total"] < outside < 12


@pytest.mark.mpi
def test_the_first_round_is_always_finished(tmp_path: Path) -> None:
    """The time is over before the first round: the picture is that round, whole, and no second one."""
    render_mpi(2, tmp_path / "out", "--time", "0.01s")
    report = read_report(tmp_path / "out")
    passes = report["passes"]
    assert passes >= 1 and report["spp"] == passes and (passes == 1 or passes % 2 == 0)
    assert report["seconds"]["tracing"] < 1  # with the aim of 0.05 s for a round
    again = render_here(tmp_path / "again", "--spp", str(passes))
    assert_same_layers(read_layers(tmp_path / "out")[0], read_layers(again)[0])


Processes = dict[int | str, tuple[str, int, float]]
SHELL: Processes = {5: ("bash", 1, 50.0), 1: ("init", 0, 0.0)}
UNDER_MPIRUN: Processes = {
    "self": ("python", 7, 104.0),
    7: ("hydra_pmi_proxy", 6, 103.0),
    6: ("mpiexec.hydra", 5, 102.0),
}
BEHIND_A_SCRIPT: Processes = {"self": ("python", 7, 104.0), 7: ("bash", 6, 60.0), 6: ("mpirun", 5, 59.0)}
PLAIN: Processes = {"self": ("python", 5, 104.0)}


@pytest.mark.parametrize(
    ("processes", "started"), [(UNDER_MPIRUN, 102.0), (BEHIND_A_SCRIPT, 104.0), (PLAIN, 104.0)], ids=str
)
def test_the_clock_starts_with_the_launcher(
    processes: Processes, started: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clock, "_process", (SHELL | processes).__getitem__)
    monkeypatch.setattr(time, "clock_gettime", lambda which: 110.0)
    assert clock.seconds_since_start() == 110.0 - started


@pytest.mark.mpi
def test_this_launcher_is_known_to_the_clock() -> None:
    program = (
        "import os; from causticmpi.distributed import clock; name, _, started = clock._process(os.getppid()); "
        "print(name.startswith(clock.LAUNCHERS), name, started <= clock._process('self')[2])"
    )
    done = run_mpi(1, ["-c", program])
    assert done.stdout.split()[::2] == ["True", "True"], done.stdout + done.stderr


@pytest.mark.mpi
def test_without_a_specular_surface_nothing_is_forecast(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(
        "camera: {eye: [0, 0, 4], target: [0, 0, 0]}\n"
        "materials: {white: {type: diffuse, reflectance: 0.5}}\n"
        "shapes:\n"
        "  - {type: quad, corners: [[-1, -1, 1], [1, -1, 1], [1, -1, -1], [-1, -1, -1]], material: white}\n"
        "  - {type: sphere, center: [0, 1, 0], radius: 0.2, material: white, emission: 3}\n"
    )
    config = tmp_path / "config.yaml"
    config.write_text("scene: scene.yaml\n")
    render_mpi(2, tmp_path / "out", "--spp", "2", config=config)
    report = read_report(tmp_path / "out")
    assert [report["seconds"][stage] for stage in ("photons", "clustering", "trees")] == [0, 0, 0]
    assert (
        report["forecast"] == {"photons": 0, "particles": 0, "search_radius": None, "plan": None}
        and report["warnings"] == []
    )
    layers, _ = read_layers(tmp_path / "out")
    assert not rgb(layers, "caustic.").any() and rgb(layers).max() > 0.1
