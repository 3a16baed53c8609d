"""Pages of the stability laboratory: what may be asked, what is refused, and in which order it is measured."""

import math
import re
from operator import attrgetter
from pathlib import Path

import msgspec
import numpy as np
import pytest
from stability_tools import PAGES, page

from causticmpi.config.records import RenderConfig
from causticmpi.errors import InputError
from causticmpi.scene.load import load_scene
from causticmpi.stability import sweep
from causticmpi.stability.run import _tasks, main, read_pages
from causticmpi.stability.scenes import TEMPLATES, build, write_scene


def test_too_few_batches_for_a_t_test_are_refused() -> None:
    with pytest.raises(msgspec.ValidationError, match="batches"):
        page(batches=7)


@pytest.mark.parametrize("template", TEMPLATES)
def test_every_template_loads_at_any_place_and_size(template: str, tmp_path: Path) -> None:
    here = load_scene(write_scene(build(template, {}), tmp_path / "a.yaml"))
    there = load_scene(write_scene(build(template, {"scale": 10, "offset": 5}), tmp_path / "b.yaml"))
    np.testing.assert_allclose(there.vertices, 10 * here.vertices + 5, rtol=1e-5)
    np.testing.assert_allclose(there.spheres[:, 3], 10 * here.spheres[:, 3], rtol=1e-5)


def test_pages_that_come_along_are_sound() -> None:
    pages = read_pages(PAGES)
    assert len(pages) >= 20 and len({loaded.name for loaded in pages}) == len(pages)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"room": {"template": "boks"}}, 'found "boks"; allowed: box'),
        ({"sweep": {"parameter": "scene.lamp", "name": "l", "values": [1]}}, 'found the parameter "lamp"'),
        ({"sweep": {"parameter": "iws.bond", "name": "b", "values": [1]}}, "iws.bond = 1"),
        ({"sweep": {"parameter": "photons", "name": "p", "values": ["fibs"]}}, "allowed: none, wrong light"),
        ({"baseline": "ptt"}, "allowed: pt, cf"),
        ({"claim": {"of": "cff", "fixed": ["pt"]}}, 'claim: found "cff"; allowed: pt, cf'),
    ],
)
def test_pages_that_could_not_run_are_refused(change: dict, words: str) -> None:
    with pytest.raises(InputError, match=re.escape(words)):
        sweep.check_page(page(**change), Path("."))


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("--seeds=0", 'scripts/stability: --seeds: found "0"; allowed: an integer >= 1; see scripts/stability --help'),
        ("-j0", '-j: found "0"; allowed: an integer >= 1'),
        ("--scale=-1", '--scale: found "-1"; allowed: a number > 0'),
        (
            "--scael=1",
            'found "--scael"; allowed: -h, --help, --out, --scale, --seeds, --docs, -j; did you mean "--scale"? See',
        ),
        ("--scale=nan", '--scale: found "nan"; allowed: a number > 0'),
    ],
)
def test_options_that_could_not_run_are_refused(option: str, words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["page.yaml", option]) == 2
    told = capsys.readouterr().err
    assert words in told and told.count("\n") == 1


def test_two_pages_of_one_name_are_refused(tmp_path: Path) -> None:
    (tmp_path / PAGES[0].name).write_text(PAGES[0].read_text())
    with pytest.raises(InputError, match="two pages named adaptive_hidden; allowed: names that differ"):
        read_pages([PAGES[0], tmp_path / PAGES[0].name])


def test_a_long_cell_does_not_start_last(tmp_path: Path) -> None:
    """Runs of unknown length first, then the rivals of all cells, then cells with the most contenders and seconds."""
    pages = {loaded.name: loaded for loaded in read_pages(PAGES)}
    costs = {
        name: [task.cost for task in _tasks(pages[name], tmp_path, 0.5, 1)]
        for name in ("coverage", "table", "variants")
    }
    assert costs["coverage"] == [math.inf] * 3
    assert costs["table"] == [pytest.approx(1.5)] * 5 + [pytest.approx(1.5 * 8)]
    assert costs["variants"] == [pytest.approx(0.5 * pages["variants"].page.seconds * (8 + 2 * 2))] * 2


def test_what_a_page_calls_the_default_is_the_default() -> None:
    sweeps = [loaded.page.sweep for loaded in read_pages(PAGES)]
    marked = [s for s in sweeps if s is not None and s.start is not None and s.parameter != "photons"]
    assert len(marked) >= 9
    for s in marked:
        default = attrgetter(s.parameter)(RenderConfig(scene=""))
        assert s.start == (list(default) if isinstance(default, tuple) else default), s.parameter
        assert s.start in s.values


def test_pages_of_one_scene_share_their_rivals(tmp_path: Path) -> None:
    tasks = {loaded.name: _tasks(loaded, tmp_path, 1.0, 1)[-1] for loaded in read_pages(PAGES)}
    assert tasks["bound"].key and tasks["bound"].key == tasks["clusters"].key == tasks["table"].key
    assert len({tasks[name].key for name in ("bound", "photons", "lies", "pm_radius")}) == 4
    assert tasks["ior"].key is None
