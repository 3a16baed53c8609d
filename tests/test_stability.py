"""The stability laboratory: judgements follow from figures, failing cells are named, a small report holds it all."""

import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from rendering import REPOSITORY

from causticmpi.compare.statistics import FEW_HITS, fewest_hits
from causticmpi.errors import InputError
from causticmpi.scene.load import load_scene
from causticmpi.stability import cell, seeds, show, sweep, verdicts
from causticmpi.stability.cell import Bench, Measured, config_for, measure
from causticmpi.stability.judge import expected_hits, judge
from causticmpi.stability.lies import LIES
from causticmpi.stability.records import Claim, Page
from causticmpi.stability.row import FINE, Kind, Row, Verdict
from causticmpi.stability.run import _tasks, main, read_pages
from causticmpi.stability.scenes import TEMPLATES, build, write_scene

PAGES = sorted((REPOSITORY / "configs" / "stability").glob("*.yaml"))
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
    """What `measure` makes of passes (PASSES, 8, 8, 3)."""
    passes = pictures.reshape(PASSES, 4, 2, 4, 2, 3).mean(axis=(2, 4)).reshape(PASSES, -1)
    blocks = passes.reshape(BATCHES, -1, 48).mean(axis=1)
    pictures = pictures.reshape(BATCHES, -1, 8, 8, 3).mean(axis=1)
    plain = {
        "label": label, "biased": False, "passes": BATCHES, "seconds": 1.0, "preprocess": 0.0,
        "rays": 1000, "slowest": 1.0, "memory_mb": 100.0, "nonfinite": 0, "rgb": pictures.mean(axis=0),
        "variance": pictures.var(axis=0, ddof=1) / BATCHES, "blocks": blocks,
        "hits": fewest_hits(passes.reshape(PASSES, 16, 3).sum(axis=2)), "caustic": 0.1, "brightest": 0.5,
        "radius": 0.1, "bound": 1.0, "seed": 7, "by_chance": method == "pt",
    }  # fmt: skip
    return Measured(**{**plain, **more})


def test_a_wrong_mean_is_found_and_a_right_one_is_not() -> None:
    rivals = [measured("rival", "pt", seed=9)]
    right, wrong = (judge(page(), 1.0, 1.0, [measured("cf", "iws+cf", mean)], rivals, 0.1)[0] for mean in (1.0, 1.03))
    assert right.verdict == FINE and right.seed == 7 and right.p > 1e-3 and right.against == "rival"
    assert wrong.verdict == (Kind.WRONG, "WRONG") and wrong.difference == pytest.approx(0.03, abs=0.01)


def lit_by_hits(count: float, mean: float = 1.0) -> Measured:
    """Half of the light is even, the other half comes in `count` equal hits on the whole picture."""
    random = np.random.default_rng(3)
    each = random.poisson(count / PASSES / 64, size=(PASSES, 8, 8, 1)) / (count / PASSES / 64)
    even = 1 + 0.04 * random.normal(size=(PASSES, 8, 8, 3))
    return measured_passes("cf", "iws+cf", mean * (0.5 * even + 0.5 * each))


def test_too_dark_with_few_hits_is_blind_and_with_many_or_too_bright_is_wrong() -> None:
    def verdict(found: Measured) -> str:
        return judge(page(), 1.0, 1.0, [found], [measured("rival", "iws+cf", noise=1e-3, seed=9)], 0.1)[0].verdict.words

    assert re.fullmatch(r"blind: too few hits to judge \(\d+\)", verdict(lit_by_hits(20)))
    assert verdict(lit_by_hits(20, mean=1e3)) == "WRONG"
    assert verdict(lit_by_hits(1e6)) == "" and verdict(lit_by_hits(1e6, mean=0.95)) == "WRONG"
    assert verdict(measured("cf", "iws+cf", 0.95)) == "WRONG" == verdict(measured("pt", "pt", 0.95))
    # A path tracer that would have met the lamp once shows no hit at all.
    assert verdict(measured("pt", "pt", 0.95, brightest=300.0)) == "blind: too few hits to judge (1.1)"
    assert verdict(measured("pt", "pt", 1.05, brightest=300.0)) == "WRONG"
    assert verdict(measured("cf", "iws+cf", 0.95, brightest=300.0)) == "WRONG"
    assert verdict(measured("cf", "iws+cf", 0.95, brightest=300.0, caustic=0.01)).startswith("blind")


def test_hits_in_two_squares_make_darkness_elsewhere_blind() -> None:
    """As where a small lamp is seen: two squares hold all the noise, 16 batches show no skew, and rarer light lacks."""
    random = np.random.default_rng(8)
    rival = measured("rival", "iws+cf", noise=1e-3, seed=9)
    for _ in range(20):
        pictures = 1 + 0.01 * random.normal(size=(PASSES, 8, 8, 3))
        pictures[:, :2, :2] *= 0.9
        assert judge(page(), 1.0, 1.0, [measured_passes("cf", "iws+cf", pictures)], [rival], 0.1)[0].kind is Kind.WRONG
        pictures[:, 2:4, 2:6] += random.poisson(20 / PASSES / 8, size=(PASSES, 2, 4, 1)) * PASSES * 8 / 20 - 1
        assert judge(page(), 1.0, 1.0, [measured_passes("cf", "iws+cf", pictures)], [rival], 0.1)[0].kind is Kind.BLIND


def test_hits_are_counted_by_passes_and_without_colour(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(1)

    def whole_pass(_method: object, _index: int, _pixels: object, film: np.ndarray) -> int:
        film[:, :3] += 1
        film[:2, 3:] += random.poisson(20 / PASSES / 2, size=(2, 1))
        return 1

    monkeypatch.setattr(cell, "whole_pass", whole_pass)
    monkeypatch.setattr(cell, "of_scene", lambda *_: ())
    scene = SimpleNamespace(brightest=1.0, extent=1.0, data=None)
    bench = Bench(scene, config_for(8, 1, {"method": "iws+cf"}), None, None, 0.0, np.arange(64))  # type: ignore[arg-type]
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


def test_no_one_is_too_bright_beside_a_blind_rival() -> None:
    dark = replace(lit_by_hits(5, mean=0.5), label="rival")
    (row,) = judge(page(), 1.0, 1.0, [measured("cf", "iws+cf", 100.0)], [dark], 0.1)
    assert row.verdict.words.startswith("not tested: rival has too few hits") and not row.tested
    (row,) = judge(page(), 1.0, 1.0, [measured("cf", "iws+cf", 100.0)], [dark, measured("seer", "iws+cf", seed=9)], 0.1)
    assert row.kind is Kind.WRONG and row.against == "seer"


def test_blind_cells_are_named_and_not_counted_as_tested() -> None:
    rows = [row(1.0, "pt", 1.0), row(1.0, "cf", 1.0), row(0.1, "pt", 1.0, verdict=BLIND)]
    said = verdicts.unbiasedness(rows)
    assert "in 2 of 2 tested cells" in said and "too few hits to judge: pt at 0.1." in said and "WRONG" not in said


def test_too_few_batches_for_a_t_test_are_refused() -> None:
    with pytest.raises(msgspec.ValidationError, match="batches"):
        page(batches=7)


def test_error_at_equal_time_counts_tracing_preprocess_and_bias() -> None:
    rival = [measured("rival", "pt", seed=9, noise=1e-3)]
    made = page(equal_time=10.0)
    (plain,) = judge(made, 1.0, 1.0, [measured("cf", "iws+cf")], rival, 0.1)
    assert plain.relmse == pytest.approx(0.1**2 / BATCHES / 1.01 / 10.0, rel=0.2)
    (late,) = judge(made, 1.0, 1.0, [measured("cf", "iws+cf", preprocess=5.0)], rival, 0.1)
    assert late.relmse == pytest.approx(2 * plain.relmse)
    (never,) = judge(made, 1.0, 1.0, [measured("cf", "iws+cf", preprocess=11.0)], rival, 0.1)
    assert never.relmse == math.inf and never.verdict == (Kind.LATE, "preprocess exceeds 10 s")
    (biased,) = judge(made, 1.0, 1.0, [measured("pm", "iws+pm", mean=1.1, biased=True)], rival, 0.1)
    assert biased.verdict == (Kind.BIASED, "biased, as it says") and biased.bias == pytest.approx(0.01 / 1.01, rel=0.1)
    assert biased.relmse > biased.bias


def test_who_never_meets_the_light_is_not_believed() -> None:
    blind = measured("pt", "pt", brightest=1e6)
    assert expected_hits(blind, 0.1) < 1
    rows = judge(
        page(), 1.0, 1.0, [blind, measured("cf", "iws+cf", noise=0.3)], [measured("rival", "pt", brightest=1e6)], 0.1
    )
    assert rows[0].kind is Kind.BLIND and not rows[0].trusted
    assert rows[1].verdict == (Kind.UNTESTED, "not tested: no rival sees enough")  # nor does it lose to a blind one
    missing = measured("cf", "iws+cf", caustic=0.01)
    (row,) = judge(page(constant_caustics=True), 1.0, 1.0, [missing], [measured("rival", "pt")], 0.1)
    assert row.verdict == (Kind.MISSES, "misses 90 % of the caustics") and not row.trusted


def test_a_rival_may_have_a_contenders_label() -> None:
    own, rival = measured("pt", "pt"), measured("pt", "pt", seed=9)
    rows = judge(page(), 1.0, 1.0, [own, measured("cf", "iws+cf", seed=2)], [rival], 0.1)
    assert [row.against for row in rows] == ["", "pt"] and rows[0].kind is Kind.UNTESTED


def test_losing_to_plain_sampling_is_named() -> None:
    found = [measured("pt", "pt"), measured("cf", "iws+cf", noise=0.2, seed=2)]
    rows = judge(page(), 1.0, 1.0, found, [measured("rival", "pt", seed=9)], 0.1)
    assert rows[1].kind is Kind.LOSES and re.match("loses to pt: error x [34]", rows[1].verdict.words)


def test_light_where_none_can_be_has_leaked() -> None:
    made = page(truth={"exact": 0.0})
    dark, lit = measured("cf", "iws+cf", 0.0, 0.0), measured("cf", "iws+cf", 2e-4, 0.0)
    assert judge(made, 1.0, 1.0, [dark], [], 0.0)[0].verdict == FINE
    assert judge(made, 1.0, 1.0, [lit], [], 0.0)[0].verdict == (Kind.LEAKS, "leaks 0.0002")


def row(value: float, label: str, relmse: float, **more: object) -> Row:
    return Row(**{"value": value, "x": value, "label": label, "biased": False, "relmse": relmse, "p": 0.5, "whole": 1.0,
                  "resolution": 0.01, "difference": 0.001, "fireflies": 1.1, **more})  # fmt: skip


def _said(made: Page, rows: list[Row]) -> str:
    return f"{verdicts.verdict(made, rows)} {verdicts.unbiasedness(rows)}"


def test_verdicts_follow_the_figures() -> None:
    rows = [row(1.0, "pt", 1e-3), row(1.0, "cf", 1e-2), row(0.1, "pt", 1.0), row(0.1, "cf", 0.05)]
    said = _said(page(), rows)
    assert "Efficiency over that of pt, best and worst light: cf x 20 at 0.1, x 0.1 at 1." in said
    assert "Unbiased within noise in 4 of 4 tested cells" in said
    rows[3] = row(0.1, "cf", 0.05, verdict=Verdict(Kind.WRONG, "WRONG"))
    assert "in 3 of 4 tested cells" in _said(page(), rows) and "WRONG: cf at 0.1" in _said(page(), rows)
    assert verdicts.failures(rows) == ["cf at 0.1: WRONG"]
    made = page(reads="setting", sweep={"parameter": "iws.paths", "name": "paths", "values": [1.0, 8.0], "start": 8.0})
    said = _said(made, [row(1.0, "cf", 0.2), row(8.0, "cf", 0.5)])
    assert "cf: least error at 1, the default 8 has x 2.5 of it" in said


def test_the_claim_over_seeds_holds_fails_or_is_open() -> None:
    claim = Claim(of="cf", fixed=["pt", "two"])

    def turns(gains: list[float], verdict: Verdict = FINE) -> list[list[Row]]:
        return [
            [row(0.1, "pt", g * e), row(0.1, "cf", e, fireflies=1.2, verdict=verdict), row(0.1, "two", 0.99 * g * e)]
            for g, e in zip(gains, (1.0, 2.0, 0.5, 1.0), strict=True)
        ]

    made = page(sweep={"parameter": "scene.light", "name": "light", "values": [0.1]})
    (good,) = seeds.cells(made, claim, turns([1.0, 1.02, 0.99, 1.01]))
    assert good.plain.verdict == "holds" == good.best.verdict and good.best.over == "two" and good.plain.below == 0
    assert good.plain.low < good.plain.mean < good.plain.high and good.plain.least == pytest.approx(0.99)
    (bad,) = seeds.cells(made, claim, turns([0.8, 0.82, 0.79, 0.81]))
    assert bad.plain.verdict == "FAILS" == bad.best.verdict and bad.plain.below == 4
    (unsure,) = seeds.cells(made, claim, turns([0.5, 1.5, 1.0, 1.2]))
    assert unsure.plain.verdict == "open" and unsure.plain.below == 1
    (blind,) = seeds.cells(made, claim, turns([1.0, 1.0, 1.0, 1.0], BLIND))
    assert blind.plain.verdict == "blind"
    said = seeds.said(made, claim, seeds.cells(made, claim, turns([0.8, 0.82, 0.79, 0.81])), 4)
    assert "at least 0.95 as efficient as pt in 0 of 1 cells, FAILS at 0.1 (x 0.805, 4 of 4 seeds below)" in said


def test_of_several_seeds_the_worst_is_shown_with_its_own_figures() -> None:
    wrong, lost = Verdict(Kind.WRONG, "WRONG"), Verdict(Kind.LOSES, "loses to pt: error x 2")
    turns = [
        [row(0.1, "pt", 1.0, seed=1, p=0.5), row(0.1, "cf", 2.0, seed=2, p=0.6, verdict=lost)],
        [row(0.1, "pt", 2.0, seed=2001, p=0.7, verdict=BLIND), row(0.1, "cf", 1.0, seed=2002, p=1e-9, verdict=wrong)],
        [row(0.1, "pt", 3.0, seed=4001, p=0.8), row(0.1, "cf", 9.0, seed=4002, p=0.9, verdict=lost)],
    ]
    plain, cf = seeds.pooled(page(), turns)
    assert (plain.verdict, plain.seed, plain.p, plain.relmse) == (BLIND, 2001, 0.7, 2.0)
    assert (cf.verdict, cf.seed, cf.p, cf.relmse) == (wrong, 2002, 1e-9, 4.0)
    assert dict(zip(*_table([plain, cf]), strict=True))["seed"] == "2002"
    every = [row for turn in turns for row in turn]
    assert verdicts.failures(every) == ["cf at 0.1: WRONG (3 seeds)", "pt at 0.1: " + BLIND.words]
    # One that lost in one seed alone has not lost if its mean error is no larger than the baseline's.
    assert seeds.pooled(page(), [[turns[0][0], turns[0][1]], [turns[2][0], row(0.1, "cf", 1.0)]])[1].verdict == FINE
    assert seeds.pooled(page(), [turns[0], turns[2]])[1].verdict == (Kind.LOSES, "loses to pt: error x 2.8")


def _table(rows: list[Row]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Its columns and its last row."""
    made = show.table("t", page(), rows)
    return made.columns, made.rows[-1]


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


SMALL = """
title: '{title}'
question: '?'
kind: {kind}
room: {{template: box, set: {{light: 0.5}}}}
set: {{forecast.photons: 300, forecast.clusters: 4}}
side: 8
batch_passes: 16
batches: 8
runs: 8
passes: 64
samples: 1000
contenders:
  - {{label: pt, set: {{method: pt}}}}
  - {{label: mixture, set: {{method: iws+cf}}}}
"""
SWEEP = """
sweep: {parameter: scene.light, name: light, values: [0.5, 0]}
baseline: pt
claim: {of: mixture, fixed: [pt]}
truth: {rivals: [{label: rival, set: {method: pt}}]}
"""


def test_a_small_report(tmp_path: Path) -> None:
    """One page of each kind: a chart, a table and a verdict with figures; needs nothing beside itself."""
    files = []
    for kind in ("sweep", "coverage", "until", "long"):
        files.append(tmp_path / f"{kind}.yaml")
        files[-1].write_text(SMALL.format(title=kind, kind=kind) + (SWEEP if kind == "sweep" else ""))
    out = tmp_path / "out"
    docs = tmp_path / "docs.md"
    docs.write_text("above\n<!-- seeds: by scripts/stability --docs -->\nstale\n<!-- end of seeds -->\nbelow\n")
    assert main([*map(str, files), "--out", str(out), "-j", "1", "--seeds", "2", "--docs", str(docs)]) == 0
    html = (out / "report.html").read_text()
    assert html.count("data:image/png") == 4 and not re.search(r'(?:src|href)="(?!data:|#)', html)
    assert "a light needs an area" in html  # the point light is refused, and the cell named
    for kind in ("sweep", "coverage", "until", "long"):
        assert (out / "tables" / f"{kind}.csv").stat().st_size > 0 and (out / "figures" / f"{kind}.png").exists()
    assert (
        "within a factor 1.25 of the true error" in html
        and "Error where runs end over the wanted one" in html
        and "Sum of 1,000 samples" in html
    )
    load_scene(out / "sweep" / "scenes" / "0.yaml")
    assert "Over 2 seeds mixture is at least 0.95 as efficient as pt" in html
    assert (out / "tables" / "sweep-seeds.csv").read_text().splitlines()[1].startswith("0.5,")
    written = docs.read_text()
    assert written.startswith("above\n") and written.endswith("\nbelow\n") and "stale" not in written
    assert (out / "verdicts.md").read_text() in written and "scripts/stability" in written
    rows = [line.split(" | ") for line in written.splitlines() if line.startswith("| `")]
    assert [row[0] for row in rows] == [
        "| `sweep`",
        *(f"| `{kind}`" for kind in ("sweep", "coverage", "until", "long")),
    ]
    assert rows[0][1] == "light 0.5" and {len(row) for row in rows[1:]} == {5}
    assert set(re.findall(r"<td>(\d+)</td></tr>", html)) and "What each page costs" in html


def test_a_document_without_a_place_for_verdicts_is_refused_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    docs = tmp_path / "docs.md"
    docs.write_text("no marks")
    assert main([str(PAGES[0]), "--out", str(tmp_path / "out"), "--docs", str(docs)]) == 2
    told = capsys.readouterr().err
    assert "found no line <!-- verdicts: by scripts/stability --docs -->" in told and told.count("\n") == 1
    assert not (tmp_path / "out").exists()


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


def test_pages_of_one_scene_share_their_rivals(tmp_path: Path) -> None:
    tasks = {loaded.name: _tasks(loaded, tmp_path, 1.0, 1)[-1] for loaded in read_pages(PAGES)}
    assert tasks["bound"].same and tasks["bound"].same == tasks["clusters"].same == tasks["table"].same
    assert len({tasks[name].same for name in ("bound", "photons", "lies", "pm_radius")}) == 4
    assert tasks["ior"].same is None
