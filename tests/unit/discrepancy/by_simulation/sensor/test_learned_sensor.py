"""Sensors for simulations and sensors that a search learns: pixels scatter as the true parameters do."""

from dataclasses import replace
from typing import ClassVar, Literal

import numpy as np
import pytest
from helpers.plain_camera import PlainCamera
from helpers.small_sensors import context_of
from helpers.small_sensors import seen as seen_in
from scipy import stats

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.discrepancy.by_simulation.candidates.candidates import serial
from pchem_pipeline.discrepancy.by_simulation.frames.frame_stack import FrameStack
from pchem_pipeline.discrepancy.by_simulation.frames.observed import ObservedFrames
from pchem_pipeline.discrepancy.by_simulation.sensor.maps import (
    MANY_MISTAKEN,
    NotFittedError,
    Refit,
    learn_sensor,
    refit_maps,
)
from pchem_pipeline.discrepancy.by_simulation.sensor.population import posterior_of, posterior_of_estimates
from pchem_pipeline.discrepancy.by_simulation.sensor.replicate import (
    Acquisition,
    Replicate,
    by_part,
    simulate_frames,
    truth_of,
)
from pchem_pipeline.discrepancy.by_simulation.sensor.simulations import Simulations
from pchem_pipeline.discrepancy.effort import Effort
from pchem_pipeline.discrepancy.splits import block_length, split_frames
from pchem_pipeline.effects.framework.compose import added_exposures
from pchem_pipeline.effects.framework.effect import Effect, Plane
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.effects.operators.curve import AdcInl
from pchem_pipeline.effects.operators.fate import OverdispersedCounts
from pchem_pipeline.effects.operators.light import Persistence
from pchem_pipeline.effects.operators.noise import HeavyTailedNoise, NoiseSkew
from pchem_pipeline.effects.operators.offsets import RowNoise
from pchem_pipeline.effects.operators.replace import PixelCorrection
from pchem_pipeline.model.fit.shared import to_theta

SPREAD = (0.25, 0.015, 0.06, 3.0)


def logs(maps, some):
    every = (maps.quanta_exposure, maps.conversion_gain, maps.bias, maps.read_noise_dn)
    return to_theta(np.stack([values[some] for values in every], axis=1))


def logs_error(seen, some):
    """Return the standard errors of the same, of the plain fits, (n, 4)."""
    maps, error = seen.maps, np.sqrt(np.diagonal(seen.covariance[some], axis1=1, axis2=2))
    slope = [1 / maps.quanta_exposure, 1 / maps.conversion_gain, np.ones(some.shape), 2 / maps.read_noise_dn]
    found = error * np.stack([each[some] for each in slope], axis=1)
    return found[np.isfinite(found).all(axis=1)]


def truth_in_logs(camera, seed):
    """Return the parameters of a camera's pixels as a fit has them, (row, column, 4)."""
    exposure, step, bias, noise = camera.maps(np.random.default_rng(seed))
    return np.stack([np.log(exposure), np.log(step), bias, 2 * np.log(noise * step)], axis=-1)


def learnt_from(frames):
    """Return the fits' evidence of frames, and the sensor learnt from them."""
    seen = seen_in(frames)
    fit = Refit(seen.maps, {}, seen.covariance)
    return seen, learn_sensor(frames, np.arange(len(frames)), fit, (), seen.ambiguous)


def learnt(camera, seed):
    """Return the truth (n, 4), the fits' evidence, and the sensor learnt from the same frames."""
    return truth_in_logs(camera, seed), *learnt_from(camera.frames(seed))


def test_bright_pixels_find_their_gain_under_a_strong_effect():
    """Light that varies by a third blurs their peaks; from the plain fits alone 21 % have a wrong gain."""
    camera = PlainCamera(0.3, 5.0, 10.0, (12, 12), 1500, SPREAD)
    exposure, step, bias, noise = camera.maps(np.random.default_rng(4))
    rng, shape, width = np.random.default_rng(5), (1500, 12, 12), np.sqrt(np.log1p(0.1))
    light = exposure * np.exp(width * rng.standard_normal(shape) - 0.5 * width**2)
    values = bias + step * (rng.poisson(light) + noise * rng.standard_normal(shape))
    frames = np.rint(values).astype(np.uint16)
    seen = seen_in(frames)
    effect = OverdispersedCounts(relative_variance=0.1, exposures="lognormal")
    fit = refit_maps(frames, seen.maps, [effect], seen.covariance)
    off = np.log(fit.maps.conversion_gain * step)[fit.maps.usable]
    assert np.mean(np.abs(off) > 0.1) < 0.16


def test_a_poor_sensor_with_a_bent_curve_is_learnt_under_its_law():
    """Cumulants of all pixels, where poor sensors begin, take the bend for light: 0.24 in log H."""
    camera = PlainCamera(0.38, 2.5, 15.0, (16, 16), 1500, SPREAD)
    exposure, step, bias, noise = camera.maps(np.random.default_rng(4))
    rng, shape = np.random.default_rng(5), (1500, 16, 16)
    effect = AdcInl(inl_lsb=1.5, period_dn=120.0)
    values = bias + step * (rng.poisson(exposure, shape) + noise * rng.standard_normal(shape))
    frames = np.rint(values + 1.5 * np.sin(2 * np.pi * values / 120.0)).astype(np.uint16)
    seen = seen_in(frames)
    fit = refit_maps(frames, seen.maps, [effect], seen.covariance)
    sensor = learn_sensor(frames, np.arange(1500), fit, [effect], MANY_MISTAKEN + 0.1)
    off = logs(sensor.draw(1), sensor.drawn)[:, 0] - np.log(exposure[sensor.drawn])
    assert abs(np.median(off)) < 0.05


@pytest.mark.parametrize(
    "effect",
    [
        PixelCorrection(threshold_dn=32, region=Region(columns=((0, 10),))),
        PixelCorrection(threshold_dn=28, share=0.6, predictor="mean"),
        PixelCorrection(threshold_dn=18),
    ],
)
def test_a_sensor_is_learnt_from_corrected_samples(effect):
    """A camera replaces samples by the median of their neighbours: plain fits take that for less light.

    From 1.5 electrons above it on most plain fits are ambiguous, and cumulants of all pixels no start.
    """
    camera = PlainCamera(0.3, 1.5, 12.0, (20, 20), 1500, SPREAD)
    truth, before, numbers = truth_in_logs(camera, 6), camera.frames(6), np.arange(1500)
    inside = np.zeros((20, 20), bool)
    inside[1:-1, 1 : -1 if effect.region is None else 10] = True
    frames = np.where(inside, effect.apply(before, context_of((20, 20), 1500)), before)
    seen = seen_in(frames)
    fit = Refit(seen.maps, {}, seen.covariance)
    sensor = learn_sensor(frames, numbers, fit, [effect], seen.ambiguous, before=before)
    some = sensor.drawn & inside
    error, both = np.median(logs_error(seen, some), axis=0), some & seen.maps.usable
    off = (logs(sensor.draw(1), some) - truth[some]) / error
    plain = (logs(seen.maps, both) - truth[both]) / error
    limit = 5 * 1.25 * np.sqrt(2 / some.sum())
    assert (np.abs(np.median(off, axis=0)) < limit).all()
    assert (np.abs(np.median(plain, axis=0))[:2] > 2 * limit).all()


def test_pixels_of_a_noisy_sensor_scatter_as_the_true_ones():
    """At 0.5 e- and 600 frames the fits scatter several times as much in gain and noise as the truth does."""
    truth, seen, sensor = learnt(PlainCamera(0.5, 1.5, 12.0, (24, 24), 600, SPREAD), 3)
    truth, drawn = truth[sensor.drawn], logs(sensor.draw(1), sensor.drawn)
    spread, real, of_fits = (each.std(axis=0) for each in (drawn, truth, logs(seen.maps, seen.maps.usable)))
    assert (of_fits > 3 * real)[[1, 3]].all()
    assert (spread > 0.6 * real).all()
    assert (spread < np.minimum(4 * real, of_fits)).all()
    # the middle of all pixels lies within its error
    far = sensor.posterior.population.centre - np.median(truth, axis=0)
    assert (np.abs(far) < 4 * np.sqrt(np.diag(sensor.posterior.population.uncertainty))).all()
    # and it is the same pixel that is bright or has a high bias
    assert all(np.corrcoef(drawn[:, i], truth[:, i])[0, 1] > 0.7 for i in (0, 2))


def test_pixels_of_a_sharp_sensor_stay_what_they_are():
    _, seen, sensor = learnt(PlainCamera(0.22, 1.5, 12.0, (16, 16), 1500, SPREAD), 4)
    some = seen.maps.usable
    error = np.sqrt(np.diagonal(seen.covariance[some], axis1=1, axis2=2))
    off = (sensor.draw(1).bias - seen.maps.bias)[some] / error[:, 2]
    assert abs(off.mean()) < 5 / np.sqrt(off.size)
    # drawn within the error of the fit
    assert 0.7 < off.std() < 1.3
    assert (sensor.usual(1).usable == some).all()


def test_bright_pixels_under_a_lens_are_learnt_though_a_third_may_be_an_electron_off():
    """Their peaks are sharp; drawn as alike in exposure, two in three were electrons off."""
    camera = PlainCamera(0.2, 18.0, 17.0, (12, 20), 1500, SPREAD, "vignetted")
    truth, seen, sensor = learnt(camera, 8)
    assert seen.ambiguous > MANY_MISTAKEN
    off = (seen.maps.bias - truth[..., 2]) * np.exp(-truth[..., 1])
    drawn = sensor.draw(3)
    left = (drawn.bias - truth[..., 2]) * np.exp(-truth[..., 1])
    wrong, before = (np.mean(np.abs(each[drawn.usable]) > 0.5) for each in (left, off))
    assert wrong < before + 5 * np.sqrt(before * (1 - before) / truth[..., 0].size)
    gain = np.log(drawn.conversion_gain[drawn.usable]) + truth[..., 1][drawn.usable]
    assert abs(np.median(gain)) < 0.002


def test_a_sensor_of_three_kinds_of_pixels_is_learnt():
    """Each kind stands out in another cumulant: none of them is left out for it."""
    codes, electrons = np.arange(2000), np.arange(200)
    kinds = ((96.5, 1.19, 7.89), (0.00903, 12.1, 20.0), (0.277, 3.84, 13.96))  # e-, DN per e-, DN
    counts = [
        1e9 * stats.poisson.pmf(electrons, h) @ stats.norm.pdf(codes, 900 + g * electrons[:, None], noise)
        for h, g, noise in kinds
    ]
    counts = np.rint(np.repeat(counts, 4, axis=0)).astype(np.uint32)
    nothing = np.full((12, 4), np.nan)
    drawn = posterior_of(counts, np.zeros(12, np.int64), nothing).draw(np.random.default_rng(1))
    assert np.isfinite(drawn).all()


class Lawless(RowNoise):
    def sample_law(self, model, maps):
        raise ConfigError("no law")


def test_a_sensor_of_which_no_pixel_is_known_is_not_learnt():
    _, seen, sensor = learnt(PlainCamera(0.22, 1.5, 12.0, (8, 8), 400, SPREAD), 4)
    none = replace(seen.maps, usable=np.zeros((8, 8), np.bool_))
    with pytest.raises(NotFittedError, match="no pixel"):
        sensor.corrected(seen.maps, none)
    unknown = Refit(seen.maps, {}, np.full((8, 8, 4, 4), np.nan))
    for effects in ((Lawless(row_noise_dn=1.0),), ()):
        with pytest.raises(NotFittedError, match="no pixel"):
            learn_sensor(np.zeros((8, 8, 8), np.uint16), np.arange(8), unknown, effects, 0.0)


def test_errors_of_estimates_are_taken_off():
    rng = np.random.default_rng(5)
    n, size = 3000, np.array([0.1, 0.03, 0.5, 0.1])
    truth = np.array([0.5, 2.4, 100.0, 2.5]) + np.array([0.3, 0.02, 0.5, 0.1]) * rng.standard_normal((n, 4))
    scale = rng.uniform(0.5, 1.5, n)
    theta = truth + scale[:, None] * size * rng.standard_normal((n, 4))
    parameters = np.stack(
        [np.exp(theta[:, 0]), np.exp(-theta[:, 1]), theta[:, 2], np.sqrt(np.exp(theta[:, 3]) + 1 / 12)],
        axis=1,
    )
    slope = np.stack([parameters[:, 0], -parameters[:, 1], np.ones(n), 0.5 * parameters[:, 3]], axis=1)
    covariance = np.einsum("na,ab->nab", (scale[:, None] * size * slope) ** 2, np.eye(4))
    drawn = to_theta(posterior_of_estimates(parameters, covariance).draw(rng))
    # the variance of C = T + E scatters by sqrt(2/n) of itself, and E is taken off
    limit = 5 * np.sqrt(2 / n) * theta.var(axis=0)
    assert (np.abs(drawn.var(axis=0) - truth.var(axis=0)) < limit).all()
    assert (np.abs(theta.var(axis=0) - truth.var(axis=0)) > limit)[1:].all()


def test_a_replicate_mistakes_as_many_biases_as_the_frames_do():
    """Begun at the truth, hardly a fit is an electron off; treated as the data are, as many as of frames."""
    rng, ones, numbers = np.random.default_rng(5), np.ones((32, 32)), np.arange(600)
    bias = 100 + rng.standard_normal((32, 32))
    maps = PixelMaps(2.7 * ones, ones / 11, bias, 0.41 * 11 * ones, ones > 0)
    known = Acquisition(numbers, 1200, 50, 12)
    anew = replace(known, other=np.arange(600, 1200))
    truth = truth_of(maps).bias

    def mistaken(taken, seed):
        found = next(Replicate("x", maps, (), seed, taken).observed())[2].maps
        return np.mean(np.abs(found.bias - truth)[found.usable] > 0.5 * 11)

    assert mistaken(known, 1) < 0.005
    first, second = mistaken(anew, 1), mistaken(anew, 2)
    assert first > 0.03
    # two binomial shares
    assert abs(first - second) < 5 * np.sqrt(2 * first * (1 - first) / maps.usable.sum())
    # the frames of a split do not depend on what else is simulated
    both = simulate_frames(maps, (), 1, Acquisition(np.arange(1200), 1200, 50, 12))
    assert (simulate_frames(maps, (), 1, known) == both[:600]).all()


def test_a_replicate_of_two_parts_has_the_statistics_of_both():
    ones = np.ones((16, 16))
    maps = PixelMaps(1.5 * ones, ones / 10, 100 * ones, 3.0 * ones, ones > 0)
    taken = Acquisition(np.arange(200), 400, 20, 12)
    both = replace(taken, other=np.arange(200, 400))
    [alone], [first, second] = (by_part(Replicate("x", maps, (), 1, each)()) for each in (taken, both))
    assert alone.keys() == first.keys() == second.keys()
    assert first["shape.C2.mean"] != pytest.approx(second["shape.C2.mean"])


def test_read_noise_that_the_fit_takes_for_signal_is_given_back():
    """Where peaks overlap every pixel's sigma_R comes out low; histograms drawn again tell by how much."""
    truth, _, sensor = learnt(PlainCamera(0.4, 1.5, 8.0, (26, 26), 1500, SPREAD), 8)

    def off(posterior):
        drawn = to_theta(posterior.draw(np.random.default_rng(1)))[:, 3]
        return drawn - truth[sensor.drawn][:, 3]

    after = off(sensor.posterior)
    # of the median, and of what was learnt again from 500 pixels
    error = 1.25 * 1.48 * np.median(np.abs(after - np.median(after))) * np.hypot(1 / 26, 1 / np.sqrt(500))
    assert np.median(off(sensor.posterior.moved(np.array([0.0, 0.0, 0.0, -sensor.lost])))) < -3.0 * error
    assert abs(np.median(after)) < 3.0 * error


class ColumnMemory(Effect):
    """A part of the row read before stays on the column; the law of a pixel does not know of it."""

    tag: Literal["column_memory"] = "column_memory"
    plane: ClassVar[Plane] = Plane.ADC
    share: float = 0.12

    def halo(self):
        return 1

    def apply(self, values, context):
        result = values.copy()
        result[:, 1:] += self.share * values[:, :-1]
        return result


def test_a_sensor_is_moved_to_another_law_as_the_fits_of_its_pixels_are():
    """Row noise in half of the columns is in their plain read noise; under its law each pixel has its own."""
    camera, rng = PlainCamera(0.3, 2.5, 12.0, (20, 20), 1500, SPREAD), np.random.default_rng(5)
    truth, noisy = truth_in_logs(camera, 4), np.tile(np.arange(20) < 10, (20, 1))
    frames = camera.frames(4) + np.rint(noisy * 2.5 * rng.standard_normal((1500, 20, 1)))
    frames = frames.astype(np.uint16)
    seen, plain = learnt_from(frames)
    effect = RowNoise(row_noise_dn=2.5, region=Region(columns=((0, 10),)))
    fit = refit_maps(frames, seen.maps, [effect], seen.covariance)
    sensor = plain.refitted(seen.maps, fit.maps)
    assert (sensor.usable == fit.maps.usable).all()

    def off(one, columns):
        some = one.drawn & columns
        apart = logs(one.draw(1), some) - truth[some]
        return np.median(apart, axis=0), 5 * 1.25 * apart.std(axis=0) / np.sqrt(len(apart))

    for columns in (noisy, ~noisy):
        median, limit = off(sensor, columns)
        assert (np.abs(median) < limit).all()
    median, limit = off(plain, noisy)
    assert median[3] > 2 * limit[3]
    with pytest.raises(NotFittedError, match="no pixel"):
        plain.refitted(seen.maps, replace(fit.maps, usable=np.zeros((20, 20), np.bool_)))


def test_what_an_effect_without_a_law_adds_is_not_simulated_twice():
    """Its variance is in the fitted read noise; with the effect on top there would be too much of it."""
    camera, effect = PlainCamera(0.25, 1.5, 12.0, (20, 20), 900, SPREAD), ColumnMemory()
    truth = camera.maps(np.random.default_rng(9))[3]
    frames = camera.frames(9).astype(float)
    frames[:, 1:] += effect.share * frames[:, :-1]
    seen, sensor = learnt_from(np.rint(frames).astype(np.uint16))
    taken = Acquisition(np.arange(len(frames)), len(frames), 50, 12)

    def too_noisy(one):
        drawn = one.draw(4)
        noise = np.log(drawn.read_noise_dn * drawn.conversion_gain / truth)[1:][drawn.usable[1:]]
        return np.median(noise), 1.25 * noise.std() / np.sqrt(noise.size)

    before, error = too_noisy(sensor)
    assert before > 5.0 * error
    again = Replicate("fitted", sensor.draw(5), (effect,), 5, taken).fitted()
    after, error = too_noisy(sensor.corrected(seen.maps, again))
    assert abs(after) < max(3.0 * error, before / 5.0)


def test_exposure_that_an_effect_adds_to_a_spot_is_not_simulated_twice():
    """A ghost of 1.5 e-, fading over the run: half of it would be in the exposure of the pixels, too."""
    camera = PlainCamera(0.25, 1.5, 12.0, (20, 20), 900, SPREAD)
    effect = Persistence(peak_e=1.5, decay_frames=450)
    rng = np.random.default_rng(11)
    exposure, step, bias, noise = camera.maps(rng)
    y, x = np.mgrid[:20, :20]
    spot = np.exp(-0.5 * ((y + 0.5 - 10) ** 2 + (x + 0.5 - 10) ** 2) / 4.0**2)
    ghost = effect.peak_e * np.exp(-np.arange(900) / 450)[:, None, None] * spot
    electrons = rng.poisson(exposure + ghost) + noise * rng.standard_normal(ghost.shape)
    frames = np.rint(bias + step * electrons).astype(np.uint16)
    numbers = np.arange(900)
    seen = seen_in(frames)
    added = added_exposures([effect], frames, numbers, seen.maps)
    bright = spot > 0.5

    def too_bright(added):
        fit = refit_maps(frames, seen.maps, [effect], seen.covariance, added, numbers)
        sensor = learn_sensor(frames, numbers, fit, [effect], seen.ambiguous)
        drawn = np.mean([sensor.draw(seed).quanta_exposure for seed in range(4)], axis=0)
        return (drawn - exposure)[bright & sensor.usable]

    before, after = too_bright(None), too_bright(added)
    error = after.std() / np.sqrt(after.size)
    assert abs(after.mean()) < 4.0 * error
    assert before.mean() > 8.0 * error
    assert after.std() < 0.5 * before.mean()


def test_a_bias_that_the_plain_fit_has_off_by_an_electron_is_found_under_the_right_law():
    """Noise with a long tail to low DN has a peak more to the plain law: bias and exposure are off by one."""
    camera = PlainCamera(0.32, 2.5, 14.0, (8, 8), 900, SPREAD)
    rng, share = np.random.default_rng(6), 0.94
    exposure, step, bias, noise = camera.maps(rng)
    shape = (900, 8, 8)
    late = rng.standard_exponential(shape) - 1
    skewed = np.sqrt(1 - share**2) * rng.standard_normal(shape) - share * late
    frames = np.rint(bias + step * (rng.poisson(exposure, shape) + noise * skewed)).astype(np.uint16)
    seen = seen_in(frames)
    fit = refit_maps(frames, seen.maps, [NoiseSkew(share=-share)], seen.covariance)

    def off(maps):
        return np.abs(maps.quanta_exposure - exposure)[maps.usable] > 0.5

    assert np.mean(off(seen.maps)) > 0.2
    assert np.mean(off(fit.maps)) < 0.03


def test_one_sample_far_below_all_others_leads_no_pixel_astray_under_a_law_that_has_such_samples():
    """Where 5 % of the pixels had their bias off by electrons, tails came out as wide as half the truth."""
    camera, rng = PlainCamera(0.25, 3.5, 13.0, (16, 16), 750, SPREAD), np.random.default_rng(2)
    exposure, _, bias, _ = camera.maps(np.random.default_rng(7))
    frames = camera.frames(7)
    struck = rng.random((16, 16)) < 0.3
    depth = rng.uniform(2.5, 4.5, int(struck.sum()))  # e- below the bias
    frames[300][struck] = np.rint(bias[struck] - 13.0 * depth)
    seen = seen_in(frames)
    tails = HeavyTailedNoise(share=0.001, factor=12.0)
    fit = refit_maps(frames, seen.maps, [tails], seen.covariance)

    def off(maps):
        return (np.abs(maps.quanta_exposure - exposure) > 0.5) & maps.usable

    assert np.mean(off(seen.maps)[struck]) > 0.5
    assert np.mean(off(fit.maps)[struck]) < 0.05
    assert not np.any(off(fit.maps)[~struck])


def test_parameters_move_by_the_pixels_that_an_effect_is_about():
    """Row noise in two of eight columns takes a part of their read noise, and moves no median of all."""
    camera, rng = PlainCamera(0.3, 2.0, 12.0, (8, 8), 900), np.random.default_rng(3)
    frames = camera.frames(4).astype(np.int64)
    frames[:, :, 6:] += np.rint(2.5 * rng.standard_normal((900, 8, 1))).astype(np.int64)
    frames = np.maximum(frames, 0).astype(np.uint16)
    seen = seen_in(frames)
    noise = RowNoise(row_noise_dn=2.5, region=Region(columns=((6, 8),)))
    fit = refit_maps(frames, seen.maps, [noise], seen.covariance)
    # 12 x 0.3 = 3.6 DN of read noise, and 4.4 with 2.5 more
    error = 4.4 / np.sqrt(2 * 900 * 16)
    moved = fit.moved["read_noise_dn"].median
    assert moved < -0.5
    assert abs(moved + (np.hypot(3.6, 2.5) - 3.6)) < 10 * error
    beside = fit.maps.read_noise_dn[:, :6] - seen.maps.read_noise_dn[:, :6]
    assert abs(np.median(beside)) < error


def test_what_stands_in_for_replaced_samples_is_drawn_from_the_model():
    """Where a tenth of the samples are replaced, medians of what was seen lie too low: 0.04 in log H."""
    shape, n = (20, 20), 1500
    camera = PlainCamera(0.25, 1.5, 12.0, shape, n, (0.25, 0.015, 0.06, 3.0))
    exposure, *_ = camera.maps(np.random.default_rng(6))
    effect, numbers = PixelCorrection(threshold_dn=24), np.arange(n)
    frames = effect.apply(camera.frames(6), context_of(shape, n))
    splits = split_frames(numbers, block_length(n, None))
    observed = ObservedFrames.of(FrameStack(frames, numbers, splits, n, 10, 1.0))
    work = Simulations(observed, serial, 1, Effort(None))
    found = work.mapped((effect,))
    # one stack for what stands in, one whose fits are compared with those of the frames
    assert work.effort.replicates == 2
    seen = work.frames.seen_stack, work.frames.seen_numbers
    by_seen = learn_sensor(*seen, found.fit, (effect,), observed.plain.ambiguous, found.sensor.lost)

    def off(sensor):
        some = sensor.drawn.copy()
        some[[0, -1]] = some[:, [0, -1]] = False
        ratio = np.log(sensor.draw(1).quanta_exposure[some] / exposure[some])
        return abs(np.median(ratio)), 5 * 1.25 * ratio.std() / np.sqrt(ratio.size)

    median, limit = off(found.sensor)
    assert median < limit
    assert off(by_seen)[0] > 1.5 * limit
