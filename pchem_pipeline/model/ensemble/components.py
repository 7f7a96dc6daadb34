"""Moments of the ensemble and widths of its components.

Hendrickson et al. 2023, appendices sec:ensemble_dist_moments (A) and sec:ensemble_peak_resolution (B).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray, IntegerArray
from pchem_pipeline.model.ensemble.ensemble import EnsembleTotals, poisson_sums
from pchem_pipeline.model.law.parameters import UsablePixels

#: Expected number of samples of k electrons, in one frame of all pixels, below which their tails decide.
_FEW_ELECTRONS = 1e-12
_SYMBOLS = ("H", "g", "mu", "sigma2")

#: Parameters held constant in each of the sixteen cases of Appendix B, from none to all four.
COMPONENT_CASES: tuple[tuple[str, ...], ...] = tuple(
    sorted(
        (tuple(s for bit, s in enumerate(_SYMBOLS) if word >> bit & 1) for word in range(16)),
        key=lambda case: (len(case), [_SYMBOLS.index(symbol) for symbol in case]),
    )
)


#: Name, quantity and unit of each row; effects stand in that of an extended model only.
_MOMENTS = (
    ("mean", "mean of the raw ensemble", "DN"),
    ("variance", "variance of the raw ensemble", "DN2"),
    ("variance_of_bias", "of which variance of the bias", "DN2"),
    ("variance_of_signal", "of which variance of H/g", "DN2"),
    ("mean_read_variance", "of which read noise", "DN2"),
    ("mean_shot_variance", "of which shot noise", "DN2"),
    ("bias_signal_covariance", "of which twice the covariance of bias and H/g", "DN2"),
    ("effects", "of which effects and limits of the codes", "DN2"),
    ("nuced_mean", "mean of the NUCed ensemble", "e-"),
    ("nuced_variance", "variance of the NUCed ensemble", "e-2"),
)


def bias_weight(likelihood_gap: FloatArray) -> FloatArray:
    """Weight of pixels in statements on their bias, which may be an electron off.

    With a rival whose likelihood is lower by the factor ``exp(-gap)``, the posterior of the fit less that of
    the rival is ``w = tanh(gap / 2)``: 0 where both are as likely, 1 where there is no rival. The rival is
    right with the probability ``(1 - w) / 2``, and then the bias is off by one electron, 1/g: this adds
    ``(1 - w^2) / (4 g^2)`` to its variance, which is taken off.

    The gap is NaN where there is no runner-up. Weights are 1 throughout where no pixel has any.
    """
    weight = np.tanh(0.5 * np.nan_to_num(likelihood_gap, nan=np.inf))
    return np.asarray(weight if weight.any() else np.ones_like(weight))


def predicted_moments(pixels: UsablePixels, weight: FloatArray | None = None) -> dict[str, float]:
    """Mean and variance of the EPCD and the NUCed EPCD from the parameters, and their terms, by name.

    Hendrickson et al. 2023, Appendix A: ``E(E) = E(mu) + E(H/g)`` and ``Var(E) = Var(mu) + Var(H/g) +
    E(sigma^2) + E(H/g^2) + 2 Cov(mu, H/g)``; for the NUCed ensemble ``E(H)`` and ``Var(H) + E(H) +
    E(sigma_e-^2)``.

    Var(mu) has a weight for each pixel, see :func:`bias_weight`; None: all the same. The other moments need
    none: where the bias is an electron off, H is, too.
    """
    exposure, gain, bias, sigma = pixels.maps
    signal = exposure / gain
    covariance = float(np.mean((bias - bias.mean()) * (signal - signal.mean())))
    terms = (float(bias.var()), float(signal.var()), float(np.mean(sigma**2)), float(np.mean(signal / gain)))
    weight = np.ones(len(pixels)) if weight is None else weight
    mean_bias = np.average(bias, weights=weight)
    open_square = (bias - mean_bias) ** 2 - 0.25 * (1.0 - weight**2) / gain**2
    of_bias = max(float(np.average(open_square, weights=weight)), 0.0)
    return {
        "mean": float(bias.mean() + signal.mean()),
        "variance": sum(terms) + 2.0 * covariance,
        "nuced_mean": float(exposure.mean()),
        "nuced_variance": float(exposure.var() + exposure.mean() + np.mean(pixels.read_noise_e**2)),
        "variance_of_bias": of_bias,
        "variance_of_signal": terms[1],
        "mean_read_variance": terms[2],
        "mean_shot_variance": terms[3],
        "bias_signal_covariance": 2.0 * covariance,
    }


def moment_errors(pixels: UsablePixels, n_frames: int | IntegerArray) -> dict[str, float]:
    """Standard errors of the sample moments of the ensemble, the pixels given.

    A pixel's samples have variance v = sigma^2 + H/g^2, third central moment H/g^3 and fourth 3 v^2 + H/g^4.
    About the ensemble mean, from which the pixel lies off by d, ``Var((X - m)^2) = 3 v^2 + H/g^4 - v^2 +
    4 d H/g^3 + 4 d^2 v``. Frames are independent, so both add over samples.

    Each pixel counts the same, whatever its frames. Errors of ``mean`` (DN), ``variance`` (DN^2),
    ``nuced_mean`` (e-) and ``nuced_variance`` (e-^2).
    """
    exposure, gain, bias, sigma = pixels.maps
    errors: list[float] = []
    for step, offset, noise in ((1.0 / gain, bias, sigma), (1.0, 0.0, pixels.read_noise_e)):
        v = noise**2 + exposure * step**2
        centre = offset + exposure * step
        d = centre - centre.mean()
        of_square = 2 * v**2 + exposure * step**4 + 4 * d * exposure * step**3 + 4 * d**2 * v
        errors += [float(np.sqrt(np.mean(part / n_frames) / len(pixels))) for part in (v, of_square)]
    return dict(zip(("mean", "variance", "nuced_mean", "nuced_variance"), errors, strict=True))


def moment_rows(
    totals: EnsembleTotals,
    pixels: UsablePixels,
    per_pixel: int | NDArray[Any],
    weight: FloatArray,
    *,
    extended: bool = False,
) -> list[dict[str, Any]]:
    """Return the moments of Appendix A, from the maps and from the data; terms have nothing to be observed.

    Where ``extended`` (the model holds effects, or samples lie at the limits of the codes), mean and variance
    are those of the model's masses, and what this adds to the variance of parameters is a term of its own.
    Of each pixel the number of samples is given, and the weight in Var(mu), see :func:`bias_weight`.
    """
    predicted, errors = predicted_moments(pixels, weight), moment_errors(pixels, per_pixel)
    observed = _moments_of(totals, "share", "nuced_")
    if extended:
        of_law = _moments_of(totals, "pcd", "nuced_predicted_")
        predicted |= of_law | {"effects": of_law["variance"] - predicted["variance"]}
    return [
        {
            "name": name,
            "quantity": quantity,
            "unit": unit,
            "predicted": predicted[name],
            "observed": observed.get(name),
            "stderr": errors.get(name),
        }
        for name, quantity, unit in _MOMENTS
        if extended or name != "effects"
    ]


def _moments_of(totals: EnsembleTotals, name: str, prefix: str) -> dict[str, float]:
    """Return mean and variance, raw and NUCed, of what lies along the raw axis and of its NUCed sums."""
    share, dn = totals.mean(name), totals.axes.dn.dn
    whole = share.sum()
    mean = float(share @ dn / whole)
    nuced_mean, square = (float(totals.mean(f"{prefix}{of}")[0] / whole) for of in ("sum", "sum_square"))
    return {
        "mean": mean,
        "variance": float(share @ (dn - mean) ** 2 / whole),
        "nuced_mean": nuced_mean,
        "nuced_variance": square - nuced_mean**2,
    }


def component_widths(
    pixels: UsablePixels, n_k: int, weight: FloatArray | None = None
) -> dict[str, FloatArray]:
    """Mean and variance of the components ``E | K_e = k`` of the EPCD, in the sixteen cases of Appendix B.

    Under the weights ``e^{-H} H^k`` (eq. EPCD_alt_form), ``Var(E|K_e=k) = E(sigma^2) + Var(mu) + 2 k
    Cov(mu, 1/g) + k^2 Var(1/g)``. Holding g, mu or sigma^2 at the mean of its map removes its terms
    (sigma^2 leaves its mean); holding H makes the weights equal. Each pixel has a weight, (n,), see
    :func:`bias_weight`; None: all the same. Where all have H = 0, moments of components k > 0 are NaN.

    Returns:
        ``component_mean``, E(E|K_e=k), DN, shape (n_k,); ``component_variance``, DN^2, shape (16, n_k), rows
        in the order of ``COMPONENT_CASES``; ``nuced_component_variance``, Var(E'|K_e=k), e-^2, shape (n_k,).
    """
    exposure, gain, bias, sigma = pixels.maps
    step = 1.0 / gain
    centres = (float(bias.mean()), float(step.mean()))
    mu, a = bias - centres[0], step - centres[1]
    weight = np.ones(len(pixels)) if weight is None else weight
    bias_square = mu * mu - 0.25 * (1.0 - weight**2) * step**2
    table = np.stack([sigma**2, mu, a, bias_square, mu * a, a * a, pixels.read_noise_e**2], axis=1)
    constant_h = np.average(table, axis=0, weights=weight)
    moments = _weighted_moments(exposure, table, weight, n_k)
    mean, nuced, variance = np.empty(n_k), np.empty(n_k), np.empty((len(COMPONENT_CASES), n_k))
    for k, weighted in enumerate(moments):
        mean[k] = centres[0] + weighted[1] + k * (centres[1] + weighted[2])
        nuced[k] = weighted[6]
        for row, case in enumerate(COMPONENT_CASES):
            chosen = constant_h if "H" in case else weighted
            variance[row, k] = _case_variance(chosen, case, k, float(constant_h[0]))
    return {"component_mean": mean, "component_variance": variance, "nuced_component_variance": nuced}


def _weighted_moments(exposure: FloatArray, table: FloatArray, weight: FloatArray, n_k: int) -> FloatArray:
    """Return the means of the columns of a table of pixels, weighted with w P(K = k), (n_k, columns)."""
    columns = np.column_stack([weight, table * weight[:, None]])
    sums = poisson_sums(exposure, columns, n_k)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = sums[:, 1:] / sums[:, :1]
        log_exposure = np.log(exposure)
    for k in np.flatnonzero(sums[:, 0] < _FEW_ELECTRONS):  # the ratios of the weights are left
        log_weight = (k * log_exposure if k else 0.0) - exposure
        largest = log_weight[weight > 0.0].max(initial=-np.inf)
        found[k] = np.nan
        if np.isfinite(largest):  # pixels without a weight may lie above
            of_k = np.exp(np.minimum(log_weight - largest, 0.0))
            found[k] = of_k @ columns[:, 1:] / (of_k @ weight)
    return found


def _case_variance(moments: FloatArray, case: tuple[str, ...], k: int, mean_variance: float) -> float:
    """Put Var(E|K_e=k) together from weighted moments, without the terms of what is held constant."""
    read, mu, a, mu_mu, mu_a, a_a = (float(value) for value in moments[:6])
    total = mean_variance if "sigma2" in case else read
    if "mu" not in case:
        total += max(mu_mu - mu * mu, 0.0)
    if "g" not in case:
        total += k * k * (a_a - a * a)
        if "mu" not in case:
            total += 2 * k * (mu_a - mu * a)
    return total
