"""PCH-EM in the plain form of the paper: starts in closed form, EM steps, a stop on small changes."""

from __future__ import annotations

import numpy as np

from pchem_pipeline.base.arrays import FloatArray, IndexArray, IntArray, IntegerArray
from pchem_pipeline.methods.base import Estimates, Method, PixelSamples, Sample
from pchem_pipeline.methods.settings import MethodsSettings
from pchem_pipeline.model.fit import engine, tile_numba
from pchem_pipeline.model.law.inputs import kernel_counts, pack
from pchem_pipeline.model.law.pcd import pcd_posterior
from pchem_pipeline.model.law.sample_law import SampleLaw

_CENTRAL_LOBE = 0.6  # 1/sd: the central lobe of any sample has fallen by then


class PlainEm(Method):
    """EM alone, eqs. (update_eqns) to (gamma_nk) of Hendrickson et al. 2023.

    One starting point in closed form; it stops when no parameter changes relatively by more than a tolerance
    from one step to the next, or after a number of steps. EM slows down with the read noise (its error falls
    by a factor near 1 per step above 0.4 e-), so there it stops early, still near its start; and it never
    leaves a local maximum that is off by one electron.
    """

    name = "plain_em"
    title = "PCH-EM, plain EM of the paper"
    source = "Hendrickson et al. 2023, eqs. (update_eqns) to (gamma_nk)"
    needs = "one sample"
    remark = "does not converge above about 0.4 e- read noise"
    order = 11

    def estimate(self, pixels: PixelSamples, settings: MethodsSettings) -> Estimates:
        """Return where EM stops, in the first sample."""
        sample = pixels.samples[0]
        start = closed_form_start(sample)
        parameters, steps = run_em(sample, start, False, settings)
        reasons = {
            "no starting point": ~np.isfinite(start[:, 1]),
            "EM left the allowed range": steps < 0,
            "stopped at the largest number of steps": steps == settings.em_iterations,
        }
        return Estimates.where(parameters, reasons)


def closed_form_start(sample: Sample) -> FloatArray:
    """Return the likeliest closed-form start of each pixel, (H, g, mu, sigma), shape (n, 4), or NaN."""
    return sample.likeliest(starting_points(sample.counts, sample.origin))


def starting_points(counts: IntegerArray, origin: IntegerArray) -> FloatArray:
    """Return two starting points (H, g, mu, sigma) of every pixel, shape (n, 2, 4); NaN where there is none.

    The empirical characteristic function of a PCD, ``phi(f) = mean exp(2 pi i f x)``, has
    ``log|phi| = -2 pi^2 f^2 sigma^2 - H (1 - cos 2 pi f / g)``, which is fitted by weighted least squares for
    a grid of gains (good for H < 15). The second start has g where ``|phi|`` is largest beyond its central
    lobe; ``phi(g) = exp(-2 pi^2 sigma^2 g^2 + 2 pi i mu g)`` then gives sigma and mu, the mean H.
    Of histograms, shape (n, B), with the DN of bin 0, shape (n,).
    """
    counts = kernel_counts(counts)
    n, n_bins = counts.shape
    given = tile_numba.Histograms(
        counts,
        np.array([0, n_bins], np.int64),
        np.asarray(origin, np.int64)[:, None],
        np.zeros(1, np.bool_),
        np.zeros((n, n_bins), np.uint8),
    )
    out = np.full((n, 2, 4), np.nan)
    tile_numba.start_tile(given, pack([SampleLaw()], n), engine.regression_basis(), out[:, 0])
    some = np.flatnonzero((counts > 0).sum(axis=1) > 2)
    out[some, 1] = _highest_lobe(counts[some].astype(np.float64), np.asarray(origin)[some])
    return out


def _highest_lobe(counts: FloatArray, origin: IntegerArray) -> FloatArray:
    """Compute (H, g, mu, sigma) from the highest side lobe of the characteristic function."""
    shares = counts / counts.sum(axis=1, keepdims=True)
    bins = np.arange(counts.shape[1])
    mean = shares @ bins
    variance = shares @ bins**2 - mean**2
    size = 8 * counts.shape[1]  # frequencies
    phi, frequency = np.fft.rfft(shares, size), np.fft.rfftfreq(size)
    modulus = np.abs(phi)
    modulus[frequency < _CENTRAL_LOBE / np.sqrt(variance)[:, None]] = 0.0
    modulus[:, 1:][modulus[:, 1:] < modulus[:, :-1]] = 0.0  # still falling
    place = modulus.argmax(axis=1)[:, None]
    gain, height = frequency[place[:, 0]], np.take_along_axis(modulus, place, 1)[:, 0].clip(1e-9, 0.999)
    phase = -np.angle(np.take_along_axis(phi, place, 1)[:, 0]) / (2.0 * np.pi)  # of mu g
    noise2 = -np.log(height) / (2.0 * np.pi**2)
    exposure = np.maximum(variance * gain**2 - noise2, 0.05)
    below = phase + np.round(mean * gain - exposure - phase)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.column_stack([mean * gain - below, gain, origin + below / gain, np.sqrt(noise2) / gain])


def run_em(
    sample: Sample, start: FloatArray, only_light: bool, settings: MethodsSettings
) -> tuple[FloatArray, IntArray]:
    """Run EM from (H, g, mu, sigma), shape (n, 4), NaN where there is no start.

    ``only_light``: bias and read noise are known, H and g are looked for.

    Returns:
        (H, g, mu, sigma), NaN without a result, and the steps taken (negative: out of range; 0: no start).
    """
    theta, steps = np.full(start.shape, np.nan), np.zeros(start.shape[0], np.int64)
    total = sample.counts.sum(axis=1)
    usable = np.isfinite(start).all(axis=1) & (start[:, [0, 1, 3]] > 0).all(axis=1)
    going = np.flatnonzero(usable & (total > 0))
    theta[going] = start[going]
    pixel, place = np.nonzero(sample.counts[going])
    share = sample.counts[going][pixel, place] / total[going][pixel]
    x = np.asarray(sample.origin[going][pixel] + place, np.float64)
    for step in range(1, settings.em_iterations + 1):
        if going.size == 0:
            break
        before = theta[going]
        after = _em_step(pixel, x, share, before, only_light)
        inside = (after[:, [1, 3]] > 0).all(axis=1) & (after[:, 0] > 1e-9) & (after[:, 0] < 1e6)
        inside &= after[:, 1] > 1e-6
        unit = np.stack([before[:, 0], after[:, 1], after[:, 3], before[:, 3]], axis=1)
        change = np.abs((after - before) / unit).max(axis=1)
        theta[going] = np.where(inside[:, None], after, np.nan)
        steps[going] = np.where(inside, step, -step)
        left = inside & (change >= settings.em_tolerance)
        kept, number = left[pixel], np.cumsum(left) - 1
        pixel, x, share, going = number[pixel[kept]], x[kept], share[kept], going[left]
    return theta, steps


def _em_step(
    pixel: IndexArray, x: FloatArray, share: FloatArray, theta: FloatArray, only_light: bool
) -> FloatArray:
    """Return (H, g, mu, sigma) after one EM step, eqs. (update_eqns); NaN where it is not defined.

    Each occupied code x, DN, has a share of the samples of its pixel.
    """

    def mean_of(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(pixel, share * values, len(theta)), np.float64)

    given = pcd_posterior(x, *theta[pixel].T)  # eq. (gamma_nk)
    mean = mean_of(x)
    off = x - mean[pixel]
    a, b, c = mean_of(given.k), mean_of(given.kk), mean_of(given.k * off)
    bias, sigma = theta[:, 2], theta[:, 3]
    with np.errstate(invalid="ignore", divide="ignore"):
        if only_light:
            step = (c + (mean - bias) * a) / b
        else:
            step = c / (b - a * a)
            bias = mean - a * step
            sigma = np.sqrt(mean_of(off**2) - (b - a * a) * step * step)
        return np.stack([a, 1.0 / step, bias, sigma], axis=1)
