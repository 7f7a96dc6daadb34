"""Effects are told apart in ready-made histograms by their likelihood: the law of the samples alone.

There is no order in time and there are no neighbours. The samples of every pixel are split at random into
three parts: one to fit, one to score, one for the final gap. Effects enter the exact likelihood of the
histograms (:mod:`pchem_pipeline.model.fit.shared`), so that no simulation is needed to name them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.discrepancy.build_verdict import Added, Fitted
from pchem_pipeline.discrepancy.by_likelihood.additions import AddedSets
from pchem_pipeline.discrepancy.by_likelihood.gap import LikelihoodGap
from pchem_pipeline.discrepancy.by_likelihood.members import find_members
from pchem_pipeline.discrepancy.by_likelihood.search import Explanation, explain
from pchem_pipeline.discrepancy.by_likelihood.sets import SetComparison, split_samples
from pchem_pipeline.discrepancy.by_simulation.candidates import candidate_classes
from pchem_pipeline.discrepancy.gap import Gap
from pchem_pipeline.discrepancy.null import Measured, NullModel, as_matrix
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.observe.observe import observe_histograms
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.discrepancy.skeleton import search
from pchem_pipeline.discrepancy.verdict import Discrepancy, Examined
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps
from pchem_pipeline.effects.framework.registry import effect_classes

__all__ = ["HistogramExplainer", "find_in_histograms"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_FEWEST_SAMPLES = 300  # of a pixel
_MOST_PIXELS = 256  # looked at; more add nothing about what all have in common
_FEWEST_REPLICATES = 40
_LARGEST_TOTAL = 10**9 - 1  # samples of a pixel that can be split at random


def find_in_histograms(
    counts: NDArray[np.integer],
    origin: NDArray[np.integer],
    settings: DiscrepancySettings | None = None,
    *,
    model: Sequence[Effect] = (),
) -> Discrepancy:
    """Find where histograms disagree with the fitted model, name the effects, and add them.

    Args:
        counts: histograms of n pixels, shape (n, B).
        origin: DN of bin 0, shape (n,).
        settings: the section ``discrepancy``; the defaults if None.
        model: effects that the model has already; none of them is added again.

    Returns:
        The verdict, with everything that supports it.

    Raises:
        InputError: the samples are too few.
        PchEmError: no pixel has a usable fit.
        ConfigError: a candidate is unknown.
    """
    _check(counts)
    return search(HistogramExplainer(counts, origin, settings or DiscrepancySettings(), tuple(model)))


def _check(counts: NDArray[np.integer]) -> None:
    most = int(counts.sum(axis=1).max()) if counts.size else 0
    if most < 3 * _FEWEST_SAMPLES:
        raise InputError(
            f"the fullest histogram holds {most} samples, fewer than {3 * _FEWEST_SAMPLES}: nothing can be "
            "compared; take more frames"
        )
    if most > _LARGEST_TOTAL:
        raise InputError(f"a histogram holds {most} samples; at most {_LARGEST_TOTAL} can be split")


@dataclass
class HistogramExplainer:
    """Tells effects apart in histograms; see :class:`~pchem_pipeline.discrepancy.skeleton.Explainer`."""

    counts: NDArray[np.integer]
    origin: NDArray[np.integer]
    settings: DiscrepancySettings
    model: tuple[Effect, ...]
    samples: str = "histograms"
    most_rounds: int = 1
    n_replicates: int = 0
    left_out: dict[str, str] = field(default_factory=dict)
    untestable: dict[str, str] = field(default_factory=dict)
    found: Explanation | None = None

    def __post_init__(self) -> None:
        """Refuse unknown candidates before anything is done."""
        self.classes = candidate_classes(self.settings)
        self.rng = np.random.default_rng(self.settings.seed)
        self.present = self.model

    def split(self) -> tuple[Evidence, Examined]:
        """Split the samples at random, and choose the pixels to look at."""
        parts = split_samples(self.counts, 3, self.rng)
        self.evidence = _observe(parts[0], self.origin)
        chosen = _choose(self.evidence, self.counts.sum(axis=1))
        self.chosen = chosen
        self.parts = tuple(part[chosen] for part in parts)
        self.places = np.asarray(self.origin, np.int64)[chosen]
        self.members, untestable, self.left_out = find_members(self.classes, self.evidence, self.present)
        always = {tag: c.untestable for tag, c in effect_classes().items() if c.untestable}
        self.untestable = dict(sorted((always | untestable).items()))
        sizes = [int(part.sum()) for part in self.parts]
        return self.evidence, Examined(
            histograms=chosen.size,
            frames=int(sum(part.sum(axis=1).max() for part in self.parts)),
            rows=(0, 1),
            columns=(0, self.counts.shape[0]),
            train=sizes[0],
            test=sizes[1],
            final=sizes[2],
        )

    def null(self) -> tuple[NullModel, Measured]:
        """Fit the model to the train part, and observe histograms drawn from it, each with its own fit."""
        train, test, _ = self.parts
        maps = self.evidence.maps
        columns = (maps.quanta_exposure, maps.conversion_gain, maps.bias, maps.read_noise_dn)
        start = np.stack([values.ravel()[self.chosen] for values in columns], axis=1)
        every = np.ones(train.shape, np.bool_)
        self.sets = SetComparison(train, test, self.places, every, self.present, start)
        plain = self.sets.fit(())
        own = [_observe(part, self.places).z for part in self.parts]
        vectors = self._drawn(plain.log_masses)
        common = set(STATISTICS).intersection(*vectors, *own)
        names = tuple(name for name in STATISTICS if name in common)
        z = Measured(*(as_matrix(names, [row])[0] for row in own))
        self.plain = self.sets.fit((), plain.fit.parameters, train + test)
        self.first = NullModel.from_replicates(names, as_matrix(names, vectors))
        return self.first, z

    def gap(self, null: NullModel, z: Measured) -> Gap:
        """Measure the gap of the likelihood on the final part."""
        whole = LikelihoodGap(self.parts[2], self.sets.kept, 0.0, self._count, self.rng)
        return whole.gap(self.sets.problem((), self.parts[0] + self.parts[1]), self.plain.fit)

    def suspects(self, null: NullModel, z: Measured) -> bool:
        """Return False: what no statistic shows is not looked for."""
        return False

    def explain(self, null: NullModel, z: Measured, disagrees: bool) -> Explanation | None:
        """Find the set of effects that best predicts the test part, on the codes that are understood."""
        self.found = explain(self.sets, self.members, self._count, self.rng)
        self.left_out |= self.sets.failed | self.found.sets.failed
        return self.found if self.found.named else None

    def add(self, explanation: Explanation, null: NullModel, z: Measured) -> NullModel:
        """Put the named effects into the model, and observe histograms drawn from it."""
        vectors = self._drawn(self._with_effects(explanation))
        return NullModel.from_replicates(null.names, as_matrix(null.names, vectors))

    def tolerance(self) -> float:
        """Return 0: the likelihood fits the effects themselves."""
        return 0.0

    def close(self, before: Gap, null: NullModel, z: Measured, disagrees: bool) -> Added:
        """Fit train and test part together with each effect, and measure the gap on the final part."""
        self.final_fit, self.code = self.plain, None
        if self.found is None:
            return Added((), before)
        closing = AddedSets(self.parts, self.found, self.plain, self._count, self.rng)
        added, self.final_fit = closing.close(before, (self.first, null), z.final, disagrees)
        self.code = closing.codes(self.final_fit, self.evidence)
        self.model = (*self.present, *(each.effect for each in added.additions))
        return added

    def fitted(self, model: tuple[Effect, ...]) -> Fitted:
        """Return the parameters of the pixels looked at, NaN elsewhere, shape (1, n)."""
        n = self.counts.shape[0]
        columns = np.full((4, n), np.nan)
        columns[:, self.chosen] = self.final_fit.fit.parameters.T
        exposure, gain, bias, noise = columns.reshape(4, 1, n)
        return Fitted(PixelMaps(exposure, gain, bias, noise, np.isfinite(exposure)), self.code)

    # -- pieces ---------------------------------------------------------------------------------

    @property
    def _count(self) -> int:
        return max(self.settings.extended_replicates, _FEWEST_REPLICATES)

    def _drawn(self, log_masses: FloatArray) -> list[Mapping[str, float]]:
        """Draw histograms from a law, and observe each, refit included."""
        mass = np.exp(log_masses)
        mass /= mass.sum(axis=1, keepdims=True)
        total = self.parts[0].sum(axis=1)
        count = self.settings.replicates
        self.n_replicates += count
        return [_observe(self.rng.multinomial(total, mass), self.places).z for _ in range(count)]

    def _with_effects(self, found: Explanation) -> FloatArray:
        """Return the log masses of all codes: the plain law where codes are set aside, else with effects."""
        judged = replace(found.sets, kept=found.kept)
        best = judged.problem(found.best.members).log_masses(found.best.fit.theta, found.best.fit.shared)
        plain = found.plain.log_masses
        share = np.log(np.where(found.kept, np.exp(plain), 0.0).sum(axis=1, keepdims=True))
        return np.where(found.kept, best + share, plain)


def _observe(counts: IntArray, origin: NDArray[np.integer]) -> Evidence:
    return observe_histograms(counts.astype(np.uint32), np.asarray(origin, np.int64))


def _choose(evidence: Evidence, total: NDArray[np.integer]) -> NDArray[np.intp]:
    """Return pixels to look at: usable ones with samples enough, spread over the exposures."""
    usable = np.flatnonzero(evidence.maps.usable.ravel() & (total >= 3 * _FEWEST_SAMPLES))
    if not usable.size:
        raise InputError("no histogram with enough samples has a usable fit; see fit_status")
    order = usable[np.argsort(evidence.maps.quanta_exposure.ravel()[usable], kind="stable")]
    places = np.unique(np.linspace(0, order.size - 1, min(order.size, _MOST_PIXELS)).astype(np.intp))
    return np.sort(order[places])
