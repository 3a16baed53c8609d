"""Bad input: one line on standard error, exit code 2, nothing written, whatever the number of ranks."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
from mpi_tools import run_mpi
from program_tools import PATIENCE, main, run_program, tree

SCENE = """\
camera: {eye: [0, 0, 4], target: [0, 0, 0]}
materials:
  white: {type: diffuse, reflectance: 0.5}
  glass: {type: dielectric, ior: 1.5}
shapes:
  - {type: quad, corners: [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], material: white, emission: 1}
"""
CONFIG = """\
scene: scene.yaml
film: {width: 16, height: 12}
budget: {spp: 1}
output: {directory: OUT}
"""
PLY = """\
ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face FACES
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
1 1 Z
"""
FLAT_LIGHT = "{type: quad, corners: [[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]], material: white, emission: 1}"


def add_shape(shape: str) -> Callable[[Path], object]:
    return lambda folder: (folder / "scene.yaml").write_text(f"{SCENE}  - {shape}\n")


def add_mesh(text: str) -> Callable[[Path], object]:
    def prepare(folder: Path) -> None:
        (folder / "m.ply").write_text(text)
        add_shape("{type: mesh, file: m.ply, material: white}")(folder)

    return prepare


def change(old: str, new: str) -> Callable[[Path], object]:
    def prepare(folder: Path) -> None:
        config = folder / "config.yaml"
        assert old in config.read_text()
        config.write_text(config.read_text().replace(old, new))

    return prepare


def nothing(folder: Path) -> None:
    pass


@dataclass(frozen=True)
class Bad:
    """prepare: spoils the files of a folder; words: more of the command line; pieces: what the message has to say."""

    prepare: Callable[[Path], object]
    pieces: tuple[str, ...]
    words: tuple[str, ...] = ()


BAD = {
    "misspelt key": Bad(change("film:", "flim:"), ("config.yaml:2: ", "flim: unknown key", 'did you mean "film"?')),
    "misspelt inner key": Bad(change("width", "widht"), (":2: ", "widht", 'did you mean "width"?')),
    "wrong type": Bad(change("width: 16", "width: wide"), (":2: ", 'film.width: found "wide"', "integer")),
    "no yaml": Bad(change("film:", "]film:"), ("config.yaml:", "YAML syntax")),
    "missing config": Bad(lambda folder: (folder / "config.yaml").unlink(), ("config.yaml", "no such file")),
    "missing scene": Bad(lambda folder: (folder / "scene.yaml").unlink(), ("scene.yaml", "no such file")),
    "missing mesh": Bad(
        add_shape("{type: mesh, file: no.ply, material: white}"), ("scene.yaml:7: ", "no.ply", "no such file")
    ),
    "mesh with NaN": Bad(
        add_mesh(PLY.replace("Z", "nan").replace("FACES", "1") + "3 0 1 2\n"), ("scene.yaml:7: ", "not finite")
    ),
    "mesh without triangles": Bad(
        add_mesh(PLY.replace("Z", "0").replace("FACES", "0")), ("scene.yaml:7: ", "has no triangles")
    ),
    "light without area": Bad(add_shape(FLAT_LIGHT), ("scene.yaml:7: ", "zero area")),
    "specular light": Bad(
        add_shape("{type: sphere, center: [0, 0, 0], radius: 1, material: glass, emission: 1}"),
        ("scene.yaml:7: ", 'specular material "glass"'),
    ),
    "time in parsecs": Bad(nothing, ('--time 4 parsecs: budget.time: found "4 parsecs"',), ("--time", "4 parsecs")),
    "no time": Bad(nothing, ("--time 0s",), ("--time", "0s")),
    "two budgets": Bad(nothing, ("--spp: not allowed with argument --time",), ("--time", "1s", "--spp", "1")),
    "unknown method": Bad(nothing, ('--method iws+fc: method: found "iws+fc"', "iws+cf"), ("--method", "iws+fc")),
    "no samples": Bad(nothing, ("--spp 0: budget.spp: found 0", ">= 1"), ("--spp", "0")),
    "setting without value": Bad(nothing, ("--set nonsense: found no `=`",), ("--set", "nonsense")),
    "setting of nothing": Bad(nothing, ("--set film.heigth=3", 'did you mean "height"?'), ("--set", "film.heigth=3")),
    "film too large": Bad(
        change("width: 16, height: 12", "width: 65535, height: 65535"), ("65535 x 65535", "GB of this machine", "crop")
    ),
    "config is a scene": Bad(change(CONFIG.split("OUT")[0], SCENE + "#"), ("config.yaml: it is a scene",)),
    "crop outside": Bad(nothing, ("film.crop", "16"), ("--set", "film.crop=[0, 0, 17, 3]")),
    "negative seed": Bad(nothing, ("--seed -1: seed: found -1",), ("--seed", "-1")),
    "output is a file": Bad(
        lambda folder: (folder / "file").touch(), ("file", "it is a file"), ("--out", "{folder}/file")
    ),
    "output below a file": Bad(
        lambda folder: (folder / "file").touch(), ("file/x", "cannot be written to"), ("--out", "{folder}/file/x")
    ),
    "output in /proc": Bad(nothing, ("/proc/causticmpi", "cannot be written to"), ("--out", "/proc/causticmpi")),
    "output holds a run": Bad(
        lambda folder: (folder / "out").mkdir() or (folder / "out" / "image.exr").touch(),
        ("it holds a run already (image.exr)", "--force"),
    ),
    "unknown option": Bad(nothing, ('causticmpi render: found "--fast"', "--help"), ("--fast",)),
    "no ranks": Bad(nothing, ('causticmpi render: -j: found "0"; allowed: an integer >= 1',), ("-j", "0")),
    "ranks in words": Bad(nothing, ('causticmpi render: -j: found "two"', "--help"), ("-j", "two")),
}
UNDER_MPIRUN = ("misspelt key", "mesh with NaN", "unknown option", "output in /proc")


def spoil(bad: Bad, folder: Path) -> list[str]:
    """A sound folder with one thing wrong; returns the command line of a render."""
    (folder / "scene.yaml").write_text(SCENE)
    (folder / "config.yaml").write_text(CONFIG.replace("OUT", str(folder / "out")))
    bad.prepare(folder)
    return ["render", str(folder / "config.yaml"), *(word.format(folder=folder) for word in bad.words)]


def assert_refused(bad: Bad, code: int, err: str, before: dict[str, bytes | None], folder: Path) -> None:
    assert code == 2, err
    assert err.startswith(("causticmpi: ", "causticmpi render: ")) and err.endswith("\n") and err.count("\n") == 1, err
    assert [piece for piece in bad.pieces if piece not in err] == [], err
    assert tree(folder) == before


def test_the_files_are_sound_before_they_are_spoilt(tmp_path: Path) -> None:
    assert main(spoil(Bad(nothing, ()), tmp_path)) == 0
    assert (tmp_path / "out" / "image.exr").exists()


@pytest.mark.parametrize("name", BAD)
def test_bad_input(name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    words = spoil(BAD[name], tmp_path)
    before = tree(tmp_path)
    code = main(words)
    told = capfd.readouterr()
    assert_refused(BAD[name], code, told.err, before, tmp_path)
    assert told.out == ""


@pytest.mark.parametrize("name", ["misspelt key", "mesh without triangles", "unknown method"])
def test_check_refuses_the_same(name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    words = spoil(BAD[name], tmp_path)
    if name == "unknown method":
        words = [*words[:2], "--set", "method=iws+fc"]
    before = tree(tmp_path)
    code = main(["check", *words[1:]])
    err = capfd.readouterr().err
    assert code == 2 and err.count("\n") == 1 and BAD[name].pieces[-1] in err, err
    assert tree(tmp_path) == before


def test_bad_input_of_the_program(tmp_path: Path) -> None:
    bad = BAD["specular light"]
    words = spoil(bad, tmp_path)
    before = tree(tmp_path)
    done = run_program(*words)
    assert_refused(bad, done.returncode, done.stderr, before, tmp_path)


@pytest.mark.mpi
@pytest.mark.parametrize("name", UNDER_MPIRUN)
def test_bad_input_under_mpirun(name: str, tmp_path: Path) -> None:
    words = spoil(BAD[name], tmp_path)
    before = tree(tmp_path)
    done = run_mpi(3, ["-m", "causticmpi", *words], timeout=PATIENCE)
    assert_refused(BAD[name], done.returncode, done.stderr, before, tmp_path)


@pytest.mark.mpi
@pytest.mark.parametrize("verb", ["check", "inspect", "merge", "bench", "compare"])
def test_every_verb_refuses_once_under_mpirun(verb: str, tmp_path: Path) -> None:
    words = (
        (str(tmp_path / "a"), str(tmp_path / "b"), "-o", str(tmp_path / "ab")) if verb == "merge" else ("none.yaml",)
    )
    done = run_mpi(3, ["-m", "causticmpi", verb, *words], timeout=PATIENCE)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and done.stdout == "", done.stderr
    assert tree(tmp_path) == {}


@pytest.mark.mpi
def test_bad_input_through_the_ranks_option(tmp_path: Path) -> None:
    bad = BAD["missing scene"]
    words = spoil(bad, tmp_path)
    before = tree(tmp_path)
    done = run_program(*words, "-j", "2")
    assert_refused(bad, done.returncode, done.stderr, before, tmp_path)
