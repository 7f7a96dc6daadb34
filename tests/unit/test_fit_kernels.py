"""The loops of the fit against the paper's equations on raw samples, and compiled against plain."""

from __future__ import annotations

import numpy as np
import pytest
from drawn_pixels import draw, samples
from numpy.typing import NDArray
from reference_pchem import Theta, e_step, em, log_likelihood

from pchem_pipeline.model import (
    estep_numba,
    fisher_numba,
    goodness_numba,
    polish_numba,
    start_numba,
    workspace_numba,
)
from pchem_pipeline.model.pchem import em_trace
from pchem_pipeline.model.workspace_numba import SUM_E, SUM_EE, SUM_K, SUM_KE, SUM_KK, Histogram, Workspace

# (H, 1/g, s_e) from needles to unresolved peaks, and a hot pixel
CASES = [
    (2.0, 11.0, 0.3),
    (0.1, 10.0, 0.2),
    (8.0, 13.0, 0.42),
    (5.0, 10.0, 0.6),
    (4.0, 10.0, 1.3),
    (60.0, 9.0, 0.3),
    (3.0, 12.0, 0.1),
]
N = 3000


def prepare(
    case: tuple[float, float, float], seed: int = 4
) -> tuple[Histogram, float, NDArray[np.float64], Theta]:
    """Histogram, centre in DN, raw sample and a theta that is off the truth."""
    counts, origin, truth = draw(np.random.default_rng(seed), *case, n_frames=N)
    weights, cumulative = np.empty(counts.shape[1]), np.empty(counts.shape[1] + 1)
    histogram, centre, _ = workspace_numba.load(counts[0], weights, cumulative)
    h, g, mu, sigma = truth[0]
    return (
        histogram,
        float(origin[0] + centre),
        samples(counts[0], int(origin[0])),
        Theta(1.04 * h, 0.985 * g, mu - 0.3, 1.05 * sigma),
    )


def internal(theta: Theta, centre: float) -> NDArray[np.float64]:
    return np.array([np.log(theta.exposure), 1 / theta.gain, theta.bias - centre, 2 * np.log(theta.sigma)])


def run(histogram: Histogram, theta: NDArray[np.float64]) -> tuple[float, Workspace]:
    space = workspace_numba.make_workspace(workspace_numba.make_rows(histogram.n_bins))
    return estep_numba.evaluate(histogram, theta, space, 0.0), space


@pytest.mark.parametrize("case", CASES)
def test_e_step_sums_and_likelihood(case: tuple[float, float, float]) -> None:
    histogram, centre, x, theta = prepare(case)
    loglik, space = run(histogram, internal(theta, centre))
    assert loglik == pytest.approx(log_likelihood(x, theta), rel=1e-11)
    sums = e_step(x, theta)
    mean_k, mean_kk = space.total[SUM_K] / N, space.total[SUM_KK] / N
    assert mean_k == pytest.approx(sums.a, rel=1e-9)
    assert mean_kk == pytest.approx(sums.b, rel=1e-9)
    # k e with e = x - mu - k/g
    assert space.total[SUM_KE] / N == pytest.approx(
        sums.c - theta.bias * sums.a - sums.b / theta.gain, abs=1e-7 * sums.c
    )
    assert space.total[SUM_E] / N == pytest.approx(x.mean() - theta.bias - sums.a / theta.gain, abs=1e-7)
    expected = (
        ((x - theta.bias) ** 2).mean()
        - 2 * (sums.c - theta.bias * sums.a) / theta.gain
        + sums.b / theta.gain**2
    )
    assert space.total[SUM_EE] / N == pytest.approx(expected, rel=1e-7)


@pytest.mark.parametrize("case", CASES)
def test_score_is_the_gradient_and_information_minus_its_jacobian(case: tuple[float, float, float]) -> None:
    histogram, centre, x, theta = prepare(case)
    point = internal(theta, centre)
    _, space = run(histogram, point)
    score, information = space.score.copy(), space.information.copy()
    size = np.sqrt(np.abs(np.diag(information)))
    step = 1e-3 / size

    def loglik(p: NDArray[np.float64]) -> float:
        return log_likelihood(x, Theta(float(np.exp(p[0])), 1 / p[1], p[2] + centre, float(np.exp(p[3] / 2))))

    for i, h in enumerate(np.diag(step)):
        slope = (
            8 * (loglik(point + h) - loglik(point - h)) - loglik(point + 2 * h) + loglik(point - 2 * h)
        ) / 12
        assert score[i] / size[i] == pytest.approx(slope / step[i] / size[i], rel=1e-6, abs=2e-5)
        change = run(histogram, point + h)[1].score.copy() - run(histogram, point - h)[1].score
        np.testing.assert_allclose(
            information[i] / size / size[i], -change / (2 * step[i]) / size / size[i], atol=2e-6
        )


@pytest.mark.parametrize("case", [CASES[0], CASES[1], CASES[2]])
def test_em_iterates_follow_the_paper(case: tuple[float, float, float]) -> None:
    counts, origin, truth = draw(np.random.default_rng(5), *case, n_frames=N)
    start = Theta(*(truth[0] * [1.1, 1.03, 1.002, 0.9]))
    trace = em_trace(counts[0], int(origin[0]), start, 25)
    path = em(samples(counts[0], int(origin[0])), start, 25)
    np.testing.assert_allclose(trace.parameters, np.array(path), rtol=1e-10)
    assert not np.allclose(trace.parameters[1], trace.parameters[0], rtol=1e-4)


def test_compiled_evaluation_equals_plain() -> None:
    histogram, centre, _, theta = prepare(CASES[0])
    point = internal(theta, centre)
    loglik, space = run(histogram, point)
    rows = workspace_numba.make_rows.py_func(histogram.n_bins)
    plain = workspace_numba.make_workspace.py_func(rows)
    assert estep_numba.evaluate.py_func(histogram, point, plain, 0.0) == pytest.approx(loglik, rel=1e-13)
    for compiled_array, plain_array in zip(space[2:], plain[2:], strict=True):
        np.testing.assert_allclose(compiled_array, plain_array, rtol=1e-9, atol=1e-7)


def test_compiled_table_equals_plain_at_every_width() -> None:
    rng = np.random.default_rng(8)
    kernels = {
        3: estep_numba.table_sums_3,
        5: estep_numba.table_sums_5,
        7: estep_numba.table_sums_7,
        9: estep_numba.table_sums_9,
        12: estep_numba.table_sums_any,
    }
    for width, kernel in kernels.items():
        table = rng.uniform(0.01, 2, (5 + width, 24))
        table[5:] *= 10.0 ** rng.integers(-30, 30, 24)  # the logarithm over many powers of two
        answers = []
        for function in (kernel, kernel.py_func, estep_numba.table_sums_any):
            totals = np.zeros(16)
            function(table, 24, width, 1.3, totals)
            answers.append(totals)
        np.testing.assert_allclose(answers[0], answers[1], rtol=1e-11)
        np.testing.assert_allclose(answers[0], answers[2], rtol=1e-11)
        density = (table[5:] * table[1] ** np.arange(width)[:, None]).sum(axis=0)
        assert answers[0][0] == pytest.approx(table[0] @ (table[4] + np.log(density)), rel=1e-13)


def test_vector_log_is_the_logarithm() -> None:
    x = np.exp(np.random.default_rng(1).uniform(-690, 690, 2000))
    for function in (estep_numba.vector_log, estep_numba.vector_log.py_func):
        np.testing.assert_allclose(
            [function(v) for v in [*x, 1.0, 2.0, 0.5]], np.log([*x, 1.0, 2.0, 0.5]), rtol=1e-15, atol=1e-15
        )


def test_compiled_steps_equal_plain() -> None:
    histogram, centre, _, theta = prepare(CASES[0])
    point = internal(theta, centre)
    _, space = run(histogram, point)
    compiled, plain = np.empty(4), np.empty(4)
    for kernel, arguments in (
        (polish_numba.em_step, (histogram.n, point, space.total, -9.0)),
        (polish_numba.newton_step, (histogram.n, point, space, -9.0, 0.01)),
    ):
        assert kernel(*arguments, compiled) == pytest.approx(kernel.py_func(*arguments, plain))
        np.testing.assert_allclose(compiled, plain, rtol=1e-9)
    held = np.array([False, False, True, False])
    left, right = np.empty((4, 4)), np.empty((4, 4))
    assert fisher_numba.invert(space.information, held, left)
    assert fisher_numba.invert.py_func(space.information, held, right)
    np.testing.assert_allclose(left, right, rtol=1e-9)
    free = [0, 1, 3]
    np.testing.assert_allclose(
        left[np.ix_(free, free)], np.linalg.inv(space.information[np.ix_(free, free)]), rtol=1e-7
    )
    assert np.isnan(left[2]).all()


def test_singular_information_is_refused() -> None:
    assert not fisher_numba.invert(np.ones((4, 4)), np.zeros(4, bool), np.empty((4, 4)))


def test_ecf_against_the_definition() -> None:
    histogram, _, _, _ = prepare(CASES[0])
    y = histogram.first + np.arange(histogram.n_bins)
    weights = histogram.weights[: histogram.n_bins]
    rows, plain = workspace_numba.make_rows(histogram.n_bins), workspace_numba.make_rows(histogram.n_bins)
    expected = np.exp(2j * np.pi * 0.01 * np.arange(1, 21)[:, None] * y) @ weights
    for n_bins in (histogram.n_bins, histogram.n_bins - 1):  # pairs of DN, and one left over
        part = histogram._replace(n_bins=n_bins)
        start_numba.ecf_power(part, 0.01, 20, rows)
        start_numba.ecf_power.py_func(part, 0.01, 20, plain)
        phases = np.exp(2j * np.pi * 0.01 * np.arange(1, 21)[:, None] * y[:n_bins])
        np.testing.assert_allclose(rows[0, :20], np.abs(phases @ weights[:n_bins] / N) ** 2, atol=1e-12)
        np.testing.assert_allclose(plain[0, :20], rows[0, :20], atol=1e-12)
    modulus, phase = start_numba.ecf_at(histogram, 0.05)
    assert modulus * np.exp(1j * phase) == pytest.approx(expected[4], abs=1e-9 * N)


def test_chi_square_merges_to_five_and_keeps_the_total() -> None:
    seen = np.array([0.0, 3, 9, 30, 41, 25, 12, 4, 1])
    expected = np.array([1.0, 3, 10, 28, 40, 20, 13, 3.5, 0.5])  # 119 of 120 inside the window
    groups = [(12, 14), (30, 28), (41, 40), (25, 20), (12, 13), (5, 5)]
    chi2, freedom = goodness_numba.pearson(seen, expected, 9, 120.0)
    assert freedom == 1
    assert chi2 == pytest.approx(sum((o - e) ** 2 / e for o, e in groups))
    assert goodness_numba.pearson(seen[:5], expected[:5], 5, 82.0)[1] == 0
    wide_seen, wide_expected = np.full(20, 10.0), np.full(20, 10.0)
    wide_seen[3] = 16
    assert goodness_numba.pearson(wide_seen, wide_expected, 20, 200.0) == (pytest.approx(3.6), 15)
    assert goodness_numba.normal_score(15.0, 15) == pytest.approx(0.0, abs=0.2)
    assert goodness_numba.normal_score(60.0, 15) > 4
