"""The study of numbers that are called good: its judge is right, and finds what is wrong."""

import json
import sys

import numpy as np
import pytest
from helpers.places import ROOT
from scipy.stats import norm, poisson

sys.path.append(str(ROOT / "scripts" / "validation"))

import trust_pixels
import trust_runs
import trust_study

TRUTH = np.array([0.4, 0.1, 1002.3, np.hypot(1.5, 12**-0.5)])  # H, g, mu, sigma: 10 DN per electron, 0.15 e-
ALL = np.ones(4, bool)


def pixel(clipped=""):
    rng, truth = np.random.default_rng(7), TRUTH.copy()
    if clipped:
        truth[2] = 1.5
    samples = np.rint(10 * (rng.poisson(truth[0], 1500) + 0.15 * rng.normal(size=1500)) + truth[2]).astype(
        int
    )
    return trust_pixels.Pixel(0, samples.clip(0) if clipped else samples, truth, clipped)


@pytest.mark.parametrize("clipped", ["", "low"])
def test_the_judges_likelihood_is_the_mass_of_the_codes(clipped):
    one = pixel(clipped)
    h, g, mu, sigma = one.truth * [1.1, 0.9, 1.0, 1.2]
    k, s = np.arange(30), np.sqrt(sigma**2 - 1 / 12)
    low = np.where(one.samples == 0, -np.inf, one.samples - 0.5) if clipped else one.samples - 0.5
    high = one.samples + 0.5
    cells = np.subtract(*(norm.cdf((each[:, None] - mu - k / g) / s) for each in (high, low)))
    expected = np.log(cells @ poisson.pmf(k, h)).sum()
    judge, theta = trust_pixels.Judge(one), trust_pixels._theta(np.array([h, g, mu, sigma]))
    height, scores = judge.scores(theta[None])
    assert height[0] == pytest.approx(expected, rel=1e-9)
    step = 1e-5 * np.eye(4)
    up, down = judge.scores(theta + step)[0], judge.scores(theta - step)[0]
    assert scores[0].T @ judge.counts == pytest.approx((up - down) / 2e-5, rel=1e-4, abs=1e-3)


def test_a_gain_twice_too_large_is_wrong_and_the_truth_is_right():
    one = pixel()
    stderr = one.truth * [0.05, 0.005, 0.0001, 0.03]
    assert trust_pixels.judge(one, one.truth, stderr, ALL).kind == ""
    verdict = trust_pixels.judge(one, one.truth * [2, 2, 1, 1], stderr, ALL)
    assert verdict.kind == "off"
    assert verdict.best > 100
    assert "conversion_gain" in verdict.beyond
    assert verdict.at == pytest.approx(one.truth, rel=0.1)
    # what is flagged does not count
    assert trust_pixels.judge(one, one.truth * [2, 1, 1, 1], stderr, ALL).beyond == ["quanta_exposure"]
    assert trust_pixels.judge(one, one.truth * [2, 1, 1, 1], stderr, ~ALL).kind == ""


def test_pixels_are_drawn_again_by_their_number_and_counted_in_tables():
    rows = trust_study.study_pixels(8, seed=3)
    again = trust_pixels.draw(rows[5]["number"])
    assert again.regime == {name: rows[5][name] for name in again.regime}
    assert all(row["good"] + row["failed"] <= 1 for row in rows)
    assert "| all | 8 |" in trust_study.pixel_tables(rows)
    rows[0] |= {"part": True, "kind": "off", "best": 9.0, "ratio": [2.0] * 4, "beyond": ["bias"]}
    assert f"| {rows[0]['number']} | off |" in trust_study.wrong_pixels(rows)
    assert "of 8" not in trust_study.interval(0, 8)
    assert trust_study.interval(0, 1000) == "0 (0 to 0.37)"


def test_runs_are_compared_with_what_was_simulated(tmp_path, undrawn):
    good = trust_runs.study_run(0, tmp_path, "none")
    assert good["wrong"] == []
    assert not good["traceback"]
    assert good["pixels"] > 0
    brighter = trust_runs.sensor(0, tmp_path)
    brighter.truth["quanta_exposure"] *= 1.2
    report = json.loads((tmp_path / "run.zarr" / "report.json").read_text())
    bad = good | trust_runs.check(brighter, tmp_path / "run.zarr", report)
    assert [each.split()[0] for each in bad["wrong"]] == ["quanta_exposure"]
    assert "| nothing | 2 | 0 | 0 | 1 |" in trust_study.run_table([good, bad])
    assert "| 0 | none | 0 |" in trust_study.odd_runs([good, bad])
