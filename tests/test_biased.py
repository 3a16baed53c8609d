"""`iws+pm` as users run it: called biased wherever its pictures go, the same on any number of ranks."""

from pathlib import Path

import pytest
from mpi_tools import require_mpi
from PIL import Image
from program_tools import (
    CORNELL,
    assert_same_layers,
    compile_kernels,
    read_layers,
    read_report,
    render_here,
    render_mpi,
    rgb,
)

from causticmpi.cli.main import main

MAPPED = ("--spp", "4", "--method", "iws+pm", "--set", "photon_map.photons=3000")


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four passes by one process without MPI."""
    return render_here(tmp_path_factory.mktemp("alone") / "out", *MAPPED)


def test_biased_is_said_everywhere(alone: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    render_here(tmp_path / "out", *MAPPED)
    told = capfd.readouterr()
    assert "iws+pm (biased), estimated relMSE" in told.out and "warning: iws+pm is biased" in told.err
    report = read_report(alone)
    assert report["method"] == "iws+pm" and report["biased"] is True
    assert any("biased" in warning for warning in report["warnings"])
    assert report["forecast"]["photons"] == 3000 < report["forecast"]["particles"]
    assert report["forecast"]["search_radius"] > 0
    assert report["seconds"]["photons"] > 0 and report["seconds"]["trees"] > 0 == report["seconds"]["clustering"]
    layers, header = read_layers(alone)
    assert header["biased"] == "yes" and header["method"] == "iws+pm"
    assert rgb(layers, "caustic.").mean() > 0.005
    with Image.open(alone / "image.png") as picture:
        assert picture.info["Biased"] == "yes"


def test_check_says_biased(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(CORNELL), "--set", "method=iws+pm"]) == 0
    told = capfd.readouterr().out
    assert "method iws+pm (biased)" in told and "from a map of 200000 photons" in told
    assert "warning  iws+pm is biased" in told


@pytest.mark.mpi
@pytest.mark.parametrize("ranks", [1, 2])
def test_the_number_of_ranks_does_not_show(alone: Path, ranks: int, tmp_path: Path) -> None:
    require_mpi()
    compile_kernels()
    render_mpi(ranks, tmp_path / "out", *MAPPED)
    assert_same_layers(read_layers(tmp_path / "out")[0], read_layers(alone)[0])
