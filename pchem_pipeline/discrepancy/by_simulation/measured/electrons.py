"""Empirical component: correlated electron numbers, from their variances and covariances.

The excess of the variance over Poisson is measured by the score of the second Charlier polynomial (Rao 1948),
covariances by the products of the expected electrons of neighbouring samples and of successive frames. Both
are divided by what one event for each electron, or for each of its pairs, would make.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, Float32Array, FloatArray, IntArray
from pchem_pipeline.discrepancy.by_simulation.measured.modes import CodeScores
from pchem_pipeline.discrepancy.by_simulation.measured.samples import (
    Distance,
    Measurement,
    PartSamples,
    frames_apart,
)
from pchem_pipeline.effects.estimators.charge_sums import charlier_information
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.effects.operators.fate import ElectronMode, EmpiricalElectrons, Fate
from pchem_pipeline.model.arithmetic.significance import BEYOND_DOUBT

_PLACES: tuple[Distance, ...] = ((1, 0, 0), (2, 0, 0), (3, 0, 0), (0, 0, 1), (0, 1, 0))
_OWN: Distance = (0, 0, 0)
_NEXT: Distance = (1, 0, 0)
_FEWEST = 1000  # products
_ALIKE = 2.0  # factor within which the chances are that electrons go, and that they come elsewhere
_MOST = 0.5  # of a chance


class Chance(NamedTuple):
    """Events for each electron, or for each of its pairs, and the standard error."""

    value: float
    error: float

    def less(self, other: Chance) -> Chance:
        """Return what is left beyond another one."""
        return Chance(self.value - other.value, float(np.hypot(self.error, other.error)))

    @property
    def clear(self) -> float:
        """The value in standard errors."""
        return self.value / self.error if np.isfinite(self.error) else 0.0


#: By what chances are measured: for each electron, and for each of its pairs.
Chances = tuple[Chance, Chance]
_NOTHING: Chances = (Chance(0.0, np.inf), Chance(0.0, np.inf))


class Electrons(NamedTuple):
    """Excess of the variance of electron numbers over Poisson, and covariances, both as further electrons."""

    excess: Chances
    together: dict[Distance, Chances]


def electron_chances(samples: PartSamples) -> Electrons:
    """Measure variances and covariances of electron numbers."""
    maps, evidence = samples.maps, samples.evidence
    inside = samples.inside & maps.usable & evidence.maps.usable & (maps.quanta_exposure > 0)
    if not inside.any():
        return Electrons(_NOTHING, {})
    u = samples.scores(0, inside)
    # what a whole frame shares is another thing
    u -= np.where(inside, u.sum(axis=(1, 2), keepdims=True) / inside.sum(), 0.0)
    exposure = np.where(inside, maps.quanta_exposure, 1.0)
    spread = np.where(inside, evidence.charge_std, 0.0)
    together = {place: _together(u, samples.numbers, exposure, spread, place) for place in _PLACES}
    return Electrons(_excess(samples.frames, maps, inside), together)


def _together(
    u: Float32Array, numbers: IntArray, exposure: FloatArray, spread: FloatArray, place: Distance
) -> Chances:
    """Return the covariance of electrons with those at a distance, per electron and per pair of them.

    ``u`` are expected electrons beyond the mean, in units of their standard deviation ``spread``, e-, both 0
    where not known; ``exposure`` is H, e-.
    """
    first, later = frames_apart(numbers, place[0])
    ny, nx = exposure.shape
    here = slice(0, ny - place[1]), slice(0, nx - place[2])
    there = slice(place[1], ny), slice(place[2], nx)
    one, two = u[(slice(None), *here)], u[(slice(None), *there)]
    products = sum(np.einsum("yx,yx->yx", one[a], two[b]) for a, b in zip(first, later, strict=True))
    # what one further electron there, for each that is here, does to that product
    for_each = spread[here] * spread[there] / exposure[there]
    known = for_each > 0.0
    if first.size * np.count_nonzero(known) < _FEWEST:
        return _NOTHING
    sums, for_each = np.asarray(products)[known], for_each[known]
    return _chance(sums, first.size, for_each), _chance(sums, first.size, for_each * exposure[here][known])


def _excess(frames: NDArray[np.unsignedinteger], maps: PixelMaps, inside: BoolArray) -> Chances:
    """Return the excess of the variance over Poisson, per electron and per pair of them."""
    pixels = np.flatnonzero(inside.ravel())
    score = CodeScores.of(frames, maps, pixels).of_samples(-1).sum(axis=0)
    exposure, gain, _, sigma = (values.ravel()[pixels] for values in maps.maps)
    number = len(frames) * charlier_information(exposure, gain * sigma)
    # of further electrons Var K = H + 2 c H, of pairs H + 2 c H^2
    return _chance(score, number, 2.0 / exposure), _chance(score, number, np.full(exposure.size, 2.0))


def _chance(sums: FloatArray, variance: FloatArray | float, response: FloatArray) -> Chance:
    """Return the chance c of sums of mean ``c response variance`` by least squares."""
    weight = float(np.sum(variance * response**2))
    if weight <= 0.0:
        return Chance(0.0, np.inf)
    return Chance(float(response @ sums) / weight, weight**-0.5)


def measured_electrons(data: Electrons, model: Electrons) -> Measurement | None:
    """Return what electrons do beyond those of frames simulated with a model, if anything is clear."""
    following = {
        place: _beyond(chances, model.together.get(place, _NOTHING))
        for place, chances in data.together.items()
    }
    each, _ = following.get(_NEXT, _NOTHING)
    chain = each.value if each.clear > BEYOND_DOUBT else 0.0
    more, of_pairs = _without_chain(*_beyond(data.excess, model.excess), chain)
    found: list[tuple[Fate, Distance, float]] = []
    # what makes electrons come in company: others that follow them, or samples without any
    ways: list[tuple[float, tuple[Fate, Distance, float]]] = []
    if more.clear > BEYOND_DOUBT:
        ways.append((more.clear, ("followed", _OWN, more.value)))
    if of_pairs.clear > BEYOND_DOUBT:
        # of samples of which a share p is emptied Var K = H + p / (1 - p) H^2
        emptied = 2.0 * of_pairs.value / (1.0 + 2.0 * of_pairs.value)
        ways.append((of_pairs.clear, ("emptied", _OWN, emptied)))
    fate: Fate = "lost"
    where, lost = _OWN, -of_pairs.value if of_pairs.clear < -BEYOND_DOUBT else 0.0
    gain = 0.5 * max(abs(more.clear), abs(of_pairs.clear)) ** 2 if ways or lost else 0.0
    for place, (each, arriving) in following.items():
        # those that came to the next frame have brought others themselves
        each = each._replace(value=each.value - (chain ** place[0] if place[0] > 1 else 0.0))
        if each.clear < BEYOND_DOUBT:
            continue
        gain += 0.5 * each.clear**2
        if fate == "lost" and lost < _ALIKE * arriving.value < _ALIKE**2 * lost:
            fate, where = "moved", place
        else:
            found.append(("followed", place, each.value))
    if lost:
        found.append((fate, where, lost))
    likeliest_first = [way for _, way in sorted(ways, key=lambda way: -way[0])]
    effects = [_effect([way, *found]) for way in likeliest_first] or ([_effect(found)] if found else [])
    return Measurement(effects[0], gain, tuple(effects[1:])) if effects else None


def _without_chain(more: Chance, of_pairs: Chance, chain: float) -> Chances:
    """Return the excess of the variance without what electrons make that bring ``chain`` to the next frame.

    ``K' = N + Poisson(c K)`` has the variance ``E[K] / (1 - c^2)`` in the long run.
    """
    made = 0.5 * chain**2 / (1.0 - chain**2)
    left = 1.0 - min(made / more.value, 1.0) if more.value > 0.0 else 1.0
    return more._replace(value=more.value - made), of_pairs._replace(value=of_pairs.value * left)


def _effect(events: Sequence[tuple[Fate, Distance, float]]) -> EmpiricalElectrons:
    """Return the effect of events: what happens, where, and the chance."""
    chance = max(value for _, _, value in events)
    modes = tuple(
        ElectronMode(fate=fate, place=place, weight=round(value / chance, 4)) for fate, place, value in events
    )
    return EmpiricalElectrons(chance=min(chance, _MOST), modes=modes)


def _beyond(data: Chances, model: Chances) -> Chances:
    """Return what is left of chances beyond those that a model makes."""
    return data[0].less(model[0]), data[1].less(model[1])
