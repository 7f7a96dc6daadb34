"""From a stack to its evidence: the kernels against plain numpy, rare samples, odd input."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from helpers.plain_camera import PlainCamera
from helpers.plain_law import joint_mass, pcd_mass
from helpers.small_stacks import small_stack
from scipy import special, stats

from pchem_pipeline.base.errors import InputError, PchEmError
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.observe.observe import _without_steps, observe, observe_histograms
from pchem_pipeline.discrepancy.observe.sums import blocks_of
from pchem_pipeline.discrepancy.observe.tables import efficient_scores
from pchem_pipeline.discrepancy.observe.tables_numba import INVERSE, N_ROWS, N_TESTS, SEEN, sum_scores, whiten
from pchem_pipeline.discrepancy.where import expected_beyond, rare_samples, single_samples
from pchem_pipeline.effects.framework.evidence import MOST_HITS, SCORES, Evidence, PixelMaps
from pchem_pipeline.model.arithmetic.simd_numba import SIMD_WIDTH
from pchem_pipeline.model.histogram.count import histogram_frames
from pchem_pipeline.model.law import cell_scores_numba

H, STEP, BIAS, WIDTH = 1.7, 9.0, 40.3, 2.4


def _law(width: float = WIDTH) -> np.ndarray:
    first, last = cell_scores_numba.electron_range(H, np.log(1e-12))
    law = np.empty((int(BIAS + last * STEP + 8 * width) + 1, cell_scores_numba.N_COLUMNS))
    cell_scores_numba.fill_law(H, STEP, BIAS, width, first, last, law)
    return law


def whitened(law: np.ndarray, inverse: np.ndarray) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
    """Whiten the law (code, column) of one pixel in place; return the factor, and what scores its samples."""
    factor = np.zeros((cell_scores_numba.N_NUISANCE, cell_scores_numba.N_COLUMNS))
    table = np.zeros((N_ROWS, -(-len(law) // SIMD_WIDTH) * SIMD_WIDTH))
    table[:INVERSE, : len(law)], table[INVERSE, : len(law)] = law.T, inverse
    whiten(table, factor)
    law[:] = table[:INVERSE, : len(law)].T

    def scored(seen: np.ndarray) -> np.ndarray:
        sums = np.zeros((N_TESTS, N_TESTS + 3))
        table[SEEN, : len(law)] = seen
        sum_scores(table, sums)
        return efficient_scores(sums[None], factor[None], np.array([seen.sum()]), np.array([H]))[0, 0]

    return factor, scored


def seen(frames: np.ndarray, block: int = 20, first: int = 0) -> Evidence:
    """Return the evidence of all frames, the last ones of a run."""
    numbers = np.arange(first, first + len(frames))
    return observe(frames, numbers, n_run=first + len(frames), block_frames=block)


@pytest.mark.parametrize("width", [2.4, 0.9], ids=["series", "error function"])
def test_law_holds_the_polynomials_integrated_over_cells(width: float) -> None:
    law = _law(width)
    k = np.arange(30)
    weight = stats.poisson.pmf(k, H)
    d = k - H
    charlier = [
        np.ones_like(d),
        d / np.sqrt(H),
        (d**2 - k) / (np.sqrt(2) * H),
        (d**3 - 3 * k * d + 2 * k) / (6**0.5 * H**1.5),
    ]
    node, size = np.polynomial.legendre.leggauss(20)
    for code in (35, 40, 45, 53, 60, 75):
        z = (code + 0.5 * node[:, None] - BIAS - k * STEP) / width
        density = stats.norm.pdf(z) * 0.5 * size[:, None] / width
        for column, (a, b) in enumerate(cell_scores_numba.COLUMNS):
            expected = np.sum(weight * charlier[b] * density * special.eval_hermitenorm(a, z))
            assert law[code, column] == pytest.approx(expected, rel=1e-6, abs=1e-6 * law[code, 0])
    mass = pcd_mass(np.arange(20, 120), H, 1 / STEP, BIAS, width / STEP)
    np.testing.assert_allclose(law[20:120, 0], mass, atol=1e-11)
    assert law[:, 0].sum() == pytest.approx(1.0, abs=1e-10)


def test_scores_are_orthogonal_to_the_parameters_and_know_their_variance() -> None:
    law = _law()[26:120].copy()
    mass = law[:, 0].copy()
    raw = law.copy()
    gram, scored = whitened(law, 1 / mass)
    products = law.T @ (law / mass[:, None])
    n = cell_scores_numba.N_NUISANCE
    np.testing.assert_allclose(products[:n, :n], np.eye(n), atol=1e-9)
    np.testing.assert_allclose(products[:n, n:], 0.0, atol=1e-9)
    np.testing.assert_allclose(raw[:, :n], law[:, :n] @ gram[:, :n], atol=1e-12)
    # samples in exact proportion to the mass score nothing but the bias of a fit; doubling He3 shows
    seen = 1e4 * mass
    still = scored(seen)
    assert np.abs(still).max() < 0.2
    tilt = 1 + 0.05 * law[:, n + 2] / mass
    variance = products[n + 2, n + 2]
    assert scored(seen * tilt)[2] - still[2] == pytest.approx(0.05 * np.sqrt(1e4 * variance), rel=1e-3)


def test_a_parameter_without_a_trace_in_the_law_takes_nothing_from_the_scores() -> None:
    # each electron number has the same two codes, half of its samples in each, whatever the read noise
    first, last = cell_scores_numba.electron_range(H, np.log(1e-12))
    law = np.zeros((160, cell_scores_numba.N_COLUMNS))
    cell_scores_numba.fill_law(H, 4.0, 40.5, 0.1, first, last, law)
    inverse = np.divide(1.0, law[:, 0], out=np.zeros(160), where=law[:, 0] > 1e-14)
    raw = law.copy()
    _, scored = whitened(law, inverse)
    n = cell_scores_numba.N_NUISANCE
    products = (law * inverse[:, None]).T @ law
    lost = np.diagonal(products)[:n] < 0.5
    assert lost[4]
    assert not lost[:3].any()
    np.testing.assert_allclose(products[:n, :n], np.diag(~lost), atol=1e-9)
    np.testing.assert_allclose((law[:, n:] * inverse[:, None]).T @ raw[:, :n], 0.0, atol=1e-7)
    found = scored(1e4 * raw[:, 0])
    known = np.isfinite(found)
    assert known.any()
    assert np.abs(found[known]).max() < 0.2


def test_bias_of_the_scores_is_that_of_fitted_samples() -> None:
    # the second-order expectation against its definition by finite differences of the law
    law = _law()[:150].copy()
    mass = law[:, 0].copy()
    keep = mass > 1e-12
    law, mass = law[keep], mass[keep]
    codes = np.arange(150)[keep]
    _, scored = whitened(law, 1 / mass)
    n = cell_scores_numba.N_NUISANCE
    theta = np.array([H, STEP, BIAS, WIDTH])

    def mass_at(shift: np.ndarray) -> np.ndarray:
        h, step, bias, width = theta + shift
        return pcd_mass(codes, h, 1 / step, bias, width / step)

    e = np.diag([1e-3, 1e-2, 1e-2, 1e-2])
    slope = np.array([(mass_at(d) - mass_at(-d)) / (2 * d.sum()) for d in e])
    covariance = np.linalg.inv(slope @ (slope / mass).T)
    expected = np.zeros(law.shape[1] - n)
    for i in range(4):
        for j in range(4):
            step2 = mass_at(e[i] + e[j]) - mass_at(e[i] - e[j]) - mass_at(e[j] - e[i]) + mass_at(-e[i] - e[j])
            curvature = step2 / (4 * e[i].sum() * e[j].sum())
            expected -= 0.5 * covariance[i, j] * (law[:, n:] / mass[:, None]).T @ curvature
    samples = 1e4
    variance = np.sum(law[:, n:] ** 2 / mass[:, None], axis=0)
    bias = -scored(samples * mass) * np.sqrt(samples * variance)
    np.testing.assert_allclose(bias, expected, rtol=0.02, atol=0.02 * np.abs(expected).max())
    assert np.abs(expected).max() > 0.5


def _tables(frames: np.ndarray, evidence: Evidence) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return k and r of every sample by brute force, centred, and the support of the pixels."""
    n = frames.shape[0]
    k_of, r_of = np.zeros(frames.shape), np.zeros(frames.shape)
    maps = evidence.maps
    electrons = np.arange(60)
    for y, x in np.argwhere(maps.usable):
        h, g, mu = maps.quanta_exposure[y, x], maps.conversion_gain[y, x], maps.bias[y, x]
        joint = joint_mass(np.arange(400), h, g, mu, maps.read_noise_dn[y, x], 60).T
        total = joint.sum(axis=1)
        below, above = np.cumsum(total), np.cumsum(total[::-1])[::-1]
        low, high = np.argmax(n * below >= 0.01), 399 - np.argmax((n * above >= 0.01)[::-1])
        at = np.clip(frames[:, y, x].astype(int), low, high)
        k = (joint @ electrons)[at] / total[at]
        r = at - mu - k / g
        k_of[:, y, x], r_of[:, y, x] = k - k.mean(), r - r.mean()
        model = total / total.sum()
        kt = (joint @ electrons) / np.maximum(total, 1e-300)
        variance = np.sum(model * kt**2) - np.sum(model * kt) ** 2
        # the support ends where a hundredth of a sample is left
        assert evidence.charge_std[y, x] == pytest.approx(np.sqrt(variance), rel=1e-2)
    return k_of, r_of, maps.usable, np.where(maps.usable, maps.quanta_exposure, 0.0)


def test_sums_are_those_of_plain_numpy() -> None:
    """One pixel is stuck, one excluded, one frame repeated, and every other block is left out."""
    frames = small_stack((5, 6), 60, 5, analog_read_noise_e={"kind": "constant", "value": 0.2})
    frames[:, 1, 2] = 77
    frames[31] = frames[30]
    frames[50, 3] = frames[49, 3]
    exclude = np.zeros((5, 6), np.bool_)
    exclude[4, 5] = True
    numbers = (np.arange(0, 120, 24)[:, None] + np.arange(12)).ravel()
    evidence = observe(frames, numbers, n_run=120, block_frames=12, exclude=exclude)
    k, r, usable, h = _tables(frames, evidence)
    assert usable.sum() >= 20
    assert not usable[1, 2]
    assert not usable[4, 5]
    time = evidence.time
    tight = {"rtol": 1e-3, "atol": 2e-5}
    np.testing.assert_allclose(time.frame_charge, k.sum(axis=(1, 2)) / h.sum(), **tight)
    np.testing.assert_allclose(time.frame_readout, r.sum(axis=(1, 2)) / usable.sum(), **tight)
    np.testing.assert_allclose(time.row_charge, k.sum(axis=2) / usable.sum(axis=1), **tight)
    np.testing.assert_allclose(time.column_readout, r.sum(axis=1) / usable.sum(axis=0), **tight)
    top_right = r[:, :2, 3:].sum(axis=(1, 2)) / usable[:2, 3:].sum()
    np.testing.assert_allclose(time.quadrant_readout[:, 1], top_right, **tight)
    edges = blocks_of(numbers, 12)
    assert edges.tolist() == [0, 12, 24, 36, 48, 60]
    assert time.block_start.tolist() == [0, 24, 48, 72, 96]
    np.testing.assert_allclose(time.block_readout[2][usable], r[24:36].mean(axis=0)[usable], **tight)
    assert np.isnan(time.block_readout[:, ~usable]).all()
    # products are of what the common mode leaves
    vk, vr = k.var(axis=0), r.var(axis=0)
    of_k, of_r = (m / np.where(usable, v, np.inf) for m, v in ((h, vk), (usable, vr)))
    norm_k, norm_r = (of_k * h).sum(), (of_r * usable).sum()
    k1 = k - ((k * of_k).sum(axis=(1, 2)) / norm_k)[:, None, None] * h
    r1 = r - ((r * of_r).sum(axis=(1, 2)) / norm_r)[:, None, None] * usable
    vk1, vr1 = vk - h**2 / norm_k, vr - usable / norm_r

    def lagged(one: np.ndarray, other: np.ndarray, lag: int) -> np.ndarray:
        t = np.concatenate([np.arange(a + lag, b) for a, b in pairwise(edges)])
        return (one[t] * other[t - lag]).mean(axis=0)[usable]

    assert time.n_pairs == sum(b - a - 1 for a, b in pairwise(edges))
    of_k, of_r = vk1[usable], vr1[usable]
    cross = lagged(r1, k1, 1) + (k * r).mean(axis=0)[usable] / 59
    np.testing.assert_allclose(time.lag_charge[0][usable], lagged(k1, k1, 1) / of_k + 1 / 59, **tight)
    np.testing.assert_allclose(time.lag_readout_charge[usable], cross / np.sqrt(of_k * of_r), **tight)
    np.testing.assert_allclose(time.lag_readout[2][usable], lagged(r1, r1, 3) / of_r + 1 / 59, **tight)
    # neighbours along y: what the removal of the mean does to pairs is taken out
    pairs = usable[:-1] & usable[1:]
    product = (r1[:, :-1] * r1[:, 1:]).mean(axis=0)
    removed = -1.0 / norm_r
    expected = (product - removed)[pairs] / np.sqrt((vr1[:-1] * vr1[1:])[pairs])
    assert time.neighbours["y.rr"] == pytest.approx(expected.mean(), abs=2e-5)
    assert evidence.z["space.y.rr"] == pytest.approx(expected.sum() * np.sqrt(60 / pairs.sum()), abs=1e-2)
    # both halves of a row: their sums in their standard deviation, less what the frames share
    halves = np.concatenate([r[:, :, :3].sum(axis=2), r[:, :, 3:].sum(axis=2)], axis=1)
    deviation, size = (
        np.concatenate([of[:, :3].sum(axis=1), of[:, 3:].sum(axis=1)]) for of in (vr * usable, usable)
    )
    unit = size / np.sqrt(deviation) / np.sqrt((size**2 / deviation).sum())
    u = halves / np.sqrt(deviation)
    u -= (u @ unit)[:, None] * unit
    products = (u[:, :5] * u[:, 5:]).sum() + 60 * unit[:5] @ unit[5:]
    assert evidence.z["space.row.readout.halves"] == pytest.approx(products / np.sqrt(60 * 5), abs=1e-2)
    mixed = (r1[:, :, :-1] * k1[:, :, 1:] + k1[:, :, :-1] * r1[:, :, 1:]).mean(axis=0)
    near = usable[:, :-1] & usable[:, 1:]
    root = np.sqrt(vr1[:, :-1] * vk1[:, 1:]) + np.sqrt(vk1[:, :-1] * vr1[:, 1:])
    # the frames are few: the correction is small beside what is summed
    assert time.neighbours["x.rk"] == pytest.approx((mixed[near] / root[near]).mean(), abs=0.01)
    assert time.repeated.tolist() == [numbers[31]]
    assert time.repeated_rows == 1
    assert evidence.z["frame.repeated"] == 10.0


def test_gain_of_a_frame_is_the_slope_of_the_residual() -> None:
    frames = small_stack((12, 12), 400, 8)
    plain = seen(frames)
    k, r, usable, h = _tables(frames, plain)
    k, r, h, g = k[:, usable], r[:, usable], h[usable], plain.maps.conversion_gain[usable]
    weight = 1 / r.var(axis=0)
    pattern = h / g - (h / g * weight).sum() / weight.sum()
    top = (r * weight * (k / g + pattern)).sum(axis=1) - (weight * (k * r).mean(axis=0) / g).sum()
    bottom = (weight * (k.var(axis=0) / g**2 + pattern**2)).sum()
    np.testing.assert_allclose(plain.time.frame_gain, top / bottom, atol=2e-4)


def _noise_statistics(loud: np.ndarray | float, seed: int) -> dict[str, float]:
    rng = np.random.default_rng(seed)
    noise = 2.0 * loud * rng.standard_normal((400, 12, 14))
    frames = np.floor(100.5 + 9.0 * rng.poisson(1.5, noise.shape) + noise).astype(np.uint16)
    return {name: value for name, value in seen(frames).z.items() if ".noise." in name}


def test_noise_that_is_larger_in_some_frames_or_rows_stands_out_where_it_is() -> None:
    rng = np.random.default_rng(0)
    frames = _noise_statistics(1.0 + 0.5 * (rng.random((400, 1, 1)) < 0.1), 1)
    assert frames["frame.noise.variance"] > 8
    assert abs(frames["space.row.noise.variance"]) < 4
    rows = _noise_statistics(1.0 + 0.8 * (rng.random((400, 12, 1)) < 0.1), 2)
    assert rows["space.row.noise.variance"] > 6
    assert abs(rows["space.column.noise.variance"]) < 4
    slow = _noise_statistics(np.linspace(0.9, 1.1, 400)[:, None, None], 3)
    assert slow["frame.noise.slow"] > 6


def test_a_pixel_whose_residuals_hardly_vary_does_not_speak_for_all() -> None:
    """In sensors of which the fits go astray some pixels have next to no readout noise left."""
    rng = np.random.default_rng(6)
    exposure = 0.07 * np.exp(0.2 * rng.standard_normal((16, 16)))
    electrons = rng.poisson(np.broadcast_to(exposure, (400, 16, 16)))
    frames = np.floor(200.5 + 20.0 * (electrons + 0.6 * rng.standard_normal(electrons.shape)))
    z = seen(frames.astype(np.uint16)).z
    assert max(abs(value) for name, value in z.items() if ".noise." in name) < 5


def test_few_pixels_of_large_noise_do_not_decide_what_the_frames_share() -> None:
    """The products of all other pixels held their residuals: six sigma by chance."""
    rng = np.random.default_rng(4)
    step = np.where(np.arange(144).reshape(12, 12) % 8 == 0, 45.0, 1.3)
    electrons = rng.poisson(1.5, (400, 12, 12)) + 0.3 * rng.standard_normal((400, 12, 12))
    z = seen(np.floor(100.5 + step * electrons).astype(np.uint16)).z
    names = ["time.lag1.readout.mean", "time.lag2.readout.mean", "space.x.rr", "space.y.rr"]
    assert max(abs(z[name]) for name in names) < 4.0


def test_all_names_come_in_the_order_of_the_catalogue_and_histograms_alone_give_those_of_samples() -> None:
    frames = small_stack((12, 12), 300, 1)
    evidence, histograms = seen(frames), histogram_frames(frames)
    assert list(evidence.z) == list(STATISTICS)
    assert np.isfinite(list(evidence.z.values())).all()
    assert tuple(evidence.scores) == SCORES
    assert dict(seen(frames).z) == dict(evidence.z)
    alone = observe_histograms(histograms.counts.reshape(144, -1), histograms.origin.ravel())
    assert alone.time is None
    assert alone.maps.bias.shape == (1, 144)
    assert alone.z == {name: evidence.z[name] for name in alone.z}
    assert {name.split(".")[0] for name in alone.z} == {"shape", "code", "tail"}
    assert set(evidence.z) - set(alone.z) >= {"tail.high.clusters", "time.lag1.charge.mean"}


@pytest.mark.parametrize("shape", [(1, 40), (40, 1)], ids=["one row", "one column"])
def test_a_line_of_pixels_has_no_neighbours_across(shape: tuple[int, int]) -> None:
    z = seen(small_stack(shape, 200, 4)).z
    across, along = ("row", "x") if shape[0] == 1 else ("column", "y")
    space = [name.split(".")[1:] for name in z if name.startswith("space.")]
    assert across not in {name[0] for name in space}
    assert {name[0] for name in space if len(name) == 2} == {along, "follows"}
    assert np.isfinite(list(z.values())).all()


def test_a_third_of_the_pixels_unfit_breaks_nothing() -> None:
    frames = small_stack((12, 12), 240, 2)
    frames[:, ::3] = 0
    frames[:, 1::6, ::2] = np.random.default_rng(1).integers(0, 2, frames[:, 1::6, ::2].shape) * 9000
    evidence = seen(frames)
    share = evidence.maps.usable.mean()
    assert 0.3 < share < 0.7
    assert np.isfinite(list(evidence.z.values())).all()
    assert max(abs(z) for z in evidence.z.values()) < 6
    unfit = ~evidence.maps.usable
    assert np.isnan(evidence.maps.bias[unfit]).all()
    assert np.isnan(evidence.scores["He4"][unfit]).all()
    assert np.isfinite(evidence.scores["He4"][~unfit]).all()


def test_what_cannot_be_observed_says_why() -> None:
    frames = small_stack((4, 4), 100, 1)
    with pytest.raises(InputError, match="fewer than 4 blocks of 30"):
        seen(frames, 30)
    with pytest.raises(InputError, match="one number for each"):
        observe(frames, np.arange(99), n_run=100, block_frames=10)
    with pytest.raises(InputError, match="unsigned"):
        seen(frames.astype(np.int32))
    with pytest.raises(PchEmError, match="none of the 16 pixels"):
        seen(np.full_like(frames, 90))


@pytest.mark.parametrize(("noise", "step", "exposure"), [(0.36, 15.0, 1.0), (0.3, 14.0, 1.5)])
def test_pixels_that_jump_show_in_the_form_of_their_peaks(noise: float, step: float, exposure: float) -> None:
    """A few pixels jump by an electron in a fifth of the frames, which the fit takes for charge."""
    camera = PlainCamera(noise, exposure, step, (24, 24), 900)
    frames, rng = camera.frames(11), np.random.default_rng(12)
    clean = seen(frames, 40)
    assert all(abs(clean.z[f"shape.peaks.{kind}"]) < 4.5 for kind in ("mean", "chi", "cnt"))
    jumping = rng.random((24, 24)) < 0.06
    jumps = rng.choice([-1, 0, 1], frames.shape, p=[0.1, 0.8, 0.1]) * jumping
    found = seen((frames + np.rint(step * jumps)).astype(np.uint16), 40)
    assert found.z["shape.peaks.cnt"] > max(4.0, 1.4 * found.z["shape.goodness.cnt"])
    outlying = found.peaks > 3.5
    assert (jumping[outlying]).mean() >= 0.8


def test_a_coarse_step_is_not_taken_for_a_comb_of_electrons_that_are_not_there():
    camera = PlainCamera(0.25, 0.11, 3.45, (12, 12), 6000, (0.06, 0.015, 0.045, 1.5))
    maps = seen(camera.frames(300), 100).maps
    assert maps.usable.all()
    assert np.abs(1 / maps.conversion_gain / 3.45 - 1).max() < 0.2


def test_squares_of_equal_samples_are_told_from_those_of_chance() -> None:
    plain = small_stack((12, 14), 600, 7)
    some = np.random.default_rng(1).random((600, 6, 1, 7, 1)) < 0.002
    squares = plain.reshape(600, 6, 2, 7, 2)
    merged = np.where(some, squares.sum(axis=(2, 4), keepdims=True) // 4, squares).astype(np.uint16)
    # pixels of which all samples are equal, in a frame as in any other
    saturated = plain.copy()
    saturated[:, 3:6, 3:6] = plain.max()
    # clouds of particles that leave their pixels at the limit of the converter, in single frames
    hit = plain.copy()
    hit[::20, 3:6, 3:6] = 4095
    by_chance = [seen(each, 50).z["space.equal.squares"] for each in (plain, saturated, hit)]
    assert np.abs(by_chance).max() < 5
    # some fifty of them, beside a few by chance
    assert seen(merged.reshape(plain.shape), 50).z["space.equal.squares"] > 10


def test_a_comb_too_fine_for_whole_dn_is_none_where_other_pixels_have_a_coarse_one() -> None:
    steps = np.array([14.0, 13.0, 0.84, 15.0, 2.4, 4.0])
    usable = np.ones(6, np.bool_)
    assert _without_steps(1.0 / steps, usable).tolist() == [False, False, True, False, True, False]
    # at twice the gain of the others, few are by chance and many are another gain
    for few, left in ((10, 10), (80, 0)):
        assert _without_steps(1.0 / np.repeat([4.0, 2.0], [320, few]), np.ones(320 + few, bool)).sum() == left
    # a sensor of such steps is what it is, and so is one whose usable pixels have them
    assert not _without_steps(1.0 / np.array([2.2, 1.9, 0.9, 2.4]), usable[:4]).any()
    assert not _without_steps(1.0 / steps, steps < 3.0).any()
    assert not _without_steps(1.0 / steps, ~usable).any()


@pytest.mark.parametrize("exposure", [0.4, 3.0, 80.0])
def test_a_sample_is_as_rare_as_the_law_of_its_pixel_makes_it(exposure):
    one = np.ones((1, 2))
    maps = PixelMaps.known((exposure * one, one / 11.0, 100.0 * one, 3.0 * one), one > 0)
    width, k = np.sqrt(9.0 - 1.0 / 12.0), np.arange(400)
    level = 100.0 + 11.0 * k
    for above, codes in ((False, (88, 95)), (True, (160, 1400))):
        hits = np.array([[7, 0, 1, code] for code in codes])
        wanted = [
            500 * (stats.poisson.pmf(k, exposure) * stats.norm.cdf(
                (level - code + 0.5 if above else code + 0.5 - level) / width
            )).sum()
            for code in codes
        ]  # fmt: skip
        assert expected_beyond(hits, maps, 500, above=above) == pytest.approx(wanted, rel=1e-6)


def test_a_disturbed_row_and_an_odd_pixel_are_one_event_each():
    row = [[5, 3, x, 60] for x in range(8)]
    pixel = [[t, 6, 2, 60] for t in range(10, 30)]
    alone = [[40, 1, 1, 60]]
    kept = single_samples(np.array([*row, *pixel, *alone]))
    assert len(kept) == 3
    assert len({int(t) for t in kept[:, 0]}) == len({(int(y), int(x)) for y, x in kept[:, 1:3]}) == 3
    assert single_samples(np.empty((0, 4), np.int64)).shape == (0, 4)


def test_samples_far_above_or_below_are_listed_and_are_the_rarer_ones():
    frames = small_stack((10, 10), 400, 3)
    frames[30, 2, 2], frames[60, 4, 4] = 72, 74
    frames[17, 3, 4:6], frames[90, 0, 0] = 2000, 1500
    evidence = seen(frames, first=1000)
    hits = evidence.time.hits[evidence.time.hits[:, 3] >= 1500]
    assert hits.tolist() == [[1017, 3, 4, 2000], [1017, 3, 5, 2000], [1090, 0, 0, 1500]]
    assert evidence.z["tail.high.clusters"] > 3
    assert evidence.z["tail.high.count"] > 3
    low = evidence.time.low_hits
    assert {(1030, 2, 2, 72), (1060, 4, 4, 74)} <= {tuple(map(int, hit)) for hit in low}
    assert len(low) == evidence.tail_low.sum()
    beyond, rarer, *_ = rare_samples(evidence)
    assert beyond.expected.max() <= 1e-2
    assert rarer.expected.sum() <= 1.0
    assert rarer.seen[[2, 4], [2, 4]].all()
    assert rarer.seen.sum() <= beyond.seen.sum()
    # a tail of which not all samples are listed says nothing of places
    assert len(list(rare_samples(evidence))) == 4
    many = np.zeros((MOST_HITS, 4), np.int64)
    assert len(list(rare_samples(replace(evidence, time=replace(evidence.time, low_hits=many))))) == 2
    assert list(rare_samples(replace(evidence, tail_expected=None))) == []


def test_samples_within_the_law_but_outside_of_a_narrow_histogram_are_no_tail() -> None:
    # the window suits the pixel of 28 e-; of the one of 70 e-, it holds three standard deviations
    rng = np.random.default_rng(3)
    frames = PlainCamera(0.25, 2.0, 9.0, (8, 8), 1000).frames(3)
    electrons = rng.poisson([28.0, 70.0], (1000, 2)) + 0.25 * rng.standard_normal((1000, 2))
    frames[:, ::4, 4] = np.rint(100.0 + 9.0 * electrons)
    evidence = seen(frames)
    assert evidence.maps.usable[0, 4]
    assert evidence.z["tail.high.count"] < 3
    assert evidence.z["tail.low.count"] < 3


def test_offsets_of_frames_that_follow_some_rows_are_told_from_noise() -> None:
    camera = PlainCamera(0.25, 2.0, 9.0, (24, 24), 1500)
    frames = camera.frames(4).astype(np.float64)
    clamp = -0.3 * (frames[:, :4] - frames[:, :4].mean(axis=0)).mean(axis=(1, 2))
    noise = clamp.std() * np.random.default_rng(4).standard_normal(clamp.size)
    clamped, noisy = (
        seen(np.rint(frames + each[:, None, None]).astype(np.uint16)).z for each in (clamp, noise)
    )
    for z in (clamped, noisy):
        assert z["frame.readout.variance"] > 10
    assert clamped["frame.follows.line"] > 30 > 15 > noisy["frame.follows.line"]
