"""Empirical component: response of samples to the charge of others, by distance and of whole lines.

Matching pursuit (Mallat and Zhang 1993) in the map of all distances: what stands out most, one distance or
all samples of a row, a column or a frame, is subtracted, and the rest searched again. Electrons of different
samples are independent, so that what is found first does not move what comes later.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pchem_pipeline.base.arrays import BoolArray, FloatArray
from pchem_pipeline.discrepancy.by_simulation.measured.samples import Distance, Measurement, PartSamples
from pchem_pipeline.discrepancy.observe.digital import GROUP
from pchem_pipeline.discrepancy.observe.follows import SOURCES, FollowingSamples, Follows
from pchem_pipeline.discrepancy.observe.sums import blocks_of
from pchem_pipeline.effects.framework.evidence import Evidence
from pchem_pipeline.effects.framework.neighbours import neighbours
from pchem_pipeline.effects.operators.couple import AXES, Axis, EmpiricalResponse, ResponseTerm, Source
from pchem_pipeline.model.arithmetic.significance import CLEAR, DECISIVE

Mirrored = tuple[Axis, ...]

_MIRRORED: tuple[Mirrored, ...] = ((), ("rows",), ("columns",), ("rows", "columns"))
_CLEAR = 20.0  # nats that a term must be worth beyond the number of those that are tried
_DETAIL = 1e-3  # of the nats of the first term: less may be how the pixels differ in it
_MOST_TERMS = 16
_NEARLY_ALL = 0.7  # of the columns
_HIGHEST, _FAR = 30, 3.0  # electrons, and standard deviations of the charge: more are hardly ever exceeded
_STEPS = 8  # up to that, before all numbers near the clearest are tried


class Responses(NamedTuple):
    """The frames, with their charge as it is and mirrored, and its covariances with the residuals."""

    views: Mapping[Mirrored, FollowingSamples]
    covariances: Mapping[Mirrored, Follows]


def residual_responses(samples: PartSamples) -> Responses | None:
    """Measure how the residuals of samples go with the charge of others; None where frames are too few."""
    edges = blocks_of(samples.numbers, samples.numbers.size)
    own = FollowingSamples.of(samples.frames, edges, samples.laws, samples.maps, samples.inside)
    if own is None:
        return None
    views = {along: replace(own, mirrored=tuple(AXES[each] for each in along)) for along in _MIRRORED}
    covariances = own.by_distance([view.mirrored for view in views.values()])
    return Responses(views, dict(zip(views, covariances, strict=True)))


class _Term(NamedTuple):
    """What is followed, and by which columns.

    Attributes:
        of, place: see `ResponseTerm`.
        value: the mean product; of what exceeds a number of electrons the slope, 1/e-.
        gain: what it is worth, nats.
        columns: that follow; None: all.
        above: electrons.
        mirrored: along what; see `ResponseTerm`.
    """

    of: Source
    place: Distance
    value: float
    gain: float
    columns: tuple[int, int] | None = None
    above: int = 0
    mirrored: Mirrored = ()


def measured_response(
    data: Responses | None, model: Responses | None, evidence: Evidence, inside: BoolArray
) -> Measurement | None:
    """Return which samples of pixels ``inside``, (y, x), follow which beyond what a model makes, if clear."""
    if data is None:
        return None
    left = {
        along: _Left.of(own, None if model is None else model.covariances[along])
        for along, own in data.covariances.items()
    }
    terms: list[_Term] = []
    while len(terms) < _MOST_TERMS:
        seen = [
            one._replace(mirrored=along)
            for along, each in left.items()
            if (one := each.clearest(bool(along)))
        ]
        term = max(seen, key=lambda one: one.gain, default=None)
        if term is None or (terms and term.gain < _DETAIL * terms[0].gain):
            break
        view = data.views[term.mirrored]
        found = _in_columns(view, term)
        left[term.mirrored].take_off(term)
        if term.of != "sample":
            # whole lines are in all mirror images, too
            left = {along: each for along, each in left.items() if not along}
        for along, other in left.items():
            if along != term.mirrored:
                other.take_off_pairs(data.views[along], view, found)
        # details of the clearest one would be told as terms of their own
        terms.append(found if terms else _beyond(view, found))
    if not terms:
        return None
    responses = [term.value / _response_of_one(evidence, inside, term) for term in terms]
    largest = max(abs(response) for response in responses)
    ny, nx = inside.shape
    numbers: dict[Source, int] = {"sample": 1, "row": nx, "column": ny, "frame": ny * nx}
    effect = EmpiricalResponse(
        response=min(largest, 1.0),
        terms=tuple(
            ResponseTerm(
                of=term.of,
                place=term.place,
                weight=round(response / largest, 4),
                number=numbers[term.of],
                columns=term.columns,
                above=float(term.above),
                mirrored=term.mirrored,
            )
            for term, response in zip(terms, responses, strict=True)
        ),
    )
    return Measurement(effect, sum(term.gain for term in terms))


@dataclass
class _Left:
    """Sums of products that are not explained yet, and their variances; see :class:`Follows`."""

    products: FloatArray
    pairs: FloatArray
    wider: dict[Source, float]

    @classmethod
    def of(cls, data: Follows, model: Follows | None) -> _Left:
        """Return what is left of the products of the data beyond those of a model that are certain."""
        products = data.products.copy()
        if model is not None:
            sure = np.abs(np.nan_to_num(model.z("sample"))) > CLEAR
            products -= np.where(sure, model.products / np.maximum(model.pairs, 1.0) * data.pairs, 0.0)
        return cls(products, data.pairs, data.wider)

    def clearest(self, mirrored: bool) -> _Term | None:
        """Return what is followed most clearly, if anything is; if mirrored, of single samples only."""
        best: _Term | None = None
        now = Follows(self.products, self.pairs, self.wider)
        for source in SOURCES[:1] if mirrored else SOURCES:
            z: FloatArray = np.nan_to_num(now.z(source))
            at = tuple(int(i) for i in np.unravel_index(int(np.argmax(np.abs(z))), z.shape))
            gain = 0.5 * float(z[at]) ** 2 - math.log(max(int(np.count_nonzero(z)), 1))
            if gain > (_CLEAR if best is None else best.gain):
                products, pairs = now.of(source)
                place = (-at[0], at[1] - z.shape[1] // 2, at[2] - z.shape[2] // 2)
                best = _Term(source, place, float(products[at] / pairs[at]), gain)
        return best

    def take_off(self, term: _Term) -> None:
        """Subtract what a term makes of all its distances."""
        y, x = (size // 2 for size in self.products.shape[1:])
        rows = slice(None) if term.of in ("column", "frame") else y + term.place[1]
        columns = slice(None) if term.of in ("row", "frame") else x + term.place[2]
        here = -term.place[0], rows, columns
        self.products[here] -= term.value * self.pairs[here]

    def take_off_pairs(self, own: FollowingSamples, view: FollowingSamples, term: _Term) -> None:
        """Subtract what single samples found in another view make of the distances of the own one."""
        ny, nx = view.inside.shape
        y, x = np.nonzero(view.inside)
        there_y, there_x = y + term.place[1], x + term.place[2]
        known = (there_y >= 0) & (there_y < ny) & (there_x >= 0) & (there_x < nx)
        known &= np.isin(x, np.arange(nx)[_columns(term)])
        known[known] = view.told[there_y[known], there_x[known]]
        # mirrored twice is as it was
        distances = []
        for axis, (here, at) in enumerate(((y, there_y), (x, there_x)), 1):
            turned = (axis in own.mirrored) != (axis in view.mirrored)
            at = view.inside.shape[axis - 1] - 1 - at if turned else at
            distances.append((at - here)[known] + self.products.shape[axis] // 2)
        number = view.groups * (GROUP + term.place[0])
        np.subtract.at(self.products, (-term.place[0], *distances), term.value * number)


def _columns(term: _Term) -> slice:
    """Return the columns that follow."""
    return slice(*term.columns) if term.columns else slice(None)


def _in_columns(samples: FollowingSamples, term: _Term) -> _Term:
    """Return a term with the columns that follow, where others have no sample or clearly do not."""
    if term.of != "sample":
        return term
    products, pairs = samples.by_column(term.place)
    sums, counts = (np.concatenate([[0.0], np.cumsum(values)]) for values in (products, pairs))
    first, last = np.triu_indices(sums.size, 1)
    number = np.maximum(counts[last] - counts[first], 1.0)
    gains = 0.5 * (sums[last] - sums[first]) ** 2 / number
    best = int(np.argmax(gains))
    if gains[best] < 0.5 * sums[-1] ** 2 / max(counts[-1], 1.0) + _CLEAR + np.log(first.size):
        some = np.flatnonzero(pairs)
        few = some.size < _NEARLY_ALL * pairs.size
        return term._replace(columns=(int(some[0]), int(some[-1]) + 1)) if few else term
    a, b = int(first[best]), int(last[best])
    return term._replace(
        value=float((sums[b] - sums[a]) / number[best]), gain=float(gains[best]), columns=(a, b)
    )


def _beyond(samples: FollowingSamples, term: _Term) -> _Term:
    """Return a term by the charge above a threshold, where that is followed far more clearly than all."""
    if term.of != "sample":
        return term
    most = min(int(np.max(samples.exposure + _FAR * np.sqrt(samples.exposure))), _HIGHEST)
    step = max(-(-most // _STEPS), 1)
    found: dict[int, tuple[float, float]] = {}  # nats and slope

    def clearest_of(numbers: Iterable[int]) -> int:
        tried = sorted({*numbers} - {*found})
        products, squares = samples.by_excess(term.place, term.columns, np.array(tried, np.int64))
        for number, product, square in zip(tried, products.tolist(), squares.tolist(), strict=True):
            if square > 0.0:
                found[number] = 0.5 * product**2 / square, product / square
        return max(found, default=0, key=lambda number: found[number][0])

    best = clearest_of(range(0, most + 1, step))
    if step > 1:
        best = clearest_of(range(max(best - step + 1, 0), best + step))
    if best == 0 or found[best][0] < found.get(0, (0.0, 0.0))[0] + DECISIVE:
        return term
    gain, slope = found[best]
    return term._replace(value=slope, gain=gain, above=best)


def _response_of_one(evidence: Evidence, inside: BoolArray, term: _Term) -> float:
    """Return the mean product where samples follow by all of the charge.

    A shift of i by K_j changes ``E[R_i | x]`` by ``K_j Var(r_i) / sigma_i^2`` on average.
    """
    maps = evidence.maps
    gain = np.where(maps.usable, maps.conversion_gain, np.nan)
    noise = (maps.read_noise_dn * gain) ** 2
    readout, charge = (evidence.readout_std * gain) ** 2, evidence.charge_std**2
    mixed = (maps.quanta_exposure + noise - readout - charge) / 2.0
    shift = np.where(inside, np.sqrt(readout) / noise, np.nan)
    if term.above:
        return float(np.nanmean(shift[:, _columns(term)]))
    apart = np.sqrt(np.maximum(charge - mixed**2 / readout, 0.0))
    if term.of != "sample":
        return float(np.nanmean(shift) * np.nanmean(apart))
    turned = np.flip(apart[None], tuple(AXES[each] for each in term.mirrored))
    source, known = neighbours(np.ascontiguousarray(turned), (0, *term.place[1:]))
    pairs = np.where(known[0], source[0], np.nan) * shift
    return float(np.nanmean(pairs[:, _columns(term)]))
