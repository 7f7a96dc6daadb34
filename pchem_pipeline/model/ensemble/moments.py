"""The moments of the ensemble (Appendix A), predicted and observed."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.model.ensemble.components import EnsembleMoments, moment_errors, predicted_moments
from pchem_pipeline.model.ensemble.totals import EnsembleTotals
from pchem_pipeline.model.law.parameters import UsablePixels

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


def moment_rows(
    totals: EnsembleTotals,
    pixels: UsablePixels,
    per_pixel: int | NDArray[Any],
    weight: FloatArray,
    *,
    extended: bool = False,
) -> list[dict[str, Any]]:
    """Return the moments of Appendix A, from the maps and from the data; terms have nothing to be observed.

    Where extended, mean and variance are those of the model's masses, and what effects and limits add to the
    variance of the parameters is a term of its own.

    Args:
        totals: the sums.
        pixels: the pixels.
        per_pixel: samples of each pixel.
        weight: of each pixel in Var(mu), see :func:`bias_weight`.
        extended: whether the model holds effects, or samples lie at the limits of the codes.
    """
    plain_ones, errors = predicted_moments(pixels, weight), moment_errors(pixels, per_pixel)
    expected = _extended_moments(totals, plain_ones) if extended else plain_ones
    share, dn = totals.mean("share"), totals.axes.dn.dn
    mean = float(share @ dn / share.sum())
    variance = float(share @ (dn - mean) ** 2 / share.sum())
    nuced_mean, nuced_square = (
        float(totals.mean(name)[0] / share.sum()) for name in ("nuced_sum", "nuced_sum_square")
    )
    observed = {"mean": mean, "variance": variance}
    observed |= {"nuced_mean": nuced_mean, "nuced_variance": nuced_square - nuced_mean**2}
    predicted = asdict(expected) | {"effects": expected.variance - plain_ones.variance}
    predicted["bias_signal_covariance"] *= 2.0
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


def _extended_moments(totals: EnsembleTotals, plain_ones: EnsembleMoments) -> EnsembleMoments:
    """Return the moments with those replaced that the effects of the model change."""
    mass, dn = totals.mean("pcd"), totals.axes.dn.dn
    whole = mass.sum()
    mean = float(mass @ dn / whole)
    nuced_mean, nuced_square = (
        float(totals.mean(f"nuced_predicted_{name}")[0] / whole) for name in ("sum", "sum_square")
    )
    return replace(
        plain_ones,
        mean=mean,
        variance=float(mass @ (dn - mean) ** 2 / whole),
        nuced_mean=nuced_mean,
        nuced_variance=nuced_square - nuced_mean**2,
    )
