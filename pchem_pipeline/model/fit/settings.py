"""Settings of the per-pixel fit (YAML section ``fit``)."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pchem_pipeline.base.settings import Section


class FitSettings(Section):
    """How the parameters of the PCD are estimated from the histogram of each pixel."""

    algorithm: Literal["newton", "em"] = Field(
        default="newton",
        description="newton: safeguarded Newton steps, with EM steps as fallback. em: the plain EM of the "
        "paper (slow for a read noise above 0.4 e-)",
    )
    likelihood: Literal["density", "exact", "auto"] = Field(
        default="auto",
        description="density: the PCD at whole DN, as in the paper. exact: each component integrated over "
        "the width of its code, codes at the limits of the ADC censored (three times slower). auto: exact in "
        "pixels where rounding would bias the estimates by more than 0.05 standard errors, where another "
        "gain fits the codes as well, or with samples at a limit of the ADC; density in the others",
    )
    max_iterations: int = Field(
        default=200, ge=1, description="largest number of likelihood evaluations per start, algorithm newton"
    )
    em_max_iterations: int = Field(
        default=20_000, ge=1, description="largest number of EM iterations per start, algorithm em"
    )
    tolerance: float = Field(
        default=1e-8,
        gt=0,
        le=1e-2,
        description="nats: converged when half the squared Newton decrement is smaller, that is when the "
        "next step is below sqrt(2 tolerance) standard errors",
    )
    gap_threshold: float = Field(
        default=5.0,
        ge=0,
        description="nats: the bias is ambiguous if the log-likelihood of a fit with one electron more or "
        "fewer is closer",
    )
    read_noise_limit: float = Field(
        default=0.5,
        gt=0,
        description="e-: pixels with more read noise are flagged (one sample does not determine their "
        "parameters well)",
    )
    goodness_limit: float = Field(
        default=1e-6, ge=0, lt=1, description="pixels with a smaller goodness-of-fit p-value are flagged"
    )
    tail_guard: float = Field(
        default=1e-3,
        ge=0,
        le=0.1,
        description="expected frames per DN: samples where the fitted model expects fewer (cosmic rays, "
        "glitches) are excluded, their share is stored as outlier_share; 0: no exclusion",
    )
    tail_guard_share: float = Field(
        default=0.01,
        ge=0,
        le=0.1,
        description="largest share of a pixel's frames that the tail guard excludes; if there are more, all "
        "are kept (the model is wrong then)",
    )
    errors: Literal["information", "sandwich"] = Field(
        default="information",
        description="information: standard errors from the observed information, of several exposures with "
        "unresolved peaks from the expected one; correct if the model holds. "
        "sandwich: robust standard errors, correct also if it does not hold",
    )
    intervals: Literal["normal", "profile"] = Field(
        default="normal",
        description="normal: estimate ± standard error. profile: also profile-likelihood intervals, for low "
        "quanta exposure or read noise above 0.45 e- (about 0.1 ms per pixel)",
    )
    interval_level: float = Field(
        default=0.6827, gt=0.1, lt=0.9999, description="coverage probability of the profile intervals"
    )
    minimum_quanta_exposure: float = Field(
        default=1e-4, gt=0, le=0.1, description="e-: lower bound of the quanta exposure in the fit"
    )
