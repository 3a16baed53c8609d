"""Metrics and statistics of `compare` against values worked out by hand."""

import math

import numpy as np
import pytest

from causticmpi.compare.metrics import caustic_mask, flip_missing, mean_flip, measure, signed_error, trimmed
from causticmpi.compare.reference import ReferencePicture, few_hits
from causticmpi.compare.statistics import (
    FEW_HITS,
    _moments,
    agreement,
    block_means,
    fewest_hits,
    floor,
    interval,
    jackknife,
    mean_curve,
    slope,
)


def reference(rgb: np.ndarray, variance: float = 0.0, caustic: np.ndarray | None = None) -> ReferencePicture:
    """A reference of constant variance."""
    layer = np.zeros_like(rgb) if caustic is None else caustic
    return ReferencePicture(rgb, layer, np.full_like(rgb, variance), {})


def test_errors_of_a_picture_worked_out_by_hand() -> None:
    truth = np.full((2, 2, 3), 0.2)
    caustic = np.zeros((2, 2, 3))
    caustic[0, 0, 1] = 0.06
    rgb = truth.copy()
    rgb[0, 0] += (0.3, 0.0, 0.0)
    rgb[1, 1] -= 0.1
    known = reference(truth, variance=0.001, caustic=caustic)
    found = measure(rgb, known, caustic_mask(known, 0.05), with_flip=False)
    # Squares: 0.09 in one of twelve values, 0.01 in three; R^2 + 0.01 = 0.05.
    assert found.mse == pytest.approx(0.12 / 12 - 0.001)
    assert found.rmse == pytest.approx(math.sqrt(0.009))
    assert found.relmse == pytest.approx((0.12 / 12 - 0.001) / 0.05)
    assert found.own_mse == pytest.approx(0.001) and found.own_relmse == pytest.approx(0.02)
    assert found.mask_mse == pytest.approx(0.03 - 0.001)
    assert found.mask_relmse == pytest.approx((0.03 - 0.001) / 0.05)
    # Of four pixels the worst is left out, of the mask's only one nothing remains.
    assert found.trimmed_relmse == pytest.approx((0.03 / 9 - 0.001) / 0.05)
    assert math.isnan(found.mask_trimmed_relmse) and math.isnan(found.flip)


def test_mask_takes_the_largest_channel_above_the_level() -> None:
    caustic = np.zeros((1, 3, 3))
    caustic[0, 1] = (0.0, 0.0, 0.05)
    caustic[0, 2] = (0.0, 0.0, 0.0501)
    known = reference(np.ones((1, 3, 3)), caustic=caustic)
    assert caustic_mask(known, 0.05).tolist() == [[False, False, True]]


@pytest.mark.parametrize(("pixels", "dropped"), [(1000, 1), (1001, 2), (2000, 2), (10_000, 10)])
def test_trimming_leaves_out_exactly_the_worst(pixels: int, dropped: int) -> None:
    errors = np.ones(pixels)
    worst = np.random.default_rng(7).choice(pixels, dropped, replace=False)
    errors[worst] = 1e6
    assert trimmed(errors, np.zeros(pixels)) == 1.0
    kept = np.setdiff1d(np.arange(pixels), worst)[0]
    errors[kept] = 5.0
    assert trimmed(errors, np.zeros(pixels)) == pytest.approx(1 + 4 / (pixels - dropped))


def test_signed_error_keeps_the_sign_and_its_scale() -> None:
    truth = np.full((9, 9, 3), 0.2)
    known = reference(truth)
    assert signed_error(truth - 0.05, known, 3) == pytest.approx(-0.05 / math.sqrt(0.05))


def curve(x: list[float] | np.ndarray, errors: list[float] | np.ndarray) -> np.ndarray:
    """(n, 2) of passes and errors."""
    return np.stack([np.asarray(x, float), np.asarray(errors, float)], axis=1)


PASSES = np.array([1, 2, 4, 8, 16, 32, 64, 128])


def test_slope_of_an_exact_power_and_of_its_last_decade_only() -> None:
    assert slope(curve(PASSES, 3.0 / PASSES)) == pytest.approx(-1)
    assert slope(curve(PASSES, 3.0 / np.sqrt(PASSES))) == pytest.approx(-0.5)
    assert slope(curve(PASSES, np.where(PASSES < 12.8, 100.0, 1.0 / PASSES))) == pytest.approx(-1)
    assert slope(curve(PASSES, 1.0 / PASSES + 1.0)) > -0.05  # a floor


def test_slope_is_unknown_from_too_little() -> None:
    assert math.isnan(slope(np.zeros((0, 2))))
    assert math.isnan(slope(curve([10, 20, 40], [1, 0.5, 0.25])))
    assert math.isnan(slope(curve([10, 11, 12, 13], [4, 3, 2, 1])))
    assert math.isnan(slope(curve([10, 20, 40, 80], [1, -0.5, 0.2, 0.1])))


def test_floor_is_what_remains() -> None:
    assert floor(curve(PASSES, 3.0 / PASSES + 0.25)) == pytest.approx(0.25)
    assert floor(curve(PASSES, 3.0 / PASSES)) == pytest.approx(0, abs=1e-12)
    assert math.isnan(floor(curve([1, 2, 3], [3, 2, 1])))


def test_curves_that_end_at_different_passes_have_a_mean() -> None:
    lengths = [np.array([2, 4, 8, 16, 32, 64]) * first for first in (1, 1.3, 1.7)]
    curves = [curve(x, height / x) for x, height in zip(lengths, (1.0, 2.0, 9.0), strict=True)]
    mean = mean_curve(curves)
    assert mean[0, 0] == pytest.approx(3.4) and mean[-1, 0] == pytest.approx(64)
    assert mean[:, 0] * mean[:, 1] == pytest.approx(4.0)
    found = jackknife(curves, slope)
    assert found.mean == pytest.approx(-1) and found.half == pytest.approx(0, abs=1e-9)
    curves[2][:, 1] = 9.0
    assert jackknife(curves, slope).half > 0.1
    assert len(mean_curve([curves[0], curves[0] * (1000, 1)])) == 0


def test_jackknife_of_a_mean_is_its_confidence_interval() -> None:
    heights = [1.0, 2.0, 3.0, 4.0]
    curves = [curve(PASSES, np.full(8, height)) for height in heights]
    found, known = jackknife(curves, lambda mean: float(mean[-1, 1])), interval(heights)
    assert (found.mean, found.half) == (pytest.approx(known.mean), pytest.approx(known.half))


def test_interval_is_students() -> None:
    found = interval([1.0, 2.0, 3.0, 4.0])
    # t(0.975; 3) = 3.18245, standard deviation sqrt(5/3).
    assert found.mean == 2.5 and found.half == pytest.approx(3.18245 * math.sqrt(5 / 3) / 2, rel=1e-5)
    assert math.isnan(interval([1.0]).half) and math.isnan(interval([]).mean)


def test_block_means_with_a_border() -> None:
    picture = np.arange(3 * 5, dtype=float).reshape(3, 5, 1)
    assert block_means(picture, 2).tolist() == [3.0, 5.0, 6.5, 10.5, 12.5, 14.0]


@pytest.mark.statistical
def test_agreement_finds_a_small_difference_and_none_where_there_is_none() -> None:
    random = np.random.default_rng(11)
    a, b = random.normal(5, 1, (16, 200)), random.normal(5, 2, (12, 200))
    assert agreement(a, b).p > 1e-3
    b[:, 17] += 12
    found = agreement(a, b)
    assert found.p < 1e-6 and found.tests == 200
    same = np.ones((4, 3))
    assert agreement(same, same).p == 1.0 and agreement(same, same + 1).p < 1e-12
    assert agreement(same, same + 1).p_above == 1.0 and agreement(same + 1, same).p_above < 1e-12


def test_a_check_too_dark_by_few_hits_judges_no_reference() -> None:
    random = np.random.default_rng(4)
    sure = 1 + 0.001 * random.normal(size=(16, 16 * 3))
    hits = np.repeat(random.poisson(0.05, size=(16, 16)), 3, axis=1)  # all colours of a block at once
    rare = 0.5 + 0.001 * random.normal(size=sure.shape) + 0.5 * hits / 0.05
    found = few_hits(sure, rare), few_hits(rare, sure)
    assert found[0] == found[1] is not None and 3 < found[0] < 40  # 13 are to be expected
    assert few_hits(sure, 0.95 * sure) is None and few_hits(sure, 100 * rare) is None


def test_a_reference_whose_batches_show_no_skew_is_judged_if_many_blocks_share_the_noise() -> None:
    """20 hits in two of 16 blocks are too few to judge what is dark, whether or not the batches happen to be skewed."""
    random = np.random.default_rng(8)
    sure = 1 + 0.001 * random.normal(size=(16, 16 * 3))
    for _ in range(50):
        hits = random.poisson(20 / 2 / 16, size=(16, 2))
        dark = 0.9 * sure
        dark[:, :6] += np.repeat(hits, 3, axis=1) * 0.01
        found = few_hits(sure, dark)
        assert found is not None and found < 100
    assert few_hits(sure, 0.9 * sure) is None


def test_rare_hits_are_counted_where_there_are_few() -> None:
    random = np.random.default_rng(2)
    for count in (5, 50):
        found = fewest_hits(random.poisson(count / 16 / 16, size=(16, 16)) + 0.01 * random.normal(size=(16, 16)))
        assert count / 2 < found < 2 * count
    assert fewest_hits(random.normal(size=(16, 16))) > FEW_HITS and fewest_hits(np.ones((4, 2))) == np.inf


def test_few_values_that_show_no_skew_do_not_stand_for_many_hits() -> None:
    """20 hits in two of 16 squares, which hold nearly all the variance: 16 batches may show no skew, 256 passes do."""
    random = np.random.default_rng(6)
    silent = 0
    for _ in range(50):
        passes = 1 + 0.01 * random.normal(size=(256, 16))
        passes[:, :2] += random.poisson(20 / 2 / 256, size=(256, 2))
        batches = passes.reshape(16, 16, 16).mean(axis=1)
        silent += not _skewed(batches)
        assert fewest_hits(batches) < FEW_HITS
        assert 5 < fewest_hits(passes) < 45 and _skewed(passes)
    assert silent > 10
    even = random.normal(size=(256, 16))
    assert FEW_HITS < fewest_hits(even) < np.inf and not _skewed(even)


def _skewed(values: np.ndarray) -> bool:
    _, third, noise = _moments(values)
    return third > noise


@pytest.mark.skipif(flip_missing() is not None, reason=str(flip_missing()))
def test_flip_is_zero_for_equal_pictures_and_grows_with_the_difference() -> None:
    truth = np.random.default_rng(3).uniform(0, 1, (32, 32, 3))
    near, far = mean_flip(truth + 0.02, truth), mean_flip(truth + 0.3, truth)
    assert mean_flip(truth, truth) == 0 and 0 < near < far <= 1
