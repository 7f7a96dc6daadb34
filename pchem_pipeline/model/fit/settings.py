"""Settings of the per-pixel fit (YAML section ``fit``)."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pchem_pipeline.base.settings import Section


class FitSettings(Section):
    """How the parameters of the PCD are estimated from the histogram of each pixel."""

    algorithm: Literal["newton", "em"] = Field(
        default="newton",
        description="newton: safeguarded Newton steps on the exact likelihood, EM steps where those do not "
        "help. em: the plain EM of the paper (slow when the read noise exceeds 0.4 e-)",
    )
    likelihood: Literal["density", "exact", "auto"] = Field(
        default="auto",
        description="density: the PCD at whole DN, as in the paper. exact: each component integrated over "
        "the cell of its code, codes at the limits of the ADC censored (three times slower). auto: exact in "
        "the pixels where rounding would bias the density's estimates by more than 0.05 standard errors, "
        "whose codes another gain explains as well, or with samples at a limit of the ADC; density in the "
        "others",
    )
    max_iterations: int = Field(
        default=200,
        ge=1,
        description="largest number of likelihood evaluations per start, algorithm newton",
    )
    em_max_iterations: int = Field(
        default=20_000, ge=1, description="largest number of EM iterations per start, algorithm em"
    )
    tolerance: float = Field(
        default=1e-8,
        gt=0,
        le=1e-2,
        description="nats: converged when the likelihood can rise by less (half the squared Newton "
        "decrement), that is when the next step is below sqrt(2 tolerance) standard errors",
    )
    gap_threshold: float = Field(
        default=5.0,
        ge=0,
        description="nats: the bias counts as ambiguous when a runner-up (one electron more or fewer) "
        "is closer",
    )
    read_noise_limit: float = Field(
        default=0.5,
        gt=0,
        description="e-: above it one sample does not determine the parameters well; flagged",
    )
    goodness_limit: float = Field(
        default=1e-6, ge=0, lt=1, description="a goodness-of-fit probability below it is flagged"
    )
    tail_guard: float = Field(
        default=1e-3,
        ge=0,
        le=0.1,
        description="expected frames per DN: samples where the fitted model expects fewer (cosmic rays, "
        "glitches) leave the likelihood, their share is kept as outlier_share; 0: every sample counts",
    )
    tail_guard_share: float = Field(
        default=0.01,
        ge=0,
        le=0.1,
        description="largest share of a pixel's frames that the tail guard leaves out; where there would be "
        "more the model is wrong, not a few samples, and all are kept",
    )
    errors: Literal["information", "sandwich"] = Field(
        default="information",
        description="information: standard errors from the observed information, right if the model holds. "
        "sandwich: right for the nearest such law even where it does not",
    )
    intervals: Literal["normal", "profile"] = Field(
        default="normal",
        description="normal: estimate -+ standard errors. profile: also the ends of profile-likelihood "
        "intervals, for low quanta exposure or read noise above 0.45 e- (about 0.1 ms per pixel)",
    )
    interval_level: float = Field(
        default=0.6827, gt=0.1, lt=0.9999, description="probability that a profile interval covers the truth"
    )
    minimum_quanta_exposure: float = Field(
        default=1e-4, gt=0, le=0.1, description="e-: lower bound of the quanta exposure in the fit"
    )
