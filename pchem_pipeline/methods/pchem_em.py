"""PCH-EM as this package runs it, among the other methods."""

from __future__ import annotations

from pchem_pipeline.methods.base import Estimates, Method, PixelSamples, Settings, register_method
from pchem_pipeline.model.fit.api import fit_histograms


@register_method
class PchEm(Method):
    """Maximum likelihood of one sample: several starts, EM and Newton steps, the neighbours looked at.

    Hendrickson et al. 2023, with the numerical work of :mod:`pchem_pipeline.model.fit.api`.
    """

    name = "pchem_em"
    title = "PCH-EM (this package)"
    source = "Hendrickson et al. 2023, with several starts and Newton's method"
    needs = "one sample"
    remark = "above about 0.5 e- read noise one sample does not suffice"
    order = 10

    def estimate(self, pixels: PixelSamples, settings: Settings) -> Estimates:
        """Return the fit of the first sample."""
        sample = pixels.samples[0]
        result = fit_histograms(sample.counts, sample.origin)
        return Estimates.of_fit(result.columns, result.fit_status)
