"""Verdicts of the stability laboratory: judgements follow from figures, and failing cells are named."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from stability_tools import BATCHES, BLIND, PASSES, measured, measured_passes, page, row

from causticmpi.compare.statistics import FEW_HITS
from causticmpi.stability import seeds, show, sweep, verdicts
from causticmpi.stability.cell import Measured
from causticmpi.stability.judge import expected_hits, judge
from causticmpi.stability.records import Claim, Page
from causticmpi.stability.row import FINE, Kind, Row, Verdict


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


@pytest.mark.parametrize(("hits", "kind"), [(1, Kind.FINE), (0, Kind.WRONG)])
def test_a_square_without_its_rare_hits_is_measured_again_and_a_biased_one_stays_wrong(hits: float, kind: Kind) -> None:
    """As of two tables far from their best settings: no hit in 256 passes tells of those that a dark corner lacks, and
    squares where the lamp itself is seen have nearly all the variance, without skew. So the first pictures are one."""
    rival = measured("rival", "iws+cf", noise=1e-3, seed=9)
    made = page(contenders=[{"label": "cf", "set": {"method": "iws+cf"}}], baseline=None)

    def found(passes: int, seed: int) -> Measured:
        random = np.random.default_rng(seed)
        pictures = 1 + 0.01 * random.normal(size=(passes, 8, 8, 3))
        pictures[:, :2, 2:6] += random.normal(size=(passes, 2, 4, 3))
        pictures[:, :2, 6:] *= 0.9 + 0.1 * PASSES * random.poisson(hits / PASSES, size=(passes, 1, 1, 1))
        return measured_passes("cf", "iws+cf", pictures)

    def again(key: sweep.CellKey) -> Measured:
        assert key == sweep.CellKey(0, 0, "cf")
        return found(8 * PASSES, 102)

    points = [sweep.Point(0, [found(PASSES, 2)], [], {})]
    assert points[0].found[0].hits > FEW_HITS and sweep.all_rows(made, points, [rival])[0].kind is Kind.WRONG
    ((row,),) = sweep.settled_rows(made, [points], [rival], again)
    assert row.kind is kind and row.again
    assert "wrong at first, so measured again: cf at 1" in verdicts.unbiasedness([row])


def test_no_one_is_too_bright_beside_a_blind_rival() -> None:
    dark = replace(lit_by_hits(5, mean=0.5), label="rival")
    (row,) = judge(page(), 1.0, 1.0, [measured("cf", "iws+cf", 100.0)], [dark], 0.1)
    assert row.verdict.words.startswith("not tested: rival has too few hits") and not row.tested
    (row,) = judge(page(), 1.0, 1.0, [measured("cf", "iws+cf", 100.0)], [dark, measured("seer", "iws+cf", seed=9)], 0.1)
    assert row.kind is Kind.WRONG and row.against == "seer"


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


def test_blind_cells_are_named_and_not_counted_as_tested() -> None:
    rows = [row(1.0, "pt", 1.0), row(1.0, "cf", 1.0), row(0.1, "pt", 1.0, verdict=BLIND)]
    said = verdicts.unbiasedness(rows)
    assert "in 2 of 2 tested cells" in said and "too few hits to judge: pt at 0.1." in said and "WRONG" not in said


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
    assert good.base.verdict == "holds" == good.best.verdict and good.best.over == "two" and good.base.below == 0
    assert good.base.low < good.base.mean < good.base.high and good.base.least == pytest.approx(0.99)
    (bad,) = seeds.cells(made, claim, turns([0.8, 0.82, 0.79, 0.81]))
    assert bad.base.verdict == "FAILS" == bad.best.verdict and bad.base.below == 4
    (unsure,) = seeds.cells(made, claim, turns([0.5, 1.5, 1.0, 1.2]))
    assert unsure.base.verdict == "open" and unsure.base.below == 1
    (blind,) = seeds.cells(made, claim, turns([1.0, 1.0, 1.0, 1.0], BLIND))
    assert blind.base.verdict == "blind"
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
