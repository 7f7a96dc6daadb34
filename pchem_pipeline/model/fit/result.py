"""What a fit finds of a batch of pixels, and the names and quantiles of confidence intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from pchem_pipeline.base.arrays import FloatArray, IndexArray
from pchem_pipeline.model.fit.status import describe
from pchem_pipeline.model.law.parameters import PixelParameters

#: Fits that a notebook shows.
_SHOWN = 10


def html_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in HTML; every cell is text."""
    cells = [f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows]
    top = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    return f"<table><thead><tr>{top}</tr></thead><tbody>{''.join(cells)}</tbody></table>"


@dataclass(frozen=True)
class FitResult(PixelParameters):
    """Estimates of a batch of ``n`` pixels; failed pixels hold NaN and a reason in ``fit_status``.

    With several exposures of the same pixels, arrays of shape (n, J) have a column for each; with one
    histogram for each pixel they are of shape (n,).

    Attributes:
        quanta_exposure: H, e-, shape (n, J) or (n,); 0 for samples without electrons.
        conversion_gain: g, e-/DN, shape (n,).
        bias: mu, DN, shape (n,).
        read_noise_dn: sigma, DN, quantisation included, shape (n,); under a law with effects that of the
            pixel alone, without the variance and the satellite peaks of the named effects.
        covariance: of (H_1 ... H_J, g, mu, sigma), the inverse of the observed information (Louis 1982), or
            the sandwich (White 1982), shape (n, J + 3, J + 3); NaN in the row and column of a sigma at its
            bound, zeros for samples without electrons.
        mean: mean of each sample, DN, shape (n, J) or (n,).
        variance: variance of each sample, DN^2, shape (n, J) or (n,).
        log_likelihood: ``sum_i c_i log f_X(x_i)``, or of the mass of the codes, of all samples, nats, shape
            (n,).
        likelihood_gap: nats between the likelihood kept and the runner-up, shape (n,). Runners-up are the
            maxima reached from the neighbours (all H -+ 1, mu +- 1/g; of several samples also another gain
            that gives the brightest an electron less or more), the other maxima found, and Gaussians of one
            width, one at the mean of each sample (g to infinity). A gap below 30 is exact; a larger one is
            the height that a quadratic expects of a neighbour that was given up, or not visited. Negative
            only with a reason in ``fit_status``: one Gaussian, or a climb that did not converge, is higher.
            A fit that starts from another has the gap of that one unless that was below 30.
        fit_status: bits of :class:`~pchem_pipeline.model.fit.status.FitStatus`, uint16, shape (n,). Of
            several samples, ``NOT_INFORMATIVE`` says that the standard error of g is above 10 %.
        n_iterations: evaluations of the likelihood, all starts and neighbours together, int32, shape (n,).
        goodness_chi2: Pearson chi-square, adjacent DN merged until 5 counts are expected, shape (n,).
        goodness_dof: its degrees of freedom, groups - 5 for one sample, shape (n,); 0 if there are none.
            With few frames up to groups - 1 (Chernoff and Lehmann 1954).
        goodness_p: probability of a larger chi-square, shape (n,); NaN without degrees of freedom.
        outlier_share: share of the samples that the tail guard left out of the likelihood, shape (n,).
        satellite_amplitude_e: amplitude of the free satellite peaks found in the pixel, e-, shape (n,); NaN
            without any.
        satellite_weight: weight of these peaks, shape (n,); 0 without any.
        intervals: ends of profile-likelihood intervals of H_1 ... H_J, g, mu, sigma and sigma g, shape
            (n, J + 4, 2); None unless asked for.
    """

    covariance: FloatArray
    mean: FloatArray
    variance: FloatArray
    log_likelihood: FloatArray
    likelihood_gap: FloatArray
    fit_status: NDArray[np.uint16]
    n_iterations: NDArray[np.int32]
    goodness_chi2: FloatArray
    goodness_dof: FloatArray
    goodness_p: FloatArray
    outlier_share: FloatArray
    satellite_amplitude_e: FloatArray
    satellite_weight: FloatArray
    intervals: FloatArray | None = None

    def __repr__(self) -> str:
        good = self.fit_status == 0
        words = f"{self.bias.size} histograms, {np.count_nonzero(good)} with a good fit"
        if good.any():
            units = {"H": "e-", "g": "e-/DN", "mu": "DN", "sigma": "DN"}
            medians = np.median(self.columns[good][:, [0, -3, -2, -1]], axis=0)
            numbers = zip(units.items(), medians, strict=True)
            words += f": median {', '.join(f'{name} = {n:.5g} {unit}' for (name, unit), n in numbers)}"
        return f"<FitResult of {words}>"

    def _repr_html_(self) -> str:
        """Return the first fits as a table, for a notebook."""
        n = self.columns.shape[1] - 3
        names = [f"H{j + 1 if n > 1 else ''}, e-" for j in range(n)]
        head = ("", *names, "g, e-/DN", "mu, DN", "sigma, DN", "status")
        errors = np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))
        rows = []
        for i in range(min(self.bias.size, _SHOWN)):
            values = zip(self.columns[i], errors[i], strict=True)
            numbers = [f"{value:.5g} ± {error:.2g}" for value, error in values]
            rows.append((str(i), *numbers, describe(int(self.fit_status[i]))))
        more = self.bias.size - len(rows)
        return html_table(head, rows) + (f"<p>and {more:,} more</p>" if more else "")

    def evaluated(self, counts: NDArray[Any]) -> float:
        """Return at how many codes the likelihood of histograms (n, B) was evaluated, all together."""
        return float(self.n_iterations @ np.count_nonzero(counts, axis=1))

    def of(self, pixels: IndexArray) -> FitResult:
        """Return the fit of some pixels."""
        arrays: dict[str, Any] = {each.name: getattr(self, each.name) for each in fields(self)}
        return replace(self, **{name: a[pixels] for name, a in arrays.items() if a is not None})

    def with_pixels(self, pixels: IndexArray, part: FitResult) -> FitResult:
        """Return a copy with the fit of some pixels in their places."""
        arrays: dict[str, Any] = {}
        for each in fields(self):
            mine, theirs = getattr(self, each.name), getattr(part, each.name)
            if mine is not None and theirs is not None:
                arrays[each.name] = mine.copy()
                arrays[each.name][pixels] = theirs
        return replace(self, **arrays)


def quantile_of(level: float) -> float:
    """Return z such that a standard normal lies within -+ z with probability ``level``.

    Example:
        >>> round(quantile_of(0.95), 3)
        1.96
    """
    return float(ndtri(0.5 * (1.0 + level)))
