"""Electron numbers: the tables against plain sums over k and codes."""

import numpy as np
import pytest
from helpers.plain_law import joint_mass
from scipy.stats import norm, poisson

from pchem_pipeline.model.electrons.electrons import (
    LARGEST_NUMBER,
    NO_NUMBER,
    KnownPixels,
    compare_electron_numbers,
    errors_of_numbers,
    number_tables,
)
from pchem_pipeline.model.law.parameters import UsablePixels
from pchem_pipeline.model.law.pcd import thresholds
from pchem_pipeline.model.law.sample_law import SampleLaw

CASES = [
    (0.05, 0.1, 100.0, 3.0),
    (1.8, 0.1, 100.0, 3.3),
    (8.0, 0.07, 512.4, 6.0),
    (40.0, 0.12, 64.2, 2.5),
    (2.0, 0.1, 100.0, 12.0),  # s_e = 1.2: cells far from the centres
]


def known(*columns):
    return KnownPixels(columns, SampleLaw())


def converted(frames, pixels):
    ends = frames.min(axis=0), frames.max(axis=0)
    return number_tables(*ends, pixels.exposure, pixels).convert(frames).number


@pytest.mark.parametrize("case", CASES)
def test_thresholds_are_where_the_largest_membership_changes(case):
    h, g, mu, sigma = case
    x, k = np.linspace(mu - 4 / g, mu + 60 / g, 4001), np.arange(400)
    table = thresholds(h, g, mu, sigma, 399)
    assert np.all(np.diff(table) > 0)
    membership = poisson.logpmf(k, h) + norm.logpdf(x[:, None], mu + k / g, sigma)  # eq. gamma_nk
    np.testing.assert_array_equal(np.searchsorted(table, x), membership.argmax(axis=1))


@pytest.mark.parametrize(
    ("pixel", "dn", "numbers"),
    [
        ((2.0, 0.1, 100.0, 3.0), [130], [3]),
        ((2.0, np.nan, 100.0, 3.0), [130], [NO_NUMBER]),
        ((np.inf, 0.1, 100.0, 3.0), [130], [NO_NUMBER]),
        ((0.0, 0.1, 50.0, 3.0), [100, 5000], [0, 0]),
        ((1000.0, 2.0, 50.0, 0.1), [65535], [LARGEST_NUMBER]),
        ((1.0, 0.125, 101.0, 3.0), [105, 106], [0, 1]),  # 105 is half-way at H = 1: the smaller number
    ],
)
def test_numbers_of_odd_pixels_and_samples(pixel, dn, numbers):
    maps = [np.full((1, 1), value) for value in pixel]
    found = converted(np.array(dn, np.uint16)[:, None, None], known(*maps))
    np.testing.assert_array_equal(found.ravel(), numbers)


def test_codes_beyond_the_table_have_no_number():
    one = np.ones((1, 1))
    low, high = np.full((2, 1, 1), [[[90]], [[130]]])
    pixels = known(2 * one, 0.1 * one, 100 * one, 3 * one)
    tables = number_tables(low, high, pixels.exposure, pixels)
    frames = np.array([89, 90, 130, 131], np.uint16)[:, None, None]
    np.testing.assert_array_equal(tables.convert(frames).number.ravel(), [NO_NUMBER, 0, 3, NO_NUMBER])


def test_histograms_and_frames_give_the_same_numbers():
    rng = np.random.default_rng(7)
    frames = rng.integers(60, 250, size=(300, 1, 5)).astype(np.uint16)
    rows = np.array(CASES).T[:, None, :]
    numbers = converted(frames, known(*rows))
    pixels = known(*rows[:, 0])
    counts = np.stack([np.bincount(frames[:, 0, x] - 60, minlength=200) for x in range(5)])
    origin = np.full(5, 60)
    codes = pixels.codes(counts, origin)
    assert (codes[0] <= frames.min(axis=0)[0]).all()
    assert (codes[1] >= frames.max(axis=0)[0]).all()
    found, beyond = number_tables(*codes, pixels.exposure, pixels).tally(counts, origin, 12)
    everything = np.bincount(numbers.ravel(), minlength=12)
    np.testing.assert_array_equal(found, everything[:12])
    assert beyond == everything[12:].sum()


def test_errors_and_what_tables_expect_are_those_of_all_integers():
    truth = np.array(CASES).T.copy()
    other = truth * np.array([1.1, 1.02, 1.0, 0.9])[:, None] + np.array([0, 0, 0.7, 0])[:, None]
    errors, total = np.empty((2, len(CASES))), np.zeros(60)
    for i, (true, guess) in enumerate(zip(truth.T, other.T, strict=True)):
        x = np.arange(int(true[2]) - 150, int(true[2]) + 1500)
        joint = joint_mass(x, *true, n_k=200)
        best, number = joint.argmax(axis=0), joint_mass(x, *guess, n_k=200).argmax(axis=0)
        errors[:, i] = [1.0 - joint[each, np.arange(x.size)].sum() for each in (best, number)]
        total += np.bincount(best, weights=joint.sum(axis=0), minlength=60)[:60]
    for used, expected in zip((truth, other), errors, strict=True):
        found = errors_of_numbers(UsablePixels(*used), UsablePixels(*truth))
        np.testing.assert_allclose(found, expected, atol=1e-11)
    data = known(*truth)
    estimated, error = number_tables(*data.codes(), data.exposure, data, detailed=True).outcomes(60)
    np.testing.assert_allclose(estimated, total, atol=1e-11)
    np.testing.assert_allclose(error, errors[0], atol=1e-11)


def test_numbers_are_decided_with_the_effects_of_the_law():
    # side peaks of half of the weight at 0.5 e- above, and an exposure added to half of the frames
    h, g, mu, sigma = 0.8, 0.1, 100.0, 1.2
    law = SampleLaw().with_noise([0.5, 0.5], shift_e=[0.0, 0.5])
    law = law.with_added_exposure([[0.0, 1.5]], [[0.5, 0.5]])
    x = np.arange(92, 300)
    joint = sum(
        0.25 * joint_mass(x - 5 * side, lam, g, mu, sigma, 40) for side in (0, 1) for lam in (h, h + 1.5)
    )
    columns = [np.array([v]) for v in (h, g, mu, sigma)]
    pixels = KnownPixels(columns, law)
    tables = number_tables(x[:1], x[-1:], pixels.exposure, pixels, detailed=True)
    np.testing.assert_array_equal(tables.number, joint.argmax(axis=0))
    np.testing.assert_allclose(tables.mass, joint.sum(axis=0), rtol=1e-6, atol=1e-16)
    np.testing.assert_allclose(tables.right, joint.max(axis=0), rtol=1e-6, atol=1e-16)
    mean = (np.arange(40)[:, None] * joint).sum(axis=0) / joint.sum(axis=0)
    np.testing.assert_allclose(tables.expected, mean, rtol=1e-6, atol=1e-12)
    _, error = number_tables(*pixels.codes(), pixels.exposure, pixels, detailed=True).outcomes(10)
    assert error[0] == pytest.approx(1.0 - joint.max(axis=0).sum(), abs=1e-10)
    # the numbers of the PCD alone are wrong more often in these data
    plain = known(*columns)
    others = number_tables(x[:1], x[-1:], plain.exposure, plain).number
    wrong = 1.0 - joint[others, np.arange(x.size)].sum()
    assert wrong > error[0] + 0.02


def test_comparison_with_the_truth():
    estimated = np.array([[3, 5, NO_NUMBER], [0, 9, 2]], dtype=np.uint16)
    true = np.array([[3, 6, 4], [0, 1, 2]], dtype=np.uint16)
    by_size, signed = compare_electron_numbers(estimated, true, 3)
    np.testing.assert_array_equal(by_size, [3, 1, 1])
    assert signed == 7
