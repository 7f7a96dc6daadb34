"""The loops of the fit against the paper's equations on raw samples, and compiled against plain."""

from __future__ import annotations

from pathlib import Path

import numba as nb
import numpy as np
import pytest
from helpers.drawn_pixels import draw, samples
from helpers.reference_pchem import Theta, e_step, em, log_likelihood
from numpy.typing import NDArray

from pchem_pipeline.model.errors import fisher_numba
from pchem_pipeline.model.fit import goodness_numba, polish_numba, start_numba
from pchem_pipeline.model.fit.pchem import em_trace
from pchem_pipeline.model.law import estep_numba, simd_math_numba, workspace_numba
from pchem_pipeline.model.law.simd_numba import counting, least, load_lanes, most, store_lanes
from pchem_pipeline.model.law.workspace_numba import (
    SUM_E,
    SUM_EE,
    SUM_K,
    SUM_KE,
    SUM_KK,
    Histogram,
    Workspace,
)

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
    for compiled_array, plain_array in zip(space[2:5], plain[2:5], strict=True):
        np.testing.assert_allclose(compiled_array, plain_array, rtol=1e-9, atol=1e-7)


def take_plain_lanes(monkeypatch: pytest.MonkeyPatch) -> None:
    """From here on loops in plain Python take their lanes from numpy; nothing can be compiled."""
    for name in ("artanh_series", "lanes_exp", "lanes_log"):
        plain = getattr(simd_math_numba, name).py_func
        for module in (simd_math_numba, estep_numba):
            monkeypatch.setattr(module, name, plain)


def test_compiled_table_equals_plain_at_every_width(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(8)
    kernels = {
        3: estep_numba.table_sums_3,
        5: estep_numba.table_sums_5,
        7: estep_numba.table_sums_7,
        9: estep_numba.table_sums_9,
        12: estep_numba.table_sums_any,
    }
    a, inverse, columns = 1.3, 0.9, 24
    for width, kernel in kernels.items():
        half = width // 2
        table = rng.uniform(0.01, 2, (4 + width, columns))
        table[1] = rng.uniform(-a / 2, a / 2, columns)
        table[2] = rng.integers(0, 9, columns)
        table[4:] *= 10.0 ** rng.integers(-30, 30, columns)  # the logarithm over many powers of two
        answers = []
        for function in (kernel, estep_numba.table_sums_any, kernel.py_func):
            totals = np.zeros(18)
            if function is kernel.py_func:
                take_plain_lanes(monkeypatch)
            function(table, columns, width, a, inverse, totals)
            answers.append(totals)
        monkeypatch.undo()
        np.testing.assert_allclose(answers[0], answers[1], rtol=1e-11)
        np.testing.assert_allclose(answers[0], answers[2], rtol=1e-11)
        c, offset, place, level = table[:4]
        low = np.maximum(place - half, 0)
        d = offset + (place - low) * a
        i = np.arange(width)[:, None]
        terms = table[4:] * np.exp(i * offset * a * inverse)
        density = terms.sum(axis=0)
        loglik = level - (d - offset / 2) * offset * inverse + np.log(density)
        first, second = ((terms * i**power).sum(axis=0) / density for power in (1, 2))
        fourth = (terms * (i**2 - second) ** 2).sum(axis=0) / density
        assert answers[0][0] == pytest.approx(c @ loglik, rel=1e-13)
        expected = [c @ first, c @ second, c @ (low * first), c @ (d * first), c @ (low * d)]
        np.testing.assert_allclose(answers[0][3:8], expected, rtol=1e-11)
        assert answers[0][10] == pytest.approx(c @ ((second - first**2) * d), rel=1e-9)
        assert answers[0][17] == pytest.approx(c @ fourth, rel=1e-9)


def test_lanes_are_the_functions_that_they_are_named_after(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    table, plain = np.zeros((4, 2000)), np.zeros((4, 2000))

    def fill(table: NDArray[np.float64]) -> None:
        for i in range(0, table.shape[1], 8):
            x = load_lanes(table, 0, i)
            store_lanes(table, 1, i, simd_math_numba.lanes_exp(x))
            store_lanes(table, 2, i, simd_math_numba.lanes_log(load_lanes(table, 1, i)))
            store_lanes(table, 3, i, most(least(x, 1.0), -2.0) - counting())

    table[0] = rng.uniform(-690, 690, 2000)
    plain[0] = table[0]
    nb.njit(fill)(table)
    take_plain_lanes(monkeypatch)
    fill(plain)
    np.testing.assert_allclose(table[1], np.exp(table[0]), rtol=3e-15)
    np.testing.assert_allclose(table[2], np.log(table[1]), rtol=1e-15, atol=1e-15)
    np.testing.assert_array_equal(table[3], np.clip(table[0], -2, 1) - np.arange(2000) % 8)
    np.testing.assert_allclose(plain, table, rtol=1e-14)


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


def test_no_kernel_lets_the_compiler_choose_the_bits() -> None:
    # numba optimises a kernel again in every kernel that calls it, and which copy runs depends on what the
    # process compiled or loaded before: with sums in any order, so would the last bits
    kernels = sorted(Path(workspace_numba.__file__).parents[1].rglob("*_numba.py"))
    assert len(kernels) > 20
    assert [path.name for path in kernels if "fastmath" in path.read_text()] == []
