"""The likelihood of the pixels' histograms, asked where the statistics distinguish effects badly.

Two effects on the law of a sample (a wide tail, a skew) may differ little in the statistics of a search. The
joint likelihood of the pixels' own parameters and all those of such effects holds all that the histograms
say, for a fraction of the cost of one simulation.
"""

from __future__ import annotations

import copy
import functools
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray
from pchem_pipeline.base.errors import ConfigError, error_words
from pchem_pipeline.discrepancy.by_likelihood.members import Member, law_of, leads_in_histograms
from pchem_pipeline.discrepancy.by_likelihood.sets import PROBED, FittedSet, SetComparison
from pchem_pipeline.discrepancy.by_simulation.candidates.fingerprints import LARGEST_FACTOR, Hypothesis
from pchem_pipeline.discrepancy.by_simulation.candidates.satellites import FAR_SHARE, with_satellites
from pchem_pipeline.discrepancy.by_simulation.sensor.maps import multistart
from pchem_pipeline.discrepancy.effort import Effort
from pchem_pipeline.discrepancy.observe.places import Part
from pchem_pipeline.effects.framework.effect import Effect, tag_of
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.model.arithmetic.significance import DECISIVE, NO_DIFFERENCE
from pchem_pipeline.model.histogram.count import histogram_frames

_log = logging.getLogger(__name__)

#: Pixels that tell effects apart.
MANY_PIXELS = 1024
#: Pixels that tell numbers well enough to begin with.
FEW_PIXELS = 256
MOST_STARTS = 3  # of one effect
MOST_IN_A_PART = 2  # hypotheses of an effect, or effects for which no estimator speaks
# nats that an effect for which no estimator speaks must explain, and times as strong as is typical, where a
# plain fit is led astray
_SPEAKS, _STRONG = 15.0, 5.0
_REMEMBERED = 12  # fits: each holds the masses of all codes
_ASTRAY = 5.0  # nats of a pixel that an effect explains, from which on it may mistake the peak of no electron
_FEWEST_PIXELS, _FEWEST_FRAMES = 16, 200  # of a place, whose histograms tell numbers


class PixelLikelihood:
    """Histograms of some pixels, all over the sensor, and the effects that the model has besides."""

    def __init__(
        self,
        frames: NDArray[np.unsignedinteger],
        maps: PixelMaps,
        present: Sequence[Effect],
        effort: Effort,
        pixels: int = MANY_PIXELS,
        defects: dict[str, str] | None = None,
    ) -> None:
        """Count the samples.

        Args:
            frames: (frame, y, x), DN.
            maps: of their pixels under the model.
            present: effects of the model, which act everywhere.
            effort: counts the work.
            pixels: about so many are looked at.
            defects: effects that failed, and why; out.
        """
        step = max(1, np.count_nonzero(maps.usable) // pixels)
        y, x = (each[::step] for each in np.nonzero(maps.usable))
        histograms = histogram_frames(frames[:, y, x][:, None, :])
        counts = histograms.counts[0].astype(np.int64)
        origin, start = histograms.origin[0].astype(np.int64), maps.of((y, x)).columns
        kept = np.ones(counts.shape, np.bool_)
        self._sets = SetComparison(counts, counts, origin, kept, tuple(present), start, effort=effort)
        self._asked: dict[tuple[frozenset[str], tuple[Effect, ...]], FittedSet | None] = {}
        self._without: dict[tuple[Effect, ...], float] = {}  # log-likelihood, by what is present
        self._defects = {} if defects is None else defects

    @functools.cached_property
    def fewer(self) -> PixelLikelihood:
        """That of a part of these pixels, a first answer for a fraction of the work; itself if few."""
        n = len(self._sets.train)
        if n <= 2 * PROBED:
            return self
        found = copy.copy(self)
        found._sets = self._sets.of(slice(None, None, n // PROBED), self._sets.start)
        found._asked, found._without = {}, {}
        return found

    def fitted(self, guesses: Sequence[Effect]) -> list[tuple[float, Effect]]:
        """Return an effect as fitted from several starts, with its gain in nats, the likeliest first."""
        fits: list[tuple[float, Effect]] = []
        for guess in guesses[:MOST_STARTS]:
            one = self._fit([guess], ())
            if one is None or one.members[0].at_limit:
                continue
            rise = float(one.fit.log_likelihood.sum()) - self._without[self._sets.present]
            if not any(abs(rise - known) < NO_DIFFERENCE for known, _ in fits):
                fits.append((rise, one.members[0].effect))
        return sorted(fits, key=lambda fit: -fit[0])

    def suggested(self, kinds: Iterable[type[Effect]]) -> list[Effect]:
        """Return effects that explain much of the histograms, fitted from two strengths, the likeliest first.

        An estimator sees nothing of an effect so strong that the bias of the pixels is off by an electron.
        """
        fits: list[tuple[float, Effect]] = []
        for kind in kinds:
            # an effect of a plug-in may raise anything: the others are compared all the same
            try:
                starts = _starts(kind)
            except Exception as error:
                note_defect(self._defects, tag_of(kind), error)
                continue
            rough = self.fewer.fitted(starts)
            # an effect that explains less in few pixels is not in more of them
            if rough and rough[0][0] > NO_DIFFERENCE:
                fits += rough[:1] if self.fewer is self else self.fitted([rough[0][1]])
        return [effect for rise, effect in sorted(fits, key=lambda fit: -fit[0]) if rise > _SPEAKS]

    def begun(self, hypotheses: Sequence[Hypothesis]) -> tuple[Hypothesis, ...]:
        """Return the effects of a set at the parameters that are likeliest together, where a law has them."""
        fit = self._fit_set([h.effect for h in hypotheses])
        if fit is None or any(member.at_limit for member in fit.members):
            return tuple(hypotheses)
        likely = {member.tag: member.effect for member in fit.members}
        return tuple(_at(h, likely[h.tag]) if h.tag in likely else h for h in hypotheses)

    def standard_errors(self, hypotheses: Sequence[Hypothesis]) -> dict[str, dict[str, float]]:
        """Return the standard errors of the fields of a set that a law has, by tag."""
        fit = self._fit_set([h.effect for h in hypotheses])
        return {} if fit is None else {member.tag: fit.stderr(member) for member in fit.members}

    def behind(self, one: Sequence[Effect], other: Sequence[Effect]) -> tuple[float, float] | None:
        """Return how far a set is behind another in likelihood, nats, and the standard error (Vuong 1989).

        Each parameter of an effect costs a nat (Akaike 1974). None where they cannot be fitted. They differ
        only in effects that are `identifiable_from_histograms`.
        """
        first, second = self._fit_set(one), self._fit_set(other, one)
        if first is None or second is None:
            return None
        rise, error = self._sets.difference(first, second)
        return rise - (first.fit.shared.size - second.fit.shared.size), error

    def _fit_set(self, effects: Sequence[Effect], like: Sequence[Effect] | None = None) -> FittedSet | None:
        """Fit the `identifiable_from_histograms` effects of a set beside its others, or those of ``like``."""
        own = [e for e in effects if identifiable_from_histograms(e)]
        others = effects if like is None else like
        besides = tuple(e for e in others if not identifiable_from_histograms(e))
        # other strengths of the same lead to the same fit
        asked = frozenset(e.model_dump_json(exclude={e.strength}) for e in own), besides
        if asked not in self._asked:
            if len(self._asked) >= _REMEMBERED:
                del self._asked[next(iter(self._asked))]
            self._asked[asked] = self._fit(own, besides)
        return self._asked[asked]

    def _fit(self, effects: Sequence[Effect], besides: Sequence[Effect]) -> FittedSet | None:
        """Fit effects; None where that cannot be done, or led to less than there is without them."""
        try:
            sets = replace(self._sets, present=(*self._sets.present, *besides))
            fitted = sets.fit([Member.of(effect) for effect in effects])
            if not fitted.fit.converged:
                fitted = sets.fit(fitted.members, fitted.fit.parameters)
            without = self._without.get(sets.present)
            if without is None:
                without = float(sets.fit(()).fit.log_likelihood.sum())
                self._without[sets.present] = without
            fitted = _multistart(sets, fitted)
            if fitted.fit.log_likelihood.sum() - without > _ASTRAY * len(fitted.fit.log_likelihood):
                fitted = sets.with_right_peaks(fitted)
        except (ValueError, ConfigError):  # such parameters do not go together, or are no law of the pixels
            return None
        # an effect of a plug-in may raise anything: the others are compared all the same
        except Exception as error:
            note_defect(self._defects, (*besides, *effects)[-1].tag, error)
            return None
        return None if without - float(fitted.fit.log_likelihood.sum()) > NO_DIFFERENCE else fitted


@dataclass(frozen=True)
class HistogramLikelihood:
    """Asks ``of`` for the `PixelLikelihood` with some effects, of about so many pixels; None: no one law."""

    of: Callable[[Sequence[Effect], int], PixelLikelihood | None] = lambda effects, pixels: None

    def begun(self, hypotheses: Sequence[Hypothesis]) -> tuple[Hypothesis, ...]:
        """Return a set at its likeliest parameters; see `PixelLikelihood.begun`."""
        pixels = self._pixels(hypotheses)
        return tuple(hypotheses) if pixels is None else pixels.begun(hypotheses)

    def standard_errors(self, hypotheses: Sequence[Hypothesis]) -> dict[str, dict[str, float]]:
        """Return standard errors by tag and field; see `PixelLikelihood.standard_errors`."""
        pixels = self._pixels(hypotheses)
        return {} if pixels is None else pixels.standard_errors(hypotheses)

    def _pixels(self, hypotheses: Sequence[Hypothesis]) -> PixelLikelihood | None:
        """Return the likelihood for a set, of few pixels where only strengths are fitted; None: no law."""
        own = [h.effect for h in hypotheses if identifiable_from_histograms(h.effect)]
        number = MANY_PIXELS if any(len(Member.of(e).coordinates) > 1 for e in own) else FEW_PIXELS
        return self.of([h.effect for h in hypotheses], number) if own else None

    def behind(self, one: Sequence[Effect], other: Sequence[Effect]) -> tuple[float, float] | None:
        """Return how far a set is behind another by many pixels; see `PixelLikelihood.behind`.

        None also where they differ in what no law of a sample holds.
        """
        tags = {e.tag for e in one} ^ {e.tag for e in other}
        if not all(identifiable_from_histograms(e) for e in (*one, *other) if e.tag in tags):
            return None
        pixels = self.of((*one, *other), MANY_PIXELS)
        return None if pixels is None else pixels.behind(one, other)


@dataclass
class Histograms:
    """The pixels of a stack, place by place.

    Attributes:
        frames: (frame, y, x), DN.
        maps: of their pixels under the model.
        present: effects of the model.
        effort: counts the work.
        samples_of: returns the frames, (frame,), and the pixels, (y, x), of a part.
        defects: effects that failed, and why; out.
        told: effects whose parameters were fitted to the histograms; out.
    """

    frames: NDArray[np.unsignedinteger]
    maps: PixelMaps
    present: Sequence[Effect]
    effort: Effort
    samples_of: Callable[[Part], tuple[BoolArray, BoolArray]]
    defects: dict[str, str] = field(default_factory=dict)
    told: list[Effect] = field(default_factory=list)
    _known: dict[Part, PixelLikelihood | None] = field(default_factory=dict, repr=False)

    def with_numbers(self, guesses: Sequence[Effect]) -> list[Effect]:
        """Return guesses with parameters fitted to histograms, the likeliest of an effect in a place first.

        Of effects with a law, and of those that give single pixels levels of their own; others stay.
        """
        by_place: dict[Part, dict[str, list[Effect]]] = {}
        for g in guesses:
            by_place.setdefault(Part(g.region, g.when), {}).setdefault(g.tag, []).append(g)
        likely: dict[tuple[str, Part], list[Effect]] = {}
        for place, own in by_place.items():
            anywhere = {tag: [g.at_place(None) for g in there] for tag, there in own.items()}
            known = {tag: gs for tag, gs in anywhere.items() if any(map(identifiable_from_histograms, gs))}
            by = self._of(place) if known else None
            numbers = {} if by is None else _likeliest(by, known)
            levels: dict[str, list[Effect]] = {}
            if (samples := self._samples(place)) is not None:
                levels = with_satellites(*samples, self.present, anywhere, self.effort, self.defects)
            for tag, effects in (numbers | levels).items():
                likely[tag, place] = [e.at_place(place.region, place.when) for e in effects]
                self.told += likely[tag, place] if tag in numbers else []
        found: list[Effect] = []
        for tag in dict.fromkeys(g.tag for g in guesses):
            for place, own in by_place.items():
                found += likely.get((tag, place)) or own.get(tag, [])
        return found

    def suggested(
        self, classes: Mapping[str, type[Effect]], parts: Sequence[Part], guesses: Sequence[Effect]
    ) -> list[Effect]:
        """Return what explains much of the histograms of parts, of effects that are not guessed there."""
        found: list[Effect] = []
        for part in parts:
            known = {g.tag for g in guesses if (g.region, g.when) == (part.region, part.when)}
            by = self._of(part)
            kinds = [kind for tag, kind in classes.items() if tag not in known]
            likely = [] if by is None else by.suggested(kinds)[:MOST_IN_A_PART]
            found += [effect.at_place(part.region, part.when) for effect in likely]
        self.told += found
        return found

    def _of(self, part: Part) -> PixelLikelihood | None:
        """Return the likelihood of the samples of a part; None: they are too few, or have no one law."""
        if part not in self._known:
            known = None
            if (own := self._samples(part)) is not None:
                known = PixelLikelihood(*own, self.present, self.effort, FEW_PIXELS, self.defects)
            self._known[part] = known
        return self._known[part]

    def _samples(self, part: Part) -> tuple[NDArray[np.unsignedinteger], PixelMaps] | None:
        """Return the frames of a part, and the maps of its pixels; None as above."""
        some, inside = self.samples_of(part)
        usable = self.maps.usable & inside
        enough = usable.sum() >= _FEWEST_PIXELS and some.sum() >= _FEWEST_FRAMES
        if not enough or not all(each.everywhere for each in self.present):
            return None
        return self.frames if some.all() else self.frames[some], replace(self.maps, usable=usable)


def _likeliest(by: PixelLikelihood, guesses: Mapping[str, Sequence[Effect]]) -> dict[str, list[Effect]]:
    """Return effects as fitted to a part of the pixels of a place, by tag; those near the best, to all."""
    few = by.fewer
    rough = {tag: few.fitted(own) for tag, own in guesses.items()}
    best = max((fits[0][0] for fits in rough.values() if fits), default=0.0)
    found = {}
    for tag, fits in rough.items():
        near = bool(fits) and fits[0][0] > (1.0 - FAR_SHARE) * best - DECISIVE
        fits = by.fitted([effect for _, effect in fits]) if near and few is not by else fits
        found[tag] = [effect for _, effect in fits]
    return found


def _at(hypothesis: Hypothesis, effect: Effect) -> Hypothesis:
    """Return a hypothesis with its effect at other numbers, its fingerprint in proportion to the strength."""
    old, new = (float(getattr(e, e.strength)) for e in (hypothesis.effect, effect))
    factor = max(new / old, 0.0) ** effect.power if old else 0.0
    if not 1.0 / LARGEST_FACTOR < factor < LARGEST_FACTOR:
        return hypothesis
    return replace(hypothesis, effect=effect, fingerprint=hypothesis.fingerprint * factor)


def _starts(kind: type[Effect]) -> tuple[Effect, ...]:
    """Return what is typical of an effect and the same stronger; nothing where no law has it."""
    typical = next((e for e in kind.typical() if e.strength and identifiable_from_histograms(e)), None)
    return () if typical is None else (typical, typical.scaled(_STRONG))


def _multistart(sets: SetComparison, fitted: FittedSet) -> FittedSet:
    """Return a fit with the pixels that samples below all others led astray put right, or as it is."""
    parameters, shared = fitted.fit.parameters, fitted.fit.shared
    law = law_of(sets.present, fitted.members, shared, parameters, sets.samples)
    moved, start = multistart(sets.train, sets.origin, law, parameters)
    if not moved.size:
        return fitted
    other = sets.fit(fitted.members, start)
    return max(fitted, other, key=lambda one: float(one.fit.log_likelihood.sum()))


def identifiable_from_histograms(effect: Effect) -> bool:
    """Return whether the law of a sample holds all numbers of an effect that its histograms show first."""
    kind = type(effect)
    if not effect.everywhere or kind.rough_law or kind.random_realisation:
        return False
    if not kind.signature or not leads_in_histograms(kind):
        return False
    member = Member.of(effect)
    try:
        return not member.law.free_satellites and not member.tabulated and bool(member.coordinates)
    except ConfigError:
        return False


def note_defect(defects: dict[str, str], tag: str, error: Exception) -> None:
    """Keep why an effect is not compared, and warn."""
    defects[tag] = error_words(error)
    _log.warning("candidate %s failed and is not compared: %s", tag, defects[tag])
