"""Differences of runs: value by value, and in standard errors with limits from theory."""

import numpy as np
import pytest
from helpers.drawn_pixels import codes, histograms

from pchem_pipeline.model.checks.run_differences import (
    BlockDifference,
    common_fit_p,
    compare_blocks,
    compare_maps,
    reasons_of_change,
)
from pchem_pipeline.model.fit.api import fit_histograms

SHAPE = (100, 100)
N = 10_000
GOOD = np.ones(SHAPE, dtype=bool)


def test_integers_are_equal_or_not():
    a, b = np.array([[[0, 5], [7, 65535]], [[1, 5], [7, 0]]], dtype=np.uint16)
    assert compare_blocks(a, a, scale=1, tolerance=0.5) == BlockDifference(4, 0, 0, 0.0)
    # unsigned differences do not wrap round
    assert compare_blocks(a, b, scale=65535, tolerance=0.5) == BlockDifference(4, 2, 2, 65535.0)
    assert compare_blocks(a, b.astype(np.int64), scale=1, tolerance=0).n_beyond == 2


def test_floats_are_equal_within_rounding_of_the_largest_and_come_or_go_beyond_it():
    a = np.array([1.0, 100.0, np.nan, np.inf, 0.0])
    b = np.array([1.0 + 5e-11, 100.0, np.nan, np.inf, -0.0])
    found = compare_blocks(a, b, scale=100, tolerance=1e-12)
    assert (found.n_beyond, found.n_different) == (0, 1)
    found = compare_blocks(a, b, scale=100, tolerance=1e-13)
    assert (found.n_beyond, found.largest) == (1, pytest.approx(5e-11, rel=1e-3))
    came = np.array([np.nan, 1.0, np.inf, np.inf]), np.array([1.0, np.nan, 1.0, -np.inf])
    assert compare_blocks(*came, scale=1e9, tolerance=0.1).n_beyond == 4


def test_blocks_add_up():
    rng = np.random.default_rng(1)
    a = rng.normal(size=(60, 7))
    b = a + rng.normal(size=a.shape) * (rng.random(a.shape) < 0.2)
    whole = compare_blocks(a, b, scale=3, tolerance=1e-12)
    parts = BlockDifference(0, 0, 0, 0.0)
    for start in range(0, 60, 11):
        parts += compare_blocks(a[start : start + 11], b[start : start + 11], scale=3, tolerance=1e-12)
    assert parts == whole
    assert 0 < whole.n_beyond == int((a != b).sum())


def compared(one, other, good=GOOD, *, same_data=False, limit=None):
    return compare_maps([("bias", one, other)], good, same_data=same_data, limits={"bias": limit})["bias"]


def two_captures(seed, *, shift=0.0, scatter=1.0):
    """Two measurements of one map, shift in standard errors of a difference."""
    rng = np.random.default_rng(seed)
    true, error = rng.normal(100, 5, SHAPE), rng.uniform(0.5, 2.0, SHAPE)
    one = true + error * rng.standard_normal(SHAPE)
    other = true + scatter * error * rng.standard_normal(SHAPE) + shift * np.sqrt(2) * error
    return (one, error), (other, error)


def test_captures_of_one_sensor_agree_and_a_shift_scatter_or_jumps_are_seen():
    found = compared(*two_captures(2))
    assert abs(found.median_z) < 5 * np.sqrt(np.pi / (2 * N))
    assert abs(found.spread_z - 1) < 5 * 1.166 / np.sqrt(N)
    assert not reasons_of_change(found)
    found = compared(*two_captures(3, shift=0.3))
    # 0.3 errors are 24 standard errors of the median of 10,000 pixels: the test can fail
    assert found.median_z / np.sqrt(np.pi / (2 * N)) > 20
    reasons = reasons_of_change(found)
    assert (reasons.shifted, reasons.spread, reasons.pixels) == (True, False, False)
    assert found.median / found.median_stderr > 10
    assert reasons_of_change(compared(*two_captures(4, scatter=2.5))).spread
    one, (jumped, error) = two_captures(5)
    jumped[:2, :30] += 50 * error[:2, :30]
    found = compared(one, (jumped, error))
    assert 60 <= found.n_changed <= 62
    assert found.changed[:2, :30].all()
    assert found.p_value < 1e-9
    reasons = reasons_of_change(found)
    assert (reasons.shifted, reasons.spread, reasons.pixels) == (False, False, True)
    # pixels without a good fit do not count
    bad = GOOD.copy()
    bad[:2, :30] = False
    assert not reasons_of_change(compared(one, (jumped, error), bad))


def six_maps(seed, shape):
    """Two captures of six maps, with errors of 1."""
    rng = np.random.default_rng(seed)
    return [(name, *((rng.standard_normal(shape), np.ones(shape)) for _ in range(2))) for name in "abcdef"]


def test_ten_pixels_of_five_errors_are_a_change():
    """Fewer pixels than a count beyond five errors would need, in a sensor of 24 x 24."""
    maps, good = six_maps(7, (24, 24)), np.ones((24, 24), bool)
    same = compare_maps(maps, good, same_data=False)
    assert not any(found.n_changed or reasons_of_change(found) for found in same.values())
    maps[1][2][0].flat[:160:16] += 6.0 * np.sqrt(2.0)
    found = compare_maps(maps, good, same_data=False)
    assert reasons_of_change(found["b"]).pixels
    assert 7 <= found["b"].n_changed <= 11
    assert not any(reasons_of_change(found[name]) for name in "acdef")


def test_a_map_that_changed_throughout_lets_no_pixel_of_another_through():
    """In one company with 6,000 certain pixels, one in a hundred of the others could be chance: some 60."""
    maps = six_maps(8, SHAPE)
    maps[0][2][0][:] += 9.0 * np.sqrt(2.0)
    found = compare_maps(maps, GOOD, same_data=False)
    assert found["a"].n_changed > 0.99 * N
    assert not any(reasons_of_change(found[name]) for name in "bcdef")


@pytest.mark.parametrize("limit", [2.0, "2%"])
def test_a_median_counts_where_it_is_significantly_beyond_its_limit(limit):
    """Values of 100, errors of the difference of sqrt(2): that of the median of 10,000 is 0.018."""
    error = np.ones(SHAPE)

    def moved_by(change, seed):
        rng = np.random.default_rng(seed)
        one = 100.0 + rng.standard_normal(SHAPE)
        other = 100.0 + change + rng.standard_normal(SHAPE)
        return compared((one, error), (other, error), limit=limit)

    standard_error = np.sqrt(2.0 * np.pi / (2 * N))
    for side in (-1.0, 1.0):
        assert not any(reasons_of_change(moved_by(side * 2.0, seed)).shifted for seed in range(5))
        assert reasons_of_change(moved_by(side * (2.0 + 8.0 * standard_error), 3)).shifted
    # at the limit the statistic is a standard normal number; half of them are above 0
    z = np.array([moved_by(2.0, seed).beyond_z for seed in range(100, 120)]) / np.sqrt(np.pi / (2 * N))
    assert abs(z.mean()) < 5 / np.sqrt(z.size) + 0.02
    assert 0.4 < z.std() < 1.6
    # a pixel counts beyond its limit, too
    assert moved_by(1.5, 4).n_changed == 0
    jumped = 100.0 + np.random.default_rng(9).standard_normal(SHAPE)
    jumped[0, :10] += 2.0 + 8.0 * np.sqrt(2.0)
    found = compared((np.full(SHAPE, 100.0), error), (jumped, error), limit=limit)
    assert 9 <= found.n_changed <= 11
    assert found.limit == pytest.approx(2.0)


@pytest.mark.parametrize("limit", [None, 2.0])
def test_a_column_that_moved_against_the_others_is_named(limit):
    """Its median of 100 differences has a standard error of 0.18, a tenth added for those of the fits."""
    error = np.ones(SHAPE)
    column_7 = np.arange(SHAPE[1]) == 7
    one, other = 100.0 + np.random.default_rng(5).standard_normal((2, *SHAPE))
    least = (limit or 0.0) + 5.0 * 1.1 * np.sqrt(2.0 * np.pi / (2 * SHAPE[0]))
    found = {
        change: reasons_of_change(compared((one, error), (other + change * column_7, error), limit=limit))
        for change in (0.0, least - 1.0, least + 1.0)
    }
    assert [list(why.lines) for why in found.values()] == [[], [], ["column 7"]]
    moved, stderr = found[least + 1.0].lines["column 7"]
    assert stderr == pytest.approx(np.sqrt(2.0 * np.pi / (2 * SHAPE[0])))
    assert abs(moved - (least + 1.0)) < 5.0 * stderr
    # the whole sensor is no column, and odd pixels are none
    everywhere = reasons_of_change(compared((one, error), (other + 3.0, error), limit=limit))
    assert (everywhere.shifted, everywhere.lines) == (True, {})
    other[:20, 3] += 100.0
    assert reasons_of_change(compared((one, error), (other, error), limit=limit)).lines == {}


def test_unchanged_nights_alarm_at_the_stated_rate():
    """Ten nights against the first and against the one before, in sets of six maps: 8 histories."""
    rng = np.random.default_rng(10)
    error, good, alarms = np.ones((20, 20)), np.ones((20, 20), bool), []
    pairs = {(earlier, tonight) for tonight in range(1, 11) for earlier in (0, tonight - 1)}
    for nights in rng.standard_normal((8, 11, 6, 20, 20)):
        for earlier, tonight in pairs:
            both = zip("abcdef", nights[earlier], nights[tonight], strict=True)
            maps = [(name, (one, error), (other, error)) for name, one, other in both]
            found = compare_maps(maps, good, same_data=False, rate=0.05)
            alarms.append(any(reasons_of_change(each) for each in found.values()))
    assert len(alarms) == 8 * 19
    assert np.mean(alarms) <= 0.05


def test_missing_values_do_not_count_and_the_unit_follows_the_data():
    (one, error), (other, _) = two_captures(6)
    lost, came = one.copy(), other.copy()
    lost[0, :3], came[0, 2:7] = np.nan, np.nan
    found = compared((lost, error), (came, error))
    assert found.n_counted == N - 7
    np.testing.assert_allclose(found.z[5], (other - one)[5] / (np.sqrt(2) * error[5]), rtol=1e-12)
    same = compared((one, error), (other, error), same_data=True)
    np.testing.assert_allclose(same.z, (other - one) / error, rtol=1e-12)
    empty = np.full(SHAPE, np.nan), np.full(SHAPE, np.nan)
    found = compared(empty, empty)
    assert (found.n_counted, bool(reasons_of_change(found))) == (0, False)


def test_a_pixel_whose_likelihood_is_not_quadratic_is_no_change():
    """Read noise of 0.4 e-, 500 frames: some 1 in 1,000 pixels are 5 of their standard errors off."""
    rng = np.random.default_rng(1)
    runs = [histograms(codes(rng, (400, 500), h, 11.0, 0.4, bias=100.0)) for h in (0.5, 0.5, 0.65)]
    same, brighter = (common_fit_p((0, 4095), *zip(runs[0], run, strict=True)) for run in runs[1:])
    # p-values of equal pixels are uniform, or larger where the likelihood is flat
    assert (same < 0.05).sum() <= 40
    assert same.min() > 1e-4
    assert np.median(brighter) < 0.05
    # such a pixel stands out in units of its standard errors, and the common fit says that nothing changed
    shape = (20, 20)
    values, error = rng.standard_normal(shape), np.ones(shape)
    off = values.copy()
    off[3, 4] += 12.0
    maps, good = [("bias", (values, error), (off, error))], np.ones(shape, bool)
    assert compare_maps(maps, good, same_data=False)["bias"].n_changed == 1
    confirm = lambda y, x: same[y * 20 + x]  # noqa: E731
    found = compare_maps(maps, good, same_data=False, confirm=confirm)["bias"]
    assert found.n_changed == 0
    assert not reasons_of_change(found)


def test_the_bias_of_the_estimates_in_runs_of_unlike_length_is_no_change():
    """The read noise of one sensor, from 500 and from 2,000 frames: biased by some 3 standard errors / N."""
    rng = np.random.default_rng(12)
    runs = []
    for frames in (500, 2000):
        parts = [fit_histograms(*histograms(codes(rng, (N // 5, frames), 2.0, 8.0, 0.29))) for _ in range(5)]
        noise = [np.concatenate([each.read_noise_dn for each in parts])]
        noise.append(np.sqrt(np.concatenate([each.covariance[:, 3, 3] for each in parts])))
        runs.append(tuple(values.reshape(SHAPE) for values in noise))
    found = compared(*runs)
    assert found.median_z == pytest.approx(3.0 * (1 / 500 - 1 / 2000) / np.sqrt(1 / 500 + 1 / 2000), abs=0.05)
    assert reasons_of_change(found).shifted  # as in runs of one length
    assert not reasons_of_change(found, (500, 2000))
    assert reasons_of_change(compared(*two_captures(3, shift=0.3)), (500, 2000)).shifted


def test_pixels_that_are_flagged_in_one_run_only_are_no_change():
    """Good in the short run are the 40 % of the lowest values: their mean is ``phi(0.25) / 0.4`` off."""
    rng = np.random.default_rng(7)
    true = rng.normal(100, 5, SHAPE)
    one, other = (true + e * rng.standard_normal(SHAPE) for e in (1.0, 0.5))
    good = one - true < -0.2533  # 40 % of N(0, 1)
    found = compared((one, np.ones(SHAPE)), (other, np.full(SHAPE, 0.5)), good)
    assert 0.75 < found.median_z < 0.9659 * 0.8**0.5  # between median and mean
    assert reasons_of_change(found, (1000, 4000)).shifted
    assert not reasons_of_change(found, (1000, 4000), (good.mean(), 1.0)).shifted
    assert not reasons_of_change(compared(*two_captures(2)), kept=(0.4, 0.4)).shifted
    assert reasons_of_change(compared(*two_captures(3, shift=0.3)), kept=(0.4, 0.4)).shifted
