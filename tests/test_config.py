"""Config files: what loads, and the exact words of what does not."""

import random
from pathlib import Path

import pytest

from causticmpi.config.load import load_config, scene_path
from causticmpi.errors import InputError

ROOT = Path(__file__).resolve().parent.parent
COMPLETE = """\
scene: ../scenes/a.yaml
film:
  width: 320
  height: 200
  crop: [10, 20, 300, 200]
camera: {eye: [0, 0, 3.9], target: [0, 0, 0]}
method: pt
budget: {time: 1h30min}
seed: 7
iws: {paths: 32, bound: 1e5}
forecast:
  photons: 200_000
  table: [16, 8]
  radius: 1e-3
output: {directory: 2024-01-01, interval: 5}
"""


def write(tmp_path: Path, text: str | bytes) -> Path:
    """A config beside the scenes that configs here name: that they are files is all that a config has to know."""
    folder = tmp_path / "configs"
    (tmp_path / "scenes").mkdir(exist_ok=True)
    folder.mkdir(exist_ok=True)
    for scene in (tmp_path / "scenes" / "a.yaml", folder / "a", folder / "s.yaml"):
        scene.touch()
    path = folder / "c.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def message(path: Path, overrides: object = ()) -> str:
    with pytest.raises(InputError) as caught:
        load_config(path, overrides)  # type: ignore[arg-type]
    text = str(caught.value)
    assert "\n" not in text and "Traceback" not in text
    return text


def test_every_key_arrives(tmp_path: Path) -> None:
    path = write(tmp_path, COMPLETE)
    config = load_config(path)
    assert (config.film.width, config.film.height, config.film.crop) == (320, 200, (10, 20, 300, 200))
    assert config.camera is not None and config.camera.eye == (0.0, 0.0, 3.9)
    assert (config.method, config.seed, config.iws.paths) == ("pt", 7, 32)
    assert config.budget.time == 5400.0 and config.budget.spp is None
    assert config.iws.bound == 1e5 and config.forecast.radius == 1e-3
    assert config.forecast.photons == 200_000 and config.forecast.table == (16, 8)
    assert config.output.directory == "2024-01-01", "a date is a text here"
    assert scene_path(path, config) == tmp_path / "configs" / "../scenes/a.yaml"


def test_only_scene_is_needed(tmp_path: Path) -> None:
    config = load_config(write(tmp_path, "scene: s.yaml\n"))
    assert (config.budget.spp, config.budget.time, config.method) == (16, None, "iws+cf")


@pytest.mark.parametrize(("name", "side"), [("cornell", 640), ("ring", 480), ("pool", 480)])
def test_shipped_configs(name: str, side: int) -> None:
    path = ROOT / "configs" / f"{name}.yaml"
    config = load_config(path)
    assert (config.film.width, config.film.height, config.method) == (side, side, "iws+cf")
    assert config.budget.time == 240.0 and config.output.directory == f"out/{name}"
    assert scene_path(path, config).samefile(ROOT / "scenes" / f"{name}.yaml")


# (text after `scene: a`, line, pieces of the message)
BAD = [
    ("film: {widht: 3}", 2, ["film.widht: unknown key", 'did you mean "width"?', "Allowed: width, height, filter"]),
    ("spp: 3", 2, ["spp: unknown key", 'did you mean "budget.spp"?']),
    ("zzzz: 3", 2, ["zzzz: unknown key; allowed: scene, film, camera"]),
    ("film:\n  height: 5\n  width: wide", 4, ['film.width: found "wide"', "allowed: an integer >= 1", "example 1"]),
    ("film: {width: 0}", 2, ["film.width: found 0", "allowed: an integer >= 1"]),
    ("film: {width: 1.5}", 2, ["film.width: found 1.5", "allowed: an integer"]),
    ("film: {width: true}", 2, ["film.width: found true", "allowed: an integer"]),
    ("film: {width: 100000000}", 2, ["film.width: found 100000000", "up to 65535"]),
    ("film: {width:}", 2, ["film.width: found nothing", "allowed: an integer >= 1"]),
    ("film: 5", 2, ["film: found 5", "a section with the keys width, height", "{width: 1}"]),
    ("film: {crop: [0, 0, 700, 10]}", 2, ["film.crop: found [0, 0, 700, 10]", "x1 <= 640", "enlarge the film"]),
    ("film:\n  crop: [5, 0, 5, 10]", 3, ["film.crop: found [5, 0, 5, 10]", "x0 < x1"]),
    ("film: {crop: [0, 9, 5, 9]}", 2, ["film.crop: found", "y0 < y1"]),
    ("film: {crop: [0, -1, 5, 9]}", 2, ["film.crop[1]: found -1", "allowed: an integer >= 0"]),
    ("film: {crop: [0, 1, 5]}", 2, ["film.crop: found [0, 1, 5]", "a list of 4, each an integer"]),
    ("film: {filter: bx}", 2, ['film.filter: found "bx"; allowed: box; did you mean "box"?']),
    ("method: isw+cf", 2, ['method: found "isw+cf"', "pt-brute", 'did you mean "iws+cf"?']),
    ("budget: {time: 3s, spp: 4}", 2, ["budget: found both time and spp", "exactly one", "delete one"]),
    ("budget: {}", 2, ["budget: found neither time nor spp", "exactly one", "spp: 64"]),
    ("budget: {spp: 0}", 2, ["budget.spp: found 0", "an integer >= 1"]),
    ("budget: {time: 4 parsecs}", 2, ['budget.time: found "4 parsecs"', "h, min and s"]),
    ("budget: {time: -1}", 2, ["budget.time: found -1", "> 0"]),
    ("seed: -1", 2, ["seed: found -1", "allowed: an integer >= 0"]),
    ("seed: 9223372036854775808", 2, ["seed: found 9223372036854775808", "allowed: an integer"]),
    ("seed: " + "9" * 5000, 2, ["seed: found an integer of 5000 digits"]),
    ("iws: {bound: aut}", 2, ['iws.bound: found "aut"', "a number > 0 or auto", 'did you mean "auto"?']),
    ("iws: {bound: 0}", 2, ["iws.bound: found 0", "a number > 0 or auto"]),
    ("iws: {bound: .nan}", 2, ["iws.bound: found .nan", "finite"]),
    ("output: {interval: .inf}", 2, ["output.interval: found .inf", "finite"]),
    ("output: {interval: 1e999}", 2, ["output.interval: found 1e999", "finite"]),
    ('output: {directory: " "}', 2, ['output.directory: found ""', "a path"]),
    ("camera: {eye: [0, 0, 1]}", 2, ['camera: missing key "target"', "add `target: [1, 1, 1]`"]),
    ("camera: {eye: [0, 0, 1], target: [0, 0, 1]}", 2, ["camera: eye and target are the same point", "move one"]),
    ("camera:\n  eye: [0, 1, 0]\n  target: [0, 0, 0]\n  up: [0, 2, 0]", 5, ["camera.up: found", "parallel"]),
    ("camera: {eye: [0, 0, 1], target: [0, 0, 0], up: [0, 0, 0]}", 2, ["camera.up: found [0, 0, 0]", "a direction"]),
    ("camera: {eye: [0, 0, 1e30], target: [0, 0, 0]}", 2, ["camera.eye: found", "1e+18", "float32"]),
    ("camera: {eye: [0, 0, 1], target: [0, 0, 0], fov: 180}", 2, ["camera.fov: found 180", "> 0 and < 180"]),
    ("film: {width: 3}\nfilm: {width: 4}", 3, ['duplicate key "film"', "first on line 2", "keep one"]),
    ("film: {width: 3, width: 3}", 2, ['duplicate key "film.width"', "keep one"]),
    ("film: {width: 3", 2, ["YAML syntax", "check indentation"]),
    ("film:\n\twidth: 3", 3, ["YAML syntax"]),
    ("film: &a {width: 3}\niws: *a", 3, ["found alias *a", "not allowed", "write the value out"]),
    ("film: " + "[" * 5000, 2, ["nesting deeper than 16 levels"]),
    ("film: !!python/name:os.system x", 2, ["tags are not allowed"]),
    ("film: !!set {a}", 2, ["tags are not allowed"]),
    ("seed: !!int five", 2, ['seed: found "five", which is no int']),
    ("seed: !!bool five", 2, ['seed: found "five", which is no bool']),
    ("[a, b]: 3", 2, ["as a key", "a plain name"]),
    ('method: "\\UFFFFFFFF"', 2, ["YAML syntax", "check escapes"]),
    ('method: "p\\0t"', 2, ["method: found 'p\\x00t'", "control characters"]),
    ("method: p\x07t", 2, ["control character", "delete it"]),
    ("--- \nfilm: {}", 2, ["YAML syntax", "single document"]),
]


@pytest.mark.parametrize(("text", "line", "pieces"), BAD, ids=[text[:40] for text, _, _ in BAD])
def test_bad_values(tmp_path: Path, text: str, line: int, pieces: list[str]) -> None:
    path = write(tmp_path, f"scene: a\n{text}\n")
    found = message(path)
    assert found.startswith(f"{path}:{line}: ")
    assert [piece for piece in pieces if piece not in found] == [], found


@pytest.mark.parametrize(
    ("text", "where", "piece"),
    [
        ("", ": ", "the file is empty; needs at least one `key: value`"),
        ("# nothing\n", ": ", "the file is empty"),
        (b"scene: a\nmethod: \xff\n", ":2: ", "found byte 0xff, which is not UTF-8; save the file as UTF-8"),
        ("film: {}\n", ":1: ", 'missing key "scene"; add `scene: "..."`'),
        ("- a\n", ":1: ", 'found ["a"]; allowed: a section with the keys scene, film'),
        ("scen: a\n", ":1: ", 'scen: unknown key; did you mean "scene"? Allowed: scene, film'),
        ("scene: 5\n", ":1: ", "scene: found 5; allowed: a text"),
        ("seed: 1\nscene: none.yaml\n", ":2: ", "none.yaml: no such file; the path is relative to the config file"),
        ("scene: ..\n", ":1: ", "scene: cannot read "),
        ("camera: {}\nmaterials: {}\nshapes: []\n", ": ", "it is a scene; allowed: a config"),
        ("scene: a\nfilm:\n\twidth: 3\n", ":3: ", "cannot start any token; indent with spaces"),
        ('scene: ""\n', ":1: ", 'scene: found ""; allowed: a path'),
    ],
)
def test_bad_files(tmp_path: Path, text: str | bytes, where: str, piece: str) -> None:
    path = write(tmp_path, text)
    found = message(path)
    assert found.startswith(f"{path}{where}") and piece in found


def test_missing_file_and_directory(tmp_path: Path) -> None:
    assert "none.yaml: cannot read: no such file or directory; give the path" in message(tmp_path / "none.yaml")
    assert "cannot read: is a directory" in message(tmp_path)


def test_byte_order_mark_and_windows_lines(tmp_path: Path) -> None:
    path = write(tmp_path, b"\xef\xbb\xbfscene: a\r\nseed: 5\r\nfilm: {width: x}\r\n")
    assert message(path).startswith(f"{path}:3: film.width")


def test_overrides_apply_in_both_forms(tmp_path: Path) -> None:
    path = write(tmp_path, COMPLETE)
    as_dict = load_config(path, {"film.width": "640", "--out": "5", "iws.bound": "1e-2", "--method": "iws"})
    as_list = load_config(path, ["film.width=640", "--out=5", "iws.bound=1e-2", "--method=iws"])
    assert as_dict == as_list
    assert as_dict.film.width == 640 and as_dict.film.height == 200
    assert as_dict.output.directory == "5" and as_dict.iws.bound == 0.01 and as_dict.method == "iws"
    assert load_config(path, ["film.crop=null", "film.width=9"]).film.crop is None
    assert load_config(path, ["seed=1", "seed=2"]).seed == 2, "the last one counts"


def test_sections_the_file_does_not_have(tmp_path: Path) -> None:
    path = write(tmp_path, "scene: a\n")
    assert load_config(path, {"forecast.table": "[4, 5]"}).forecast.table == (4, 5)
    assert load_config(path, {"--time": "90"}).budget.time == 90.0


@pytest.mark.parametrize(("key", "spp"), [("--spp", "8"), ("budget.spp", "8")])
def test_a_budget_on_the_command_line_replaces_the_other(tmp_path: Path, key: str, spp: str) -> None:
    timed = write(tmp_path, "scene: a\nbudget: {time: 4min}\n")
    assert load_config(timed, {key: spp}).budget == load_config(timed, {"budget": "{spp: 8}"}).budget
    assert load_config(timed, {key: spp}).budget.spp == 8
    counted = write(tmp_path, "scene: a\nbudget: {spp: 4}\n")
    assert load_config(counted, {"--time": "30s"}).budget.time == 30.0
    assert load_config(counted, {"--time": "30s"}).budget.spp is None
    for both in (["--time=3s", "--spp=4"], ["--spp=4", "--time=3s"]):
        found = message(counted, both)
        assert found.startswith("--time 3s: budget: found both time and spp")


OVERRIDES = [
    ("film.widht=3", ["--set film.widht=3: film.widht: unknown key", 'did you mean "width"']),
    ("film.width=x", ['--set film.width=x: film.width: found "x"', "an integer >= 1"]),
    ("film.width=[", ["--set film.width=[: ", "YAML syntax"]),
    ("film.width=", ["--set film.width=: film.width: found nothing"]),
    ("seed=.nan", ["--set seed=.nan: found .nan", "finite"]),
    ("film.width=100", ["--set film.width=100: film.crop: found [10, 20, 300, 200]", "x1 <= 100"]),
    ("film.crop.0=3", ["--set film.crop.0=3: film.crop: found", "a list of 4"]),
    ("film=3", ["--set film=3: film: found 3", "a section"]),
    ("film", ["--set film: found no `=`", "key.sub=value"]),
    ("=3", ["--set =3: found an empty key", "film.width=320"]),
    ("film..width=3", ["--set film..width=3: found an empty key"]),
    ("camera.up=[0, 0, 1]", ["--set camera.up=[0, 0, 1]: camera.up: found", "parallel"]),
    ("--spp=0", ["--spp 0: budget.spp: found 0", "an integer >= 1"]),
    ("--time=4 parsecs", ['--time 4 parsecs: budget.time: found "4 parsecs"', "h, min and s"]),
    ("--method=pm", ['--method pm: method: found "pm"', "iws+cf"]),
    ("--seed=-1", ["--seed -1: seed: found -1", ">= 0"]),
    ("--out=", ['--out : output.directory: found ""']),
    ("--nope=1", ["--nope 1: unknown option", "--spp"]),
]


@pytest.mark.parametrize(("override", "pieces"), OVERRIDES, ids=[override for override, _ in OVERRIDES])
def test_bad_overrides(tmp_path: Path, override: str, pieces: list[str]) -> None:
    found = message(write(tmp_path, COMPLETE), [override])
    assert found.startswith(pieces[0])
    assert [piece for piece in pieces if piece not in found] == [], found


def test_a_section_made_by_an_override_blames_it(tmp_path: Path) -> None:
    found = message(write(tmp_path, "scene: a\n"), {"camera.fov": "30"})
    assert found.startswith('--set camera.fov=30: camera: missing key "eye"')


def test_the_file_is_validated_whole_all_the_same(tmp_path: Path) -> None:
    path = write(tmp_path, "scene: a\nfilm: {width: x}\n")
    assert message(path, {"film.width": "3"}).startswith(f"{path}:2: film.width")


def test_random_corruptions_load_or_say_why(tmp_path: Path) -> None:
    rng = random.Random(20240501)
    refused = 0
    for _ in range(300):
        text = list(COMPLETE)
        for _ in range(rng.randint(1, 4)):
            at = rng.randrange(len(text))
            text[at : at + rng.choice([0, 1, 1, 6])] = rng.choice(
                list("{}[]:,-&*!%@\"'#\t\n \0") + ["é", "1e9", "..", "<<"]
            )
        path = write(tmp_path, "".join(text))
        try:
            load_config(path)
        except InputError as error:
            refused += 1
            assert "\n" not in str(error) and str(error).startswith(str(path))
    assert 50 < refused < 300


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("photons=0", "found 0; allowed: an integer >= 1"),
        ("photons=2e5", "found 200000.0; allowed: an integer >= 1"),
        ("neighbours=1", "found 1; allowed: an integer >= 2 (the farthest weighs nothing)"),
        ("radius=0", "found 0; allowed: a number > 0 or auto"),
        ("radius=wide", 'found "wide"; allowed: a number > 0 or auto'),
        ("fotons=5", 'did you mean "photons"?'),
    ],
)
def test_bad_photon_maps(tmp_path: Path, setting: str, words: str) -> None:
    path = write(tmp_path, "scene: s.yaml\n")
    text = message(path, [f"photon_map.{setting}"])
    assert words in text and f"--set photon_map.{setting}" in text, text
