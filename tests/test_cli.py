"""The program from outside: verbs, options, and what a render leaves behind, read by tools that never heard of us."""

import json
import re
import stat
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import OpenImageIO
import pytest
from mpi_tools import ROOT, require_mpi, run_mpi
from PIL import Image
from program_tools import CORNELL, PATIENCE, main, read_layers, read_report, render_here, rgb, run_program, tree, words

from causticmpi import __version__
from causticmpi.cli.main import build_parser
from causticmpi.output.report import STAGES

REPORT_KEYS = {
    "method", "biased", "ranks", "passes", "spp", "width", "height", "seed", "nonfinite_samples", "estimated_relmse",
    "seconds", "rays", "memory_mb",
}  # fmt: skip
CHANNELS = {
    *("R", "G", "B"),
    *(f"{layer}.{axis}" for layer in ("diffusive", "caustic", "variance", "albedo") for axis in "RGB"),
    *("normal.X", "normal.Y", "normal.Z", "depth.Z"),
}


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small render of six passes."""
    return render_here(tmp_path_factory.mktemp("render") / "out", "--spp", "6", "--seed", "7")


def test_help_and_version() -> None:
    done = run_program("--help")
    assert done.returncode == 0 and done.stderr == ""
    assert [verb for verb in ("render", "check") if f"    {verb} " not in done.stdout] == []
    assert "Exit codes: 0 done, 2 bad input" in " ".join(done.stdout.split())
    done = run_program("render", "--help")
    options = ("--method", "--time", "--spp", "--out", "--seed", "-j", "--force", "--resume", "--set")
    assert done.returncode == 0 and [option for option in options if option not in done.stdout] == []
    done = run_program("--version")
    assert (done.returncode, done.stdout) == (0, f"causticmpi {__version__}\n")


@pytest.mark.usefixtures("out")  # its kernels are on disk: to compile them may outlast any patience
def test_the_console_script_is_the_same_program(tmp_path: Path) -> None:
    entry = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]["causticmpi"]
    module, _, function = entry.partition(":")
    script = tmp_path / "causticmpi"  # as pip writes it
    script.write_text(f"#!{sys.executable}\nimport sys\nfrom {module} import {function}\nsys.exit({function}())\n")
    script.chmod(script.stat().st_mode | stat.S_IXUSR)
    done = run_program("--version", start=[str(script)])
    assert (done.returncode, done.stdout) == (0, f"causticmpi {__version__}\n")
    done = run_program(*words(tmp_path / "out", "--spp", "1"), start=[str(script)])
    assert done.returncode == 0 and read_report(tmp_path / "out")["passes"] == 1, done.stderr
    done = run_program("render", str(tmp_path / "none.yaml"), start=[str(script)])
    assert done.returncode == 2 and done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("", "causticmpi: found no VERB; allowed: render, check, "),
        ("--verzion", 'causticmpi: found "--verzion"; allowed: -h, --help, --version; did you mean "--version"? See '),
        ("rendre x", 'did you mean "render"? See causticmpi --help'),
        (
            "render",
            "render: found no CONFIG; allowed: config file (YAML), such as configs/cornell.yaml; see causticmpi",
        ),
        (
            "render x --time",
            "render: --time: found nothing after it; allowed: --time T, wall-clock budget, such as 30s",
        ),
        (
            "render x --until --spp 3",
            "render: --until: found nothing after it; allowed: --until E, stop before that at ",
        ),
        ("render x --output y", 'causticmpi render: found "--output"; allowed: -h, --help, --set, '),
        ("render x --output=y", 'did you mean "--out"? See causticmpi render --help'),
        ("render x --sp 3", 'did you mean "--spp"? See causticmpi render --help'),
        ("render x y", 'causticmpi render: found "y", one word too many; see causticmpi render --help'),
        ("compare x --scene first", 'causticmpi compare: --scene: found "first"; allowed: an integer >= 1; see '),
        ("merge a b", "causticmpi merge: found no -o DIR; allowed: output directory; see causticmpi merge --help"),
        ("merge", "found no RUN and no -o DIR; allowed: directories of finished or stopped runs, two or more; output "),
    ],
)
def test_a_wrong_command_line_is_one_line(line: str, told: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(line.split()) == 2
    err = capfd.readouterr().err
    assert told in err and err.startswith("causticmpi") and err.count("\n") == 1 and "--help\n" in err, err


@pytest.mark.parametrize(
    ("option", "told"), [("--time=-5s", "a time in h, min and s"), ("--seed=-1", "an integer >= 0")]
)
def test_a_value_with_a_minus_is_a_value(option: str, told: str, capfd: pytest.CaptureFixture[str]) -> None:
    for words_of_it in ([option], option.split("=")):
        assert main(["check", str(CORNELL), *words_of_it]) == 2
        err = capfd.readouterr().err
        assert option.replace("=", " ") in err and f"allowed: {told}" in err and err.count("\n") == 1, err


@pytest.mark.parametrize(("verb", "go_on"), [("render", "with --resume"), ("compare", "the same command goes on")])
def test_a_killed_rank_ends_with_code_1(
    verb: str, go_on: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("causticmpi.distributed.launch.launch_ranks", lambda ranks, argv: 137)
    assert main([verb, "x", "-j", "2"]) == 1
    err = capfd.readouterr().err
    assert "ended with code 137: one of them was killed" in err and go_on in err and err.count("\n") == 1


@pytest.mark.parametrize("line", ["render x", "check x", "compare x", "inspect x", "merge x y", "bench x"])
def test_every_verb_that_writes_takes_either_name_of_its_directory(line: str) -> None:
    for name in ("-o", "--out"):
        assert build_parser().parse_args([*line.split(), name, "there"]).out == "there"


def test_check(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "some" / "out"
    command = ["check", str(CORNELL), "--set", f"output.directory={target}", "--set", "film.width=100"]
    assert main([*command, "-j", "20"]) == 0
    told = capfd.readouterr()
    assert tree(tmp_path) == {} and all("compiling kernels" in line for line in told.err.splitlines())
    assert "cornell.yaml: sound\n" in told.out
    assert "12 triangles, 2 spheres" in told.out and "100 x 640 pixels, method iws+cf, budget 240.0 s" in told.out
    assert "forecast from 200000 photons" in told.out and "MB per rank" in told.out
    each, node, there = map(int, re.findall(r"(\d+) MB", told.out))
    assert abs(20 * each + node - there) < 20 and " MB with 20 here\n" in told.out
    assert re.search(r"time     [\d.]+ s of preparation, then .* passes in the time with 20 ranks, a core", told.out)
    assert main([*command, "-j", "9999999"]) == 2 and "on 9999999 ranks; allowed" in capfd.readouterr().err


@pytest.mark.mpi
def test_check_speaks_once_under_mpirun() -> None:
    require_mpi()
    done = run_mpi(3, ["-m", "causticmpi", "check", str(CORNELL)], timeout=PATIENCE)
    assert done.returncode == 0 and done.stdout.count("sound") == 1, done.stdout + done.stderr
    done = run_mpi(3, ["-m", "causticmpi", "check", str(CORNELL), "--set", "sed=1"], timeout=PATIENCE)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and 'did you mean "seed"?' in done.stderr, done.stderr


def test_an_occupied_directory_is_refused_and_forced(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "out"
    render_here(folder, "--spp", "1", "--method", "pt")
    (folder / "notes.txt").write_text("mine")
    before = tree(tmp_path)
    capfd.readouterr()
    assert main(words(folder, "--spp", "2", "--method", "pt")) == 2
    err = capfd.readouterr().err
    assert err.count("\n") == 1 and f"{folder}: it holds a run already" in err and "--force" in err
    assert tree(tmp_path) == before
    assert main(words(folder, "--spp", "2", "--method", "pt", "--force")) == 0
    assert read_report(folder)["passes"] == 2
    after = tree(tmp_path)
    assert after.keys() == before.keys() and after["out/notes.txt"] == b"mine"
    assert after["out/image.exr"] != before["out/image.exr"]


def test_a_directory_with_other_files_is_welcome(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    render_here(tmp_path, "--spp", "1", "--method", "pt")
    results = {"image.exr", "image.png", "report.json", "checkpoint"}
    assert {path.name for path in tmp_path.iterdir()} == {"notes.txt", *results}


def test_the_report(out: Path) -> None:
    report = read_report(out)
    assert report.keys() >= REPORT_KEYS
    assert (report["method"], report["biased"], report["ranks"], report["seed"]) == ("iws+cf", False, 1, 7)
    assert (report["passes"], report["spp"], report["width"], report["height"]) == (6, 6, 64, 48)
    assert report["nonfinite_samples"] == 0 and report["warnings"] == []
    assert list(report["seconds"]) == list(STAGES) and all(spent >= 0 for spent in report["seconds"].values())
    for stage in ("photons", "clustering", "trees", "tracing", "write"):
        assert report["seconds"][stage] > 0
    rays = report["rays"]
    assert rays["total"] > 6 * 64 * 48 and rays["per_second"] * report["seconds"]["tracing"] <= rays["total"]
    assert rays["per_second"] * report["seconds"]["tracing"] > 0.5 * rays["total"]
    assert 30 < report["memory_mb"] < 4000 and len(report["memory_mb_per_rank"]) == 1
    layers, _ = read_layers(out)
    picture, variance = rgb(layers), rgb(layers, "variance.")
    assert report["estimated_relmse"] == pytest.approx(np.mean(variance / (picture**2 + 0.01)), rel=1e-4)


def test_the_exr_as_openimageio_reads_it(out: Path) -> None:
    file = OpenImageIO.ImageInput.open(str(out / "image.exr"))
    assert file, OpenImageIO.geterror()
    spec = file.spec()
    pixels = np.asarray(file.read_image("float"))
    file.close()
    assert (spec.width, spec.height) == (64, 48) and set(spec.channelnames) == CHANNELS
    layers, header = read_layers(out)
    for i, name in enumerate(spec.channelnames):
        assert np.array_equal(pixels[..., i], layers[name]), name
        assert layers[name].dtype == np.float32
    report = read_report(out)
    config = json.loads(spec.getattribute("config"))
    assert config["film"]["width"] == 64 and config["forecast"]["photons"] == 2000 and config["seed"] == 7
    assert config["budget"] == {"time": None, "spp": 6, "until": None} and config["iws"]["paths"] == 8
    for name in ("method", "passes", "seed", "ranks"):
        assert spec.getattribute(name) == header[name] == report[name], name
    assert spec.getattribute("biased") == "no" and spec.getattribute("causticmpiVersion") == __version__
    assert 0 < spec.getattribute("seconds") <= report["seconds"]["total"]


def test_the_layers_add_up(out: Path) -> None:
    layers, _ = read_layers(out)
    total, diffusive, caustic = rgb(layers), rgb(layers, "diffusive."), rgb(layers, "caustic.")
    assert np.allclose(total, diffusive + caustic, rtol=1e-6, atol=1e-7)
    assert diffusive.mean() > 0.05 and caustic.mean() > 0.001
    seen = np.isfinite(layers["depth.Z"])
    variance = rgb(layers, "variance.")
    assert (variance >= 0).all() and np.mean(variance[seen].max(axis=-1) > 0) > 0.95
    normals = np.stack([layers[f"normal.{axis}"] for axis in "XYZ"], axis=-1)
    assert np.allclose(np.linalg.norm(normals[seen], axis=-1), 1, atol=1e-5) and not normals[~seen].any()
    assert seen.mean() > 0.6 and 2.8 < layers["depth.Z"][seen].min() < layers["depth.Z"][seen].max() < 6
    albedo = rgb(layers, "albedo.")
    assert 0 <= albedo.min() and albedo.max() <= 1 and np.mean(np.isclose(albedo[..., 0], 0.725)) > 0.2


def test_the_png_is_the_picture(out: Path) -> None:
    with Image.open(out / "image.png") as image:
        assert image.size == (64, 48) and image.mode == "RGB" and "stops" in image.text["Exposure"]
        shown = np.asarray(image, dtype=np.float64) / 255
    linear = np.clip(rgb(read_layers(out)[0]), 0, 1)
    curve = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    assert np.abs(shown - curve).max() < 0.51 / 255


@pytest.mark.statistical
@pytest.mark.parametrize("method", ["iws+cf", "pt"])
def test_the_variance_layer_is_the_spread_between_seeds(method: str, tmp_path: Path) -> None:
    """Ten pictures of eight passes: their spread and the variance each of them claims, as relative errors.

    A variance of single passes instead of their mean would give a ratio of 8, one of 2 or so a wrong normalization.
    """
    pictures, claimed = [], []
    for seed in range(10):
        render_here(tmp_path / str(seed), "--spp", "8", "--seed", str(seed), "--method", method, "--set=film.width=32")
        layers, _ = read_layers(tmp_path / str(seed))
        pictures.append(rgb(layers))
        claimed.append(rgb(layers, "variance."))
    weight = 1 / (np.mean(pictures, axis=0) ** 2 + 0.01)
    spread = float(np.mean(np.var(pictures, axis=0, ddof=1) * weight))
    claim = float(np.mean(np.mean(claimed, axis=0) * weight))
    assert 0.5 < claim / spread < 2


def test_the_command_line_alone_loads_no_heavy_module():
    code = (
        "import sys\nfrom causticmpi.cli.main import main\ntry:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "print(sorted({'numpy', 'numba', 'scipy', 'yaml', 'msgspec', 'mpi4py', 'PIL'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1] == "[]"
