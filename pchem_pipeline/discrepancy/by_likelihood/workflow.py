"""The workflow on ready-made histograms: no order in time and no neighbours, the law of the samples alone.

The samples of every pixel are dealt at random to three parts: one to fit, one to score, one for the final
gap. Effects enter the exact likelihood of the histograms (:mod:`pchem_pipeline.model.fit.shared`), so that no
simulation is needed to name them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.discrepancy.by_likelihood.build_verdict import Measurements, tell_histograms
from pchem_pipeline.discrepancy.by_likelihood.gap import Meter
from pchem_pipeline.discrepancy.by_likelihood.members import Member, find_members
from pchem_pipeline.discrepancy.by_likelihood.search import Explanation, explain
from pchem_pipeline.discrepancy.by_likelihood.sets import Arena, FittedSet, deal
from pchem_pipeline.discrepancy.by_simulation.candidates import Mapper, candidate_classes, serial
from pchem_pipeline.discrepancy.by_simulation.null import NullModel, as_matrix
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.observe.observe import observe_histograms
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.discrepancy.verdict import Discrepancy
from pchem_pipeline.discrepancy.where import locate
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps
from pchem_pipeline.effects.framework.registry import effect_classes

__all__ = ["find_in_histograms"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_FEWEST_SAMPLES = 300  # of a pixel
_MOST_PIXELS = 256  # looked at; more tell nothing new of what all have in common
_FEWEST_REPLICATES = 40
_REPLICATION = 0.02  # in each part by itself
_LARGEST_TOTAL = 10**9 - 1  # samples of a pixel that the dealing can handle


def find_in_histograms(
    counts: NDArray[np.integer],
    origin: NDArray[np.integer],
    settings: DiscrepancySettings | None = None,
    *,
    model: Sequence[Effect] = (),
    mapper: Mapper = serial,
) -> Discrepancy:
    """Find where histograms disagree with the fitted model, name the effects, and add them.

    Args:
        counts: histograms of n pixels, shape (n, B).
        origin: DN of bin 0, shape (n,).
        settings: the section ``discrepancy``; the defaults if None.
        model: effects that the model has already; none of them is added again.
        mapper: not used (nothing is simulated frame by frame); for likeness with the search in frames.

    Returns:
        The verdict, with everything that supports it.

    Raises:
        InputError: the samples are too few.
        PchEmError: no pixel has a usable fit.
        ConfigError: a candidate is unknown.
    """
    settings = settings or DiscrepancySettings()
    total = counts.sum(axis=1)
    if not counts.size or int(total.max()) < 3 * _FEWEST_SAMPLES:
        most = int(total.max()) if counts.size else 0
        raise InputError(
            f"the fullest histogram holds {most} samples, fewer than {3 * _FEWEST_SAMPLES}: nothing can be "
            "compared; take more frames"
        )
    if int(total.max()) > _LARGEST_TOTAL:
        raise InputError(
            f"a histogram holds {int(total.max())} samples; at most {_LARGEST_TOTAL} can be dealt"
        )
    rng = np.random.default_rng(settings.seed)
    parts = deal(counts, 3, rng)
    evidence = [_observe(part, origin) for part in parts]
    chosen = _choose(evidence[0], total)
    return _Search(
        tuple(part[chosen] for part in parts),
        np.asarray(origin, np.int64)[chosen],
        settings,
        tuple(model),
        evidence,
        chosen,
        rng,
    ).run()


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


@dataclass
class _Search:
    """The state of the workflow."""

    parts: tuple[IntArray, ...]
    origin: IntArray
    settings: DiscrepancySettings
    model: tuple[Effect, ...]
    evidence: list[Evidence]
    chosen: NDArray[np.intp]
    rng: np.random.Generator
    n_replicates: int = 0
    untestable: dict[str, str] = field(default_factory=dict)

    def run(self) -> Discrepancy:
        """Look, name, add, show."""
        train, test, final = self.parts
        everything = np.ones(train.shape, np.bool_)
        arena = Arena(train, test, self.origin, everything, self.model, self._start())
        plain = arena.fit(())
        null, names, z = self._null(plain.log_masses)
        members, self.untestable, left_out = self._members()
        meter = Meter(final, everything, 0.0, self._count, self.rng)
        both = arena.fit((), plain.fit.parameters, train + test)
        before = meter.gap(arena.problem((), train + test), both.fit)
        found = None
        if self._disagrees(null, z):
            found = explain(arena, members, self._count, self.rng)
            left_out |= arena.failed | found.arena.failed
        last = null if found is None or not found.named else self._null(self._hybrid(found), names)[0]
        return tell_histograms(
            Measurements(
                parts=self.parts,
                settings=self.settings,
                model=self.model,
                evidence=self.evidence[0],
                maps=self._maps,
                nulls=(null, last),
                z=z,
                places=tuple(locate(self.evidence[0], null, (z[0] + z[1]) / 2.0, self.settings.significance)),
                still=self._disagrees(last, z),
                before=before,
                plain=both,
                untestable=self.untestable,
                left_out=left_out,
                n_replicates=self.n_replicates,
                n_pixels=int(self.chosen.size),
                rng=self.rng,
            ),
            found,
        )

    @property
    def _count(self) -> int:
        return max(self.settings.grown_replicates, _FEWEST_REPLICATES)

    def _start(self) -> FloatArray:
        maps = self.evidence[0].maps
        columns = (maps.quanta_exposure, maps.conversion_gain, maps.bias, maps.read_noise_dn)
        return np.stack([values.ravel()[self.chosen] for values in columns], axis=1)

    def _members(self) -> tuple[list[Member], dict[str, str], dict[str, str]]:
        members, untestable, failed = find_members(
            candidate_classes(self.settings), self.evidence[0], self.model
        )
        always = {tag: c.untestable for tag, c in effect_classes().items() if c.untestable}
        return members, dict(sorted((always | untestable).items())), failed

    def _null(
        self, log_masses: FloatArray, names: tuple[str, ...] | None = None
    ) -> tuple[NullModel, tuple[str, ...], tuple[FloatArray, ...]]:
        """Draw histograms from a law, observe each, refit included, and return what is normal there."""
        mass = np.exp(log_masses)
        mass /= mass.sum(axis=1, keepdims=True)
        total = self.parts[0].sum(axis=1)
        own = [_observe(part, self.origin).z for part in self.parts]
        vectors = []
        for _ in range(self.settings.replicates):
            vectors.append(_observe(self.rng.multinomial(total, mass), self.origin).z)
        self.n_replicates += len(vectors)
        if names is None:
            common = set(STATISTICS).intersection(*vectors, *own)
            names = tuple(name for name in STATISTICS if name in common)
        null = NullModel.from_replicates(names, as_matrix(names, vectors))
        return null, names, tuple(as_matrix(names, [row])[0] for row in own)

    def _disagrees(self, null: NullModel, z: tuple[FloatArray, ...]) -> bool:
        """Tell whether some statistic deviates more than chance allows, alike in both parts."""
        both = (z[0] + z[1]) / 2.0
        if null.global_p(both, splits=2) > self.settings.significance:
            return False
        alone = null.p_values(z[0]), null.p_values(z[1])
        same = (
            (alone[0] < _REPLICATION)
            & (alone[1] < _REPLICATION)
            & ((z[0] - null.mean) * (z[1] - null.mean) > 0)
        )
        limit = 1.0 - (1.0 - self.settings.significance) ** (1.0 / null.effective_tests)
        return bool(np.any(same & (null.p_values(both, splits=2) < limit)))

    def _hybrid(self, found: Explanation) -> FloatArray:
        """Return the log masses of all codes: the plain law where codes are set aside, else the grown one."""
        arena = found.arena
        judged = replace(arena, kept=found.kept)
        grown = judged.problem(found.best.members).log_masses(found.best.fit.theta, found.best.fit.shared)
        plain = found.plain.log_masses
        share = np.log(np.where(found.kept, np.exp(plain), 0.0).sum(axis=1, keepdims=True))
        return np.where(found.kept, grown + share, plain)

    def _maps(self, fitted: FittedSet) -> PixelMaps:
        """Return the parameters of the pixels looked at, NaN elsewhere, shape (1, n)."""
        n = self.evidence[0].maps.usable.size
        columns = np.full((4, n), np.nan)
        columns[:, self.chosen] = fitted.fit.parameters.T
        rows = [column.reshape(1, n) for column in columns]
        return PixelMaps(rows[0], rows[1], rows[2], rows[3], np.isfinite(rows[0]))
