"""Effects are told apart in ready-made histograms by their likelihood: the law of the samples alone.

There is no order in time and there are no neighbours. The samples of every pixel are split at random into
three parts: one to fit, one to score, one for the final gap. Effects enter the exact likelihood of the
histograms (:mod:`pchem_pipeline.model.fit.shared`), so that no simulation is needed to name them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.discrepancy.build_verdict import Added, Fitted
from pchem_pipeline.discrepancy.by_likelihood.additions import AddedSets
from pchem_pipeline.discrepancy.by_likelihood.gap import LikelihoodGap
from pchem_pipeline.discrepancy.by_likelihood.members import Member, find_members
from pchem_pipeline.discrepancy.by_likelihood.search import Explanation, explain
from pchem_pipeline.discrepancy.by_likelihood.sets import SetComparison, split_samples
from pchem_pipeline.discrepancy.by_simulation.candidates import candidate_classes
from pchem_pipeline.discrepancy.effort import Effort, EffortSpentError
from pchem_pipeline.discrepancy.gap import Gap
from pchem_pipeline.discrepancy.null import CONVINCING, Measured, NullModel, as_matrix
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.observe.observe import UNTRUSTWORTHY, observe_histograms
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.discrepancy.skeleton import search, silent
from pchem_pipeline.discrepancy.verdict import Discrepancy, Examined
from pchem_pipeline.effects.charge.spurious_charge import SpuriousCharge
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps
from pchem_pipeline.effects.framework.registry import effect_classes
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.shared import Samples

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_FEWEST_SAMPLES = 300  # of a pixel
_MOST_PIXELS = 256  # looked at; more add nothing about what all have in common
_FEWEST_REPLICATES = 40
_LARGEST_TOTAL = 10**9 - 1  # samples of a pixel that can be split at random
_SIGMAS, _PRICE = 3.0, 3.0  # standard errors, and nats, by which a set must improve the score
_REACH = 7.0  # standard deviations: the law reaches no further


@dataclass(frozen=True)
class SampleHistograms:
    """Histograms of n pixels in one sample (exposure).

    Attributes:
        counts: one histogram per pixel, shape (n, B).
        origin: DN of bin 0, shape (n,).
        bias: frames without electrons, H = 0.
        integration_time: s; where all samples have one, and their exposures lie on a line over it, spurious
            charge is told from dark current.
    """

    counts: NDArray[np.integer]
    origin: NDArray[np.integer]
    bias: bool = False
    integration_time: float | None = None


def find_in_histograms(
    samples: Sequence[SampleHistograms],
    settings: DiscrepancySettings | None = None,
    *,
    model: Sequence[Effect] = (),
    width: int | None = None,
    tell: Callable[[str], None] = silent,
) -> Discrepancy:
    """Find where histograms disagree with the fitted model, name the effects, and add them.

    Several samples of the same pixels share g, mu and sigma: what looks alike in one exposure (branching and
    over-dispersion, say) depends on the exposure in its own way.

    Args:
        samples: one or more, of the same pixels.
        settings: the section ``discrepancy``; the defaults if None.
        model: effects that the model has already; none of them is added again.
        width: pixels in a row of the sensor; None: it has one row.
        tell: hears what is done next.

    Returns:
        The verdict, with everything that supports it.

    Raises:
        InputError: the samples are too few, or not of the same pixels.
        PchEmError: no pixel has a usable fit.
        ConfigError: a candidate is unknown.
    """
    _check(samples)
    explainer = HistogramExplainer(tuple(samples), settings or DiscrepancySettings(), tuple(model))
    found = search(explainer, tell)
    n, n_lit = samples[0].counts.shape[0], sum(not sample.bias for sample in samples)
    row = width or n
    shape = n // row, row
    verdict = found.verdict.on_sensor(shape, (0, shape[0]), (0, row), lambda _, x: divmod(x // n_lit, row))
    return replace(found, verdict=verdict)


def _check(samples: Sequence[SampleHistograms]) -> None:
    if len({sample.counts.shape[0] for sample in samples}) != 1 or all(sample.bias for sample in samples):
        raise InputError("the samples hold different numbers of pixels, or no electrons; give one exposure")
    for sample in samples:
        most = int(sample.counts.sum(axis=1).max()) if sample.counts.size else 0
        if most < 3 * _FEWEST_SAMPLES:
            raise InputError(
                f"the fullest histogram holds {most} samples, fewer than {3 * _FEWEST_SAMPLES}: nothing can "
                "be compared; take more frames"
            )
        if most > _LARGEST_TOTAL:
            raise InputError(f"a histogram holds {most} samples; at most {_LARGEST_TOTAL} can be split")


@dataclass
class HistogramExplainer:
    """Tells effects apart in histograms; see :class:`~pchem_pipeline.discrepancy.skeleton.Explainer`.

    Arrays have a row for each sample of each pixel, those of a pixel one after the other.
    """

    data: tuple[SampleHistograms, ...]
    settings: DiscrepancySettings
    model: tuple[Effect, ...]
    samples: str = "histograms"
    most_rounds: int = 1
    n_replicates: int = 0
    defects: dict[str, str] = field(default_factory=dict)
    untestable: dict[str, str] = field(default_factory=dict)
    found: Explanation | None = None

    def __post_init__(self) -> None:
        """Refuse unknown candidates before anything is done."""
        self.classes = candidate_classes(self.settings)
        self.rng = np.random.default_rng(self.settings.seed)
        self.effort = Effort(self.settings.effort)
        self.present = self.model
        self.layout = Samples(tuple(sample.bias for sample in self.data))
        self.n_pixels = self.data[0].counts.shape[0]

    @property
    def joint(self) -> bool:
        """Whether there are several samples."""
        return len(self.data) > 1

    def split(self) -> tuple[Evidence, Examined]:
        """Split the samples at random, fit the train part, and choose the pixels to look at."""
        counts, origin = _rows(self.data)
        parts = split_samples(counts, 3, self.rng)
        together = None
        if self.joint:
            together = self._fitted_together(parts[0], origin)
            parts, origin = _widened(parts, origin, together)
        self.evidence = self._observe(parts[0], origin, together)
        start = _parameters(self.evidence.maps) if together is None else together
        self.chosen = _choose(start, counts.sum(axis=1), self.layout.n)
        self.start = start[self.chosen]
        self.parts = tuple(part[self.chosen] for part in parts)
        self.origin = origin[self.chosen]
        self._compare_on_a_line()
        self.members, untestable, self.defects = find_members(self.classes, self.evidence, self.present)
        always = {tag: c.untestable for tag, c in effect_classes().items() if c.untestable}
        found = {tag: why for tag, why in (always | untestable).items() if tag not in self.classes}
        self.untestable = dict(sorted((found | untestable).items()))
        sizes = [int(part.sum()) for part in self.parts]
        return self.evidence, Examined(
            histograms=self.chosen.size,
            frames=int(sum(part.sum(axis=1).max() for part in self.parts)),
            rows=(0, 1),
            columns=(0, self.n_pixels),
            train=sizes[0],
            test=sizes[1],
            final=sizes[2],
        )

    def null(self) -> tuple[NullModel, Measured]:
        """Fit the model to the train part, and observe histograms drawn from it, each with its own fit."""
        self.sets = self._sets(self.layout)
        plain = self.sets.fit(())
        self.bare = replace(self.sets, present=(), start=plain.fit.parameters)
        own = [self._observed(part) for part in self.parts]
        vectors = self._drawn(plain.log_masses)
        common = set(STATISTICS).intersection(*vectors, *own)
        names = tuple(name for name in STATISTICS if name in common)
        z = Measured(*(as_matrix(names, [row])[0] for row in own))
        self.plain = self.sets.fit((), plain.fit.parameters, self.parts[0] + self.parts[1])
        self.first = NullModel.from_replicates(names, as_matrix(names, vectors))
        self.effort.begin()
        return self.first, z

    def doubt(self) -> str:
        """Return nothing: each candidate is fitted with the parameters, so what they bend is no evidence."""
        return ""

    def gap(self, null: NullModel, z: Measured) -> Gap:
        """Measure the gap of the likelihood on the final part."""
        whole = LikelihoodGap(self.parts[2], self.sets.kept, 0.0, self._count, self.rng)
        self.before = whole.gap(self.sets.problem((), self.parts[0] + self.parts[1]), self.plain.fit)
        return self.before

    def suspects(self, null: NullModel, z: Measured) -> bool:
        """Tell whether several samples fit badly together although no statistic of one deviates."""
        return self.joint and not self.before.at_floor

    def explain(self, null: NullModel, z: Measured, disagrees: bool) -> Explanation | None:
        """Find the set of effects that best predicts the test part, on the codes that are understood.

        Raises:
            EffortSpentError: the work is at its limit; nothing was found.
        """
        self.effort.tried.clear()
        try:
            found = explain(self.sets, self.members, self._count, self.rng)
        except EffortSpentError as spent:
            tags = dict.fromkeys(m.tag for m in self.members)
            raise EffortSpentError(spent.doing, (t for t in tags if t not in self.effort.tried)) from spent
        self.defects |= self.sets.failed | found.sets.failed
        if not disagrees:
            rise, error = found.sets.difference(found.judged, found.sets.fit(()))
            if not found.named or rise < max(CONVINCING, _SIGMAS * error):
                return None
        self.found = found
        return found if found.named else None

    def add(self, explanation: Explanation, null: NullModel, z: Measured) -> NullModel:
        """Put the named effects into the model, and observe histograms drawn from it."""
        vectors = self._drawn(self._with_effects(explanation))
        return NullModel.from_replicates(null.names, as_matrix(null.names, vectors))

    def replaced(self, null: NullModel, z: Measured) -> NullModel | None:
        """Leave what was added: nothing is measured of anything else here."""
        return None

    def describe(self, before: Gap, null: NullModel, z: Measured) -> NullModel | None:
        """Leave what no effect explains to the codes that are told: nothing is measured of it here."""
        return None

    def tolerance(self) -> float:
        """Return 0: the likelihood fits the effects themselves."""
        return 0.0

    def close(self, before: Gap, null: NullModel, z: Measured, disagrees: bool) -> Added:
        """Fit train and test part together with each effect, and measure the gap on the final part."""
        self.final_fit, self.code = self.plain, None
        if self.found is None:
            return Added((), before)
        closing = AddedSets(self.parts, self.found, self.plain, self._count, self.rng)
        added, self.final_fit = closing.close(before, (self.first, null), z, disagrees)
        self.code = closing.codes(self.final_fit, self.evidence)
        self.model = (*self.present, *(each.effect for each in added.additions))
        return added

    def fitted(self, model: tuple[Effect, ...]) -> Fitted:
        """Return the parameters of the rows looked at, NaN elsewhere, shape (1, n) or (n, J)."""
        columns = np.full((4, self.n_pixels * self.layout.n), np.nan)
        columns[:, self.chosen] = self.final_fit.fit.parameters.T
        shape = (self.n_pixels, self.layout.n) if self.joint else (1, self.n_pixels)
        maps = columns.reshape(4, *shape)
        return Fitted(PixelMaps.known(maps, np.isfinite(maps[0])), self.code)

    # -- pieces ---------------------------------------------------------------------------------

    @property
    def _count(self) -> int:
        return max(self.settings.extended_replicates, _FEWEST_REPLICATES)

    def _sets(self, layout: Samples) -> SetComparison:
        """Return what fits the chosen rows, begun at the fit that they were observed with."""
        train, test, _ = self.parts
        every = np.ones(train.shape, np.bool_)
        found = SetComparison(train, test, self.origin, every, self.present, self.start, layout)
        return replace(found, effort=self.effort)

    def _fitted_together(self, counts: IntArray, origin: IntArray) -> FloatArray:
        """Fit the PCD to all samples of each pixel; return (H, g, mu, sigma) of the rows, NaN if unusable."""
        j = self.layout.n
        by_sample = [counts[k::j].astype(np.uint32) for k in range(j)]
        fit = fit_histograms(by_sample, [origin[k::j] for k in range(j)], dark=self.layout.dark)
        usable = (fit.fit_status & UNTRUSTWORTHY) == 0
        shared = np.stack([fit.conversion_gain, fit.bias, fit.read_noise_dn], axis=1)
        shared = np.repeat(shared[:, None], j, axis=1)
        rows = np.concatenate([fit.quanta_exposure[:, :, None], shared], axis=2)
        return np.asarray(np.where(usable[:, None, None], rows, np.nan).reshape(-1, 4))

    def _compare_on_a_line(self) -> None:
        """Let the exposures be in proportion to time, with spurious charge a candidate, where a line fits."""
        times = [sample.integration_time for sample in self.data if not sample.bias]
        tag = SpuriousCharge.model_fields["tag"].default
        wanted = self.settings.candidates is None or tag in self.settings.candidates
        if None in times or len(set(times)) < 2 or not wanted or tag in self.settings.exclude:
            return
        if tag in {effect.tag for effect in self.present}:
            return
        line = Samples(self.layout.dark, tuple(sample.integration_time or 0.0 for sample in self.data))
        free, straight = self._sets(self.layout), self._sets(line)
        best = straight.fit([Member.of(SpuriousCharge.typical()[0])])
        rise, error = free.difference(free.fit(()), best)
        if rise <= max(_PRICE, _SIGMAS * error):
            self.layout = line
            self.classes = {**self.classes, tag: SpuriousCharge}

    def _observed(self, counts: IntArray) -> Mapping[str, float]:
        """Return the statistics of histograms of the chosen pixels, fitted with the PCD alone."""
        parameters = self.bare.fit((), None, counts).fit.parameters if self.joint else None
        return self._observe(counts, self.origin, parameters).z

    def _observe(self, counts: IntArray, origin: IntArray, parameters: FloatArray | None) -> Evidence:
        """Observe the rows with electrons; the others say nothing about how electrons come and are read."""
        lit = np.tile(~np.array(self.layout.dark), origin.size // self.layout.n)
        known = None if parameters is None else parameters[lit]
        return observe_histograms(counts[lit].astype(np.uint32), origin[lit], parameters=known)

    def _drawn(self, log_masses: FloatArray) -> list[Mapping[str, float]]:
        """Draw histograms from a law, and observe each, refit included."""
        mass = np.exp(log_masses)
        mass /= mass.sum(axis=1, keepdims=True)
        total = self.parts[0].sum(axis=1)
        count = self.settings.replicates
        self.n_replicates += count
        self.effort.simulate(0, total.size, count)
        return [self._observed(self.rng.multinomial(total, mass)) for _ in range(count)]

    def _with_effects(self, found: Explanation) -> FloatArray:
        """Return the log masses of all codes: the plain law where codes are set aside, else with effects."""
        judged = replace(found.sets, kept=found.kept)
        best = judged.problem(found.best.members).log_masses(found.best.fit.theta, found.best.fit.shared)
        plain = found.plain.log_masses
        share = np.log(np.where(found.kept, np.exp(plain), 0.0).sum(axis=1, keepdims=True))
        return np.where(found.kept, best + share, plain)


def _rows(samples: Sequence[SampleHistograms]) -> tuple[IntArray, IntArray]:
    """Return histograms (n J, B) and DN of bin 0, (n J,): the samples of a pixel one after the other."""
    n, j = samples[0].counts.shape[0], len(samples)
    counts = np.zeros((n, j, max(sample.counts.shape[1] for sample in samples)), np.int64)
    for k, sample in enumerate(samples):
        counts[:, k, : sample.counts.shape[1]] = sample.counts
    origin = np.stack([np.asarray(sample.origin, np.int64) for sample in samples], axis=1)
    return counts.reshape(n * j, -1), origin.ravel()


def _widened(
    parts: Sequence[IntArray], origin: IntArray, parameters: FloatArray
) -> tuple[tuple[IntArray, ...], IntArray]:
    """Return the histograms with all codes that the law reaches.

    Histograms end at their extreme samples; replicates drawn within these ends would lack the tails that the
    data have.
    """
    h, g, mu, sigma = parameters.T
    last = origin + parts[0].shape[1] - 1
    low = np.nanmax(origin - (mu - _REACH * sigma))
    high = np.nanmax(mu + (h + _REACH * (np.sqrt(h) + 1.0)) / g + _REACH * sigma - last)
    left, right = (max(int(np.ceil(more)), 0) for more in (low, high))
    return tuple(np.pad(part, ((0, 0), (left, right))) for part in parts), origin - left


def _parameters(maps: PixelMaps) -> FloatArray:
    """Return (H, g, mu, sigma), (n, 4), NaN where not usable."""
    columns = maps.maps
    return np.stack([values.ravel() for values in columns], axis=1)


def _choose(parameters: FloatArray, total: NDArray[np.integer], n_samples: int) -> NDArray[np.intp]:
    """Return rows to look at: of usable pixels with samples enough, spread over the exposures."""
    good = np.isfinite(parameters).all(axis=1) & (total >= 3 * _FEWEST_SAMPLES)
    usable = np.flatnonzero(good.reshape(-1, n_samples).all(axis=1))
    if not usable.size:
        raise InputError("no histogram with enough samples has a usable fit; see fit_status")
    exposure = parameters[:, 0].reshape(-1, n_samples).sum(axis=1)
    order = usable[np.argsort(exposure[usable], kind="stable")]
    places = np.unique(np.linspace(0, order.size - 1, min(order.size, _MOST_PIXELS)).astype(np.intp))
    pixels = np.sort(order[places])
    return np.asarray((pixels[:, None] * n_samples + np.arange(n_samples)).ravel(), np.intp)
