"""Defects of a sensor: each kind is found, and ordinary pixels are none at the rate of chance."""

import numpy as np
import pytest
from scipy.special import ndtr

from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.model.maps.defects import MAPS, Defect, Moments, find_defects, needs_moments

N_FRAMES = 2000


def ordinary(n, rng, spread=0.02):
    """Return maps of n pixels that differ by a relative spread: H 2 e-, 10 DN/e-, bias 100 DN, 0.25 e-."""
    maps = {
        name: middle * (1.0 + spread * rng.standard_normal((1, n)))
        for name, middle in zip(MAPS[:4], (2.0, 0.25, 100.0, 0.1), strict=True)
    }
    return maps | {name: np.full((1, n), 0.001) for name in MAPS[4:]}


def moments_of(pixels, samples, top=4095):
    return Moments(
        np.asarray(pixels, np.int64),
        np.full(len(pixels), len(samples)),
        samples.mean(axis=0),
        samples.var(axis=0),
        (samples == top).mean(axis=0),
    )


def found(maps, status=None, moments=None, telegraph_e=None, *, light=True, sigmas=6.0):
    shape = maps["bias"].shape
    status = np.zeros(shape, np.uint16) if status is None else status
    moments = moments_of([], np.empty((N_FRAMES, 0))) if moments is None else moments
    return find_defects(maps, status, moments, telegraph_e, light=light, sigmas=sigmas)


def samples(rng, truth, n, spread=0.02):
    """Return DN (frame, pixel) of n pixels of an exposure and a read noise, e-, of a sensor with a spread."""
    exposure, noise = truth
    gain, bias, noise = (m * (1.0 + spread * rng.standard_normal(n)) for m in (0.1, 100.0, noise))
    signal = rng.poisson(exposure, (N_FRAMES, n)) + noise * rng.standard_normal((N_FRAMES, n))
    return np.clip(np.rint(bias + signal / gain), 0, 4095)


def unfitted(rng, samples):
    """Return maps, words and moments of a sensor whose last pixels have these samples, and no fit."""
    n = samples.shape[1]
    maps, status = ordinary(1000 + n, rng), np.zeros((1, 1000 + n), np.uint16)
    for values in maps.values():
        values[0, 1000:] = np.nan
    status[0, 1000:] = int(FitStatus.GAIN_NOT_IDENTIFIED)
    assert np.flatnonzero(needs_moments(status, maps["conversion_gain"])).tolist() == [*range(1000, 1000 + n)]
    return maps, status, moments_of(range(1000, 1000 + n), samples)


def test_ordinary_pixels_are_hot_or_noisy_at_the_rate_of_chance():
    rng, n = np.random.default_rng(1), 60_000
    maps = ordinary(n, rng)
    for name in ("quanta_exposure", "read_noise_e"):  # a sixth is known to five times the spread
        own = 5.0 * 0.02 * np.median(maps[name])
        maps[name][0, : n // 6] += own * rng.standard_normal(n // 6)
        maps[f"{name}_stderr"][0, : n // 6] = own
    for bit in (Defect.HOT, Defect.NOISY):
        hot = (found(maps, sigmas=3.0).kinds[0] & bit) != 0
        for part, scatter in ((hot[: n // 6], np.hypot(1.0, 0.2)), (hot[n // 6 :], 1.0)):
            expected = part.size * ndtr(-3.0 / scatter)
            # median and MAD move with the sixth that scatters more: by 15 % of the spread at most
            assert part.sum() < expected + 5.0 * np.sqrt(expected)
            assert part.sum() > part.size * ndtr(-3.0 * 1.25) - 5.0 * np.sqrt(expected)
        # by the spread alone a quarter of the sixth would stand out
        assert hot[: n // 6].sum() < 0.01 * n / 6


def test_dead_pixels_are_so_in_light_alone_and_where_their_error_allows_it():
    maps = ordinary(500, np.random.default_rng(2))
    maps["quanta_exposure"][0, :4] = 0.01, 0.01, 1.9, 0.0
    maps["quanta_exposure_stderr"][0, 1] = 0.5
    dead = (found(maps).kinds & Defect.DEAD) != 0
    assert np.flatnonzero(dead).tolist() == [0, 3]
    assert not found(maps, light=False).kinds.any()


@pytest.mark.parametrize(
    ("truth", "kind"),
    [((0.0, 0.25), "dead"), ((30.0, 0.25), "hot"), ((2.0, 2.5), "noisy"), ((2.0, 0.25), "")],
)
def test_pixels_without_a_fit_are_judged_by_their_moments(truth, kind):
    rng = np.random.default_rng(3)
    seen = found(*unfitted(rng, samples(rng, truth, 300)))
    assert seen.counts() == {kind or "not_fitted": 300}
    if kind:
        table = seen.table
        assert set(table["x"]) == {*range(1000, 1300)}
        assert set(table["fit_status"]) == {"gain_not_identified"}
        value, usual = (truth[0], 2.0) if kind != "noisy" else (truth[1], 0.25)
        pull = (table["value"] - value) / table["stderr"]
        # the scatter of gain and bias between pixels is in the error, and that of all is not Gaussian
        assert 0.5 < np.sqrt(np.mean(pull**2)) < 1.3
        assert np.allclose(table["usual"], usual, rtol=0.01)


def test_pixels_judged_by_their_moments_stand_out_at_the_rate_of_chance():
    rng, n = np.random.default_rng(4), 4000
    given = unfitted(rng, samples(rng, (2.0, 0.25), n))
    counts = found(*given, sigmas=2.5).counts()
    expected = (1000 + n) * ndtr(-2.5)
    for kind in ("hot", "noisy"):
        assert counts.get(kind, 0) < expected + 5.0 * np.sqrt(expected)


def test_stuck_and_saturated_pixels():
    rng = np.random.default_rng(5)
    dn = samples(rng, (2.0, 0.25), 5)
    dn[:, 0], dn[:, 1], dn[:1200, 2], dn[:800, 3] = 77, 4095, 4095, 4095
    seen = found(*unfitted(rng, dn))
    assert seen.kinds[0, 1000:1003].tolist() == [Defect.STUCK, Defect.SATURATED, Defect.SATURATED]
    assert not (seen.kinds[0, 1003:] & (Defect.STUCK | Defect.SATURATED)).any()
    rows = [[*row] for row in zip(*seen.table.values(), strict=True)]
    assert rows[0][:6] == [1000, 0, "stuck", 77.0, 0.0, "DN"]
    assert rows[0][6] == pytest.approx(120.0, rel=0.01)
    assert rows[2][2:5] == ["saturated", 0.6, pytest.approx(np.sqrt(0.24 / N_FRAMES))]


def test_what_the_data_leave_open_is_listed_without_a_bit_of_the_mask_and_as_no_majority():
    maps, status = ordinary(100, np.random.default_rng(6)), np.zeros((1, 100), np.uint16)
    words = [FitStatus.EXCLUDED, FitStatus.BIAS_AMBIGUOUS, FitStatus.NOT_CONVERGED, FitStatus.NOT_FITTED]
    status[0, :4] = [int(word) for word in words]
    telegraph_e = np.full((1, 100), np.nan)
    telegraph_e[0, 9] = 1.3
    for values in maps.values():
        values[0, [0, 2, 3]] = np.nan
    seen = found(maps, status, telegraph_e=telegraph_e)
    assert seen.counts() == {"excluded": 1, "telegraph": 1, "not_fitted": 1, "flagged": 1}
    assert seen.table["fit_status"].tolist() == ["excluded", "ok", "not_converged", "bias_ambiguous"]
    assert seen.table["x"].tolist() == [0, 9, 2, 1]
    assert seen.table["value"][1] == 1.3
    assert np.flatnonzero(seen.mask).tolist() == [0, 9]
    status[0, 10:70] = int(FitStatus.WEAKLY_IDENTIFIED)
    assert "flagged" not in found(maps, status).counts()


def test_of_few_pixels_none_is_compared():
    for n, counts in ((20, {}), (40, {"hot": 1})):
        maps = ordinary(n, np.random.default_rng(7))
        maps["quanta_exposure"][0, 0] = 100.0
        assert found(maps).counts() == counts
