"""PCH-EM as this package runs it, of one sample and of all together, among the other methods."""

from __future__ import annotations

from pchem_pipeline.methods.base import Estimates, Method, PixelSamples
from pchem_pipeline.methods.settings import MethodsSettings
from pchem_pipeline.model.fit.api import fit_histograms


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

    def estimate(self, pixels: PixelSamples, settings: MethodsSettings) -> Estimates:
        """Return the fit of the first sample."""
        sample = pixels.samples[0]
        result = fit_histograms(sample.counts, sample.origin)
        return Estimates.of_fit(result.columns, result.fit_status)


class JointPchEm(Method):
    """Maximum likelihood of all samples together: one g, mu and sigma, an H for each exposure.

    Multi-sample PCH-EM (Hendrickson et al. 2024, arXiv 2403.04498; IEEE Trans. Electron Devices), with the
    numerical work of :mod:`pchem_pipeline.model.fit.api`. The darkest sample is taken for bias frames,
    as by the other methods that need one.
    """

    name = "pchem_em_joint"
    title = "PCH-EM, all samples jointly"
    source = "Hendrickson et al. 2024, arXiv 2403.04498"
    needs = "a dark and a bright sample"
    remark = "uses the darkest sample as bias frames"
    order = 12

    def estimate(self, pixels: PixelSamples, settings: MethodsSettings) -> Estimates:
        """Return the fit of all samples."""
        darkest = pixels.by_brightness()[0]
        result = fit_histograms(
            [sample.counts for sample in pixels.samples],
            [sample.origin for sample in pixels.samples],
            dark=[number == darkest for number in range(len(pixels.samples))],
        )
        return Estimates.of_fit(result.columns[:, [0, -3, -2, -1]], result.fit_status)
