"""The mass of an extended law written out term by term, and laws that use every part of it."""

import math

import mpmath
import numpy as np

from pchem_pipeline.model.law.sample_law import SampleLaw

EVERYTHING = (
    SampleLaw()
    .with_exposures([0.3, 0.7], [1.2, (1 - 0.36) / 0.7])
    .with_added_exposure([[0.0, 0.4, 1.1]], [[0.5, 0.3, 0.2]])
    .with_noise(
        [0.2, 0.5, 0.3],
        shift_sigma=[-0.5, 0.1, 0.4],
        shift_dn=[0.3, -0.2, 0.0],
        shift_e=[0.1, 0.0, -0.05],
        width=[0.8, 1.0, 1.2],
    )
    .with_levels(scale=1.01, shift_e=0.1, curvature=0.01)
    .with_variance(dn2=0.3, e2=0.01, per_electron=0.01, per_electron2=0.002)
    .with_edges(95, 0.1 * np.sin(np.arange(40.0)))
)

LAWS = {
    "neutral": SampleLaw(),
    "negative_binomial": SampleLaw().with_counts("negative_binomial", 0.05),
    "hardly_dispersed": SampleLaw().with_counts("negative_binomial", 2e-4),
    "borel": SampleLaw().with_counts("borel", 0.1),
    "mixture": SampleLaw().with_exposures([0.5, 0.5], [0.8, 1.2]),
    "added": SampleLaw().with_added_exposure([[0.0, 0.8]], [[0.6, 0.4]]),
    "skew": SampleLaw().with_noise([0.7, 0.3], shift_sigma=[-0.3, 0.7], width=0.9),
    "variance": SampleLaw().with_variance(dn2=0.5, e2=0.01, per_electron=0.02, per_electron2=0.003),
    "levels": SampleLaw().with_levels(scale=0.98, shift_e=0.2, curvature=0.02),
    "clip": SampleLaw().with_clip(97, 130),
    "edges": SampleLaw().with_edges(90, 0.2 * np.sin(np.arange(30.0))),
    "everything": EVERYTHING,
    "everything_branching_clipped": EVERYTHING.with_counts("borel", 0.07).with_clip(93, 150),
}


def electron_mass(model: SampleLaw, k: int, exposure: float) -> float:
    """P(k), from the textbook formulas."""
    a = model.dispersion
    if model.law == "negative_binomial" and a:
        r = 1 / a
        # with more digits: the gamma functions cancel where a is small
        with mpmath.workdps(30):
            log = float(mpmath.loggamma(k + r) - mpmath.loggamma(r)) - math.lgamma(k + 1)
        return math.exp(log - r * math.log1p(exposure / r) + k * math.log(exposure / (r + exposure)))
    if model.law == "borel" and a:
        theta = exposure * (1 - a)
        return math.exp(
            math.log(theta) + (k - 1) * math.log(theta + k * a) - theta - k * a - math.lgamma(k + 1)
        )
    return math.exp(k * math.log(exposure) - exposure - math.lgamma(k + 1))


def lower_edge(model: SampleLaw, code: int) -> float:
    """Where a code begins, DN."""
    if model.clip_low is not None and code <= model.clip_low:
        return -math.inf
    if model.clip_high is not None and code > model.clip_high:
        return math.inf
    i = code - model.edge_first
    return code - 0.5 + (model.edge_shift[i] if 0 <= i < model.edge_shift.size else 0.0)


def reference_mass(model: SampleLaw, parameters: tuple[float, ...], codes: range) -> list[float]:
    """The docstring of SampleLaw, sum by sum, for one pixel."""
    exposure, gain, bias, sigma = parameters
    analog = math.sqrt(sigma**2 - 1 / 12)
    satellites = [
        getattr(model, f"satellite_{name}")[0]
        for name in ("weights", "shift_e", "shift_dn", "shift_sigma", "width")
    ]
    parts = []
    for k in range(int(exposure + 20 * math.sqrt(exposure) + 60)):
        weight = sum(
            w * u * electron_mass(model, k, exposure * f + d)
            for w, f in zip(model.exposure_weights, model.exposure_factors, strict=True)
            for u, d in zip(model.added_weights[0], model.added_exposure[0], strict=True)
        )
        level = model.level_scale[0] * k * (1 + model.curvature * (k - 1) / 2) + model.level_shift_e[0]
        for w, shift_e, shift_dn, shift_sigma, width in zip(*satellites, strict=True):
            mean = bias + (level + shift_e) / gain + shift_dn + shift_sigma * analog
            extra = model.extra_variance_e2[0] + model.variance_per_electron * k
            extra += model.variance_per_electron2 * k**2
            variance = (width * analog) ** 2 + extra / gain**2 + model.extra_variance_dn2[0]
            parts.append((weight * w, mean, math.sqrt(variance)))

    def between(low: float, high: float) -> float:
        total = 0.0
        for weight, mean, sd in parts:
            a, b = (low - mean) / sd / math.sqrt(2), (high - mean) / sd / math.sqrt(2)
            # whichever tail is smaller keeps the digits
            cell = math.erfc(a) - math.erfc(b) if a > 0 else math.erfc(-b) - math.erfc(-a)
            total += 0.5 * weight * cell
        return total

    return [between(lower_edge(model, code), lower_edge(model, code + 1)) for code in codes]
