"""What a fit can be told goes together: laws, likelihoods, errors, intervals, tail guard, several exposures.

Each pair on pixels drawn from the law itself: pulls of mean 0 and width 1, intervals that cover as they say.
Limits are five standard errors of those figures; a fit without the law misses them.
"""

from functools import partial
from itertools import combinations

import numpy as np
import pytest
from iminuit import Minuit

from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.law.mass import sample_mass
from pchem_pipeline.model.law.sample_law import SampleLaw

N, FIRST, N_CODES, FRAMES = 240, 40, 330, 3000
LAW = SampleLaw().with_variance(per_electron=0.02).with_levels(curvature=0.006)
PAIRS = list(combinations(("law", "exact", "sandwich", "profile", "guard", "warm", "series"), 2))
FACTORS = (1.0, 2.5)


def truth(rng):
    return rng.uniform((1.0, 1 / 13, 98.0, 2.6), (2.5, 1 / 9, 102.0, 3.4), (N, 4))


def draw(rng, law, at, factor):
    scaled = at * [factor, 1, 1, 1]
    mass = np.maximum(sample_mass(law, list(scaled.T), np.arange(FIRST, FIRST + N_CODES)), 0)
    return rng.multinomial(FRAMES, mass / mass.sum(axis=1, keepdims=True)).astype(np.uint32)


def fitted(told, seed=5):
    """Draw pixels, and fit them as told; return also the true (H_1 ... g, mu, sigma)."""
    rng = np.random.default_rng(seed)
    at = truth(rng)
    law = LAW if "law" in told else SampleLaw()
    factors = FACTORS if "series" in told else FACTORS[:1]
    counts = [draw(rng, law, at, factor) for factor in factors]
    if "guard" in told:
        for sample in counts:
            sample[:, -20] += 2  # far out, of 3000
    settings = FitSettings(
        likelihood="exact" if "exact" in told else "density",
        errors="sandwich" if "sandwich" in told else "information",
        intervals="profile" if "profile" in told else "normal",
        tail_guard=1e-3 if "guard" in told else 0.0,
    )
    origins = [np.full(N, FIRST)] * len(counts)
    whole = np.stack([*(at[:, 0] * factor for factor in factors), *at[:, 1:].T], axis=1)
    laws, start = [law] * len(counts) if "law" in told else None, whole if "warm" in told else None
    if laws and start is None:
        start = fit_histograms(counts, origins, settings=FitSettings(tail_guard=settings.tail_guard))
    return fit_histograms(counts, origins, settings=settings, law=laws, start=start), whole


@pytest.mark.parametrize("told", PAIRS, ids="-".join)
def test_each_pair_has_the_right_pulls_and_covers_the_truth(told):
    found, whole = fitted(told)
    good = found.fit_status == 0
    assert good.mean() > 0.97
    errors = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    pulls = ((found.columns - whole) / errors)[good]
    n = good.sum()
    # beside chance: second order in 1/sqrt(frames), of the pulls of mu and H
    assert (np.abs(pulls.mean(axis=0)) < 5 / np.sqrt(n) + 0.06).all()
    assert (np.abs(pulls.std(axis=0) - 1) < 5 / np.sqrt(2 * n) + 0.02).all()
    if "profile" in told:
        low, high = np.moveaxis(found.intervals[good, :-1], 2, 0)
        inside = (low <= whole[good]) & (whole[good] <= high)
        np.testing.assert_allclose(inside.mean(axis=0), 0.6827, atol=5 * np.sqrt(0.22 / n))
    if "guard" in told:
        share = 2 * len(FACTORS if "series" in told else [1]) / (FRAMES + 2)
        np.testing.assert_allclose(np.median(found.outlier_share), share, rtol=0.6)


def minus(law, samples, aside, *at):
    """Minus the log-likelihood of a pixel's samples given that a code is not set aside."""
    value = 0.0
    *exposures, gain, bias, sigma = at
    for counts, exposure in zip(samples, exposures, strict=True):
        columns = [np.array([v]) for v in (exposure, gain, bias, sigma)]
        mass = np.maximum(sample_mass(law, columns, np.arange(FIRST, FIRST + N_CODES))[0], 1e-300)
        mass = np.where(aside, 0.0, mass) / mass[~aside].sum()
        seen = (counts > 0) & ~aside
        value -= float(counts[seen] @ np.log(mass[seen]))
    return value


@pytest.mark.parametrize("case", ["series-law", "law-excluding"])
def test_iminuit_finds_the_same_maximum_errors_and_intervals(case):
    rng = np.random.default_rng(9)
    at = truth(rng)[:2]
    factors = FACTORS if case == "series-law" else FACTORS[:1]
    counts = [draw(rng, LAW, at, factor)[:2] for factor in factors]
    origins = [np.full(2, FIRST)] * len(counts)
    settings = FitSettings(intervals="profile", tail_guard=0.0)
    plain = fit_histograms(counts, origins, settings=FitSettings(tail_guard=0.0))
    excluding = [(1.6, 2.4)] if case == "law-excluding" else []
    found = fit_histograms(
        counts, origins, law=[LAW] * len(counts), settings=settings, start=plain, excluding=excluding
    )
    for pixel in range(2):
        place = (np.arange(FIRST, FIRST + N_CODES) - plain.bias[pixel]) * plain.conversion_gain[pixel]
        aside = (place >= 1.6) & (place < 2.4) & bool(excluding)
        cost = partial(minus, LAW, [sample[pixel] for sample in counts], aside)
        mine = found.columns[pixel]
        names = [f"h{j}" for j in range(len(counts))] + ["g", "mu", "sigma"]
        other = Minuit(cost, *(mine * 1.003), name=names)
        other.errordef = Minuit.LIKELIHOOD
        other.tol = 1e-3
        other.migrad()
        other.hesse()
        errors = np.sqrt(np.diagonal(found.covariance[pixel]))
        assert (np.abs(mine - np.array(other.values)) < 0.01 * errors).all()
        np.testing.assert_allclose(errors, np.array(other.errors), rtol=0.02)
        assert found.log_likelihood[pixel] == pytest.approx(-float(other.fval or 0.0), abs=1e-3)
        other.minos("g", cl=0.6827)
        ends = found.intervals[pixel, len(counts)] - mine[len(counts)]
        minos = other.merrors["g"]
        np.testing.assert_allclose(ends, (minos.lower, minos.upper), atol=0.02 * errors[len(counts)])
