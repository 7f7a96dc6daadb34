"""A world of 24 statistics: refitted models that can be drawn from, without a sensor."""

import contextlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from pchem_pipeline.discrepancy.by_simulation.candidates.fingerprints import (
    Hypothesis,
    SetFit,
    likeliest_sets,
)
from pchem_pipeline.discrepancy.by_simulation.sensor.maps import NotFittedError
from pchem_pipeline.discrepancy.by_simulation.sets.pixel_likelihood import HistogramLikelihood
from pchem_pipeline.discrepancy.by_simulation.sets.refits import Refitted, Refitter, Steps
from pchem_pipeline.discrepancy.by_simulation.sets.rivals import Comparison, chosen
from pchem_pipeline.discrepancy.by_simulation.sets.search import Search, Trial, compare
from pchem_pipeline.discrepancy.effort import EffortSpentError
from pchem_pipeline.discrepancy.null import Measured, NullModel
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.effects.framework.effect import Effect

NAMES = tuple(name for name in STATISTICS if not name.startswith("frame.repeated"))[:24]
M = len(NAMES)
Mean = Callable[[Sequence[Effect]], np.ndarray[Any, Any]]


def refined(refitter: Refitter, hypotheses: Sequence[Hypothesis]) -> Refitted:
    """Return a set at the strengths that explain the data best, or as near as the work allows."""
    way = refitter.begin(hypotheses)
    with contextlib.suppress(EffortSpentError):
        while refitter.step(way):
            pass
    return way.best


def at_best_fit(one: Refitted) -> Trial:
    """Return the trial of a set whose steps have ended."""
    return Trial(one.hypotheses, one.score, Steps.begin(one), ended=True)


class World:
    """Data of some effects and of something beside them, and what refits under other effects would give."""

    def __init__(
        self,
        truth: Sequence[Effect],
        statistics: Mean,
        seed: int = 1,
        beside: np.ndarray[Any, Any] | float = 0.0,
    ) -> None:
        self.rng, self.statistics, self.drawn = np.random.default_rng(seed), statistics, 0
        self.unfit: Callable[[Sequence[Effect]], bool] = lambda _: False
        self.null = NullModel.from_replicates(NAMES, self.rng.standard_normal((40, M)))
        mean = statistics(truth) + beside
        self.z = Measured(*(mean + self.rng.standard_normal(M) for _ in range(3)))

    def draw(self, effects: tuple[Effect, ...], count: int) -> np.ndarray[Any, Any]:
        if self.unfit(effects):
            raise NotFittedError("hardly a pixel can be fitted with it")
        self.drawn += count
        return self.statistics(effects) + np.random.default_rng(7).standard_normal((count, M))

    def refitter(self) -> Refitter:
        return Refitter(self.draw, self.null, self.z.both)

    def likely(self, *hypotheses: Hypothesis, mean: np.ndarray[Any, Any] | float = 0.0) -> list[SetFit]:
        noise = self.refitter().noise(self.null.covariance, 40)
        return likeliest_sets(hypotheses, self.z.both - self.null.mean - mean, noise)

    def compare(
        self,
        *hypotheses: Hypothesis,
        sets: list[SetFit] | None = None,
        beside: Sequence[Hypothesis] = (),
        likelihood: HistogramLikelihood | None = None,
        **how: Any,
    ) -> Comparison | None:
        """Return the chosen set and its rivals, of the likeliest ones by default; None where none holds."""
        search = Search(self.refitter(), likelihood or HistogramLikelihood())
        if beside:
            how["beside"] = lambda one: self.likely(*beside, mean=one.mean)
        compare(search, hypotheses, self.likely(*hypotheses) if sets is None else sets, **how)
        return chosen(search)
