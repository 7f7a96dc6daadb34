"""Optimal fingerprinting: how much of which effects best explains the shift of the statistics.

The shift of the statistics against the null is regressed on the fingerprints of candidate effects, as climate
science attributes warming (Hasselmann 1997; Allen and Tett 1999): ``y = sum_e c_e F_e + noise`` with ``c_e
>= 0``. The noise has the covariance of the null replicates, and a relative error of each fingerprint on top,
since the details of a real effect are never those of the library.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize

from pchem_pipeline.effects.framework.effect import Effect

__all__ = ["Hypothesis", "Noise", "SetFit", "correction", "fit_set", "log_density", "tolerance"]

FloatArray = NDArray[np.float64]

_REWEIGHTINGS = 3
_LEAK = 0.1
_LARGEST_CORRECTION = 0.4


@dataclass(frozen=True)
class Hypothesis:
    """An effect with parameters, and what it would do to the statistics.

    Attributes:
        effect: with guessed or refined parameters.
        fingerprint: shift of the statistics at this strength, shape (m,).
    """

    effect: Effect
    fingerprint: FloatArray

    @property
    def tag(self) -> str:
        """Tag of the effect."""
        return self.effect.tag

    def rescaled(self, factor: float) -> Effect:
        """Return the effect with the strength at which its fingerprint is ``factor`` times as large."""
        if not self.effect.strength:
            return self.effect
        return self.effect.scaled(float(factor) ** (1.0 / self.effect.power))


@dataclass(frozen=True)
class Noise:
    """Covariance of the difference of measured and predicted statistics.

    Attributes:
        covariance: of the statistics under the null, its estimation included, shape (m, m).
        model_error: relative error of a fingerprint, no unit.
        events: of exact counts, by how much an event raises the statistic, over the number of splits in the
            mean; 0 for all others, shape (m,). Their number scatters as Poisson counts do; without an effect
            that predicts some there is none.
    """

    covariance: FloatArray
    model_error: float
    events: FloatArray | float = 0.0

    def of(self, prediction: FloatArray) -> FloatArray:
        """Return the covariance where the prediction, (e, m), is the sum of the effects' shifts."""
        counts = self.events * np.abs(prediction.sum(axis=0))
        return self.covariance + np.diag(tolerance(prediction, self.model_error) ** 2 + counts)


@dataclass(frozen=True)
class SetFit:
    """A set of hypotheses fitted to the shift of one split.

    Attributes:
        hypotheses: the set.
        factors: c_e of each, at least 0, shape (e,).
        stderr: their standard errors, shape (e,).
        certain: whether an exact count asks for it, however few events it has, shape (e,).
    """

    hypotheses: tuple[Hypothesis, ...]
    factors: FloatArray
    stderr: FloatArray
    certain: NDArray[np.bool_]

    @property
    def parts(self) -> FloatArray:
        """Predicted shift by effect, shape (e, m)."""
        return np.array([c * h.fingerprint for c, h in zip(self.factors, self.hypotheses, strict=True)])

    def established(self, least: float) -> tuple[Hypothesis, ...]:
        """Return those whose strength is at least so many standard errors, or that an exact count proves."""
        there = (self.factors > least * self.stderr) | self.certain
        return tuple(h for h, is_there in zip(self.hypotheses, there, strict=True) if is_there)

    def settled(self, close: float) -> bool:
        """Tell whether all strengths are what the data ask for, to ``close`` or half a standard error."""
        return bool(np.all(np.abs(self.factors - 1.0) < np.maximum(close, self.stderr / 2.0)))

    def log_score(self, shift: FloatArray, noise: Noise) -> float:
        """Return the Gaussian log density of a shift of statistics, up to a constant, nats."""
        parts = self.parts
        return log_density(shift - parts.sum(axis=0), noise.of(parts))

    def distance(self, other: SetFit, noise: Noise) -> float:
        """Return how far the predictions of two sets lie apart, in standard deviations of the statistics."""
        mine, theirs = self.parts, other.parts
        factor = linalg.cholesky(noise.of(np.concatenate([mine, theirs]) / np.sqrt(2.0)), lower=True)
        white = linalg.solve_triangular(factor, mine.sum(axis=0) - theirs.sum(axis=0), lower=True)
        return float(np.sqrt(white @ white))


def correction(parts: FloatArray, residual: FloatArray, noise: Noise) -> tuple[FloatArray, FloatArray]:
    """Return relative changes of the strengths that a residual asks for, and standard errors, (e,) each.

    Args:
        parts: shifts of the statistics by effect, shape (e, m).
        residual: what the model with all effects leaves, shape (m,).
        noise: of the residual.
    """
    factor = linalg.cholesky(noise.of(parts), lower=True)
    design = linalg.solve_triangular(factor, parts.T, lower=True)
    target = linalg.solve_triangular(factor, residual, lower=True)
    change = np.linalg.lstsq(design, target, rcond=None)[0]
    stderr = np.sqrt(np.diag(np.linalg.pinv(design.T @ design)))
    return np.clip(change, -_LARGEST_CORRECTION, _LARGEST_CORRECTION), stderr


def tolerance(parts: FloatArray, model_error: float) -> FloatArray:
    """Return the deviations that are not held against effects, shape (m,).

    A fraction of what they do to each statistic, and a tenth of that of the largest that they do to any: the
    details of a very strong effect show where the effect itself does not.

    Args:
        parts: shifts of the statistics by effect, shape (e, m).
        model_error: the fraction.
    """
    own = np.sum(parts**2, axis=0)
    leaked = np.sum((_LEAK * np.max(np.abs(parts), axis=1)) ** 2)
    return np.asarray(model_error * np.sqrt(own + leaked))


def log_density(residual: FloatArray, covariance: FloatArray) -> float:
    """Return the Gaussian log density of a residual, up to a constant, nats."""
    factor = linalg.cholesky(covariance, lower=True)
    white = linalg.solve_triangular(factor, residual, lower=True)
    return float(-0.5 * white @ white - np.sum(np.log(np.diag(factor))))


def fit_set(hypotheses: Sequence[Hypothesis], shift: FloatArray, noise: Noise) -> SetFit:
    """Fit non-negative factors of the fingerprints to a shift by generalised least squares, reweighted.

    Args:
        hypotheses: one or more, of different effects.
        shift: measured statistics minus null mean, shape (m,).
        noise: covariance of the shift.
    """
    columns = np.array([h.fingerprint for h in hypotheses]).T
    factors = np.ones(len(hypotheses))
    stderr = np.full(len(hypotheses), np.inf)
    for _ in range(_REWEIGHTINGS):
        factor = linalg.cholesky(noise.of(columns.T * factors[:, None]), lower=True)
        design = linalg.solve_triangular(factor, columns, lower=True)
        target = linalg.solve_triangular(factor, shift, lower=True)
        factors, _ = optimize.nnls(design, target)
        stderr = np.sqrt(np.diag(np.linalg.pinv(design.T @ design)))
    counted = (columns.T * factors[:, None] * noise.events > 0.0) & (shift > 0.0)
    return SetFit(tuple(hypotheses), factors, stderr, np.asarray(counted.any(axis=1)))
