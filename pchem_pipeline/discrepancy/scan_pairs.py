"""Places whose pixels share noise of their rows, columns or frames: a scan over all pairs of pixels.

Of every band of lines, every band across them, every rectangle, every n-th line, and the lines that stand out
each by itself the mean covariance of the pairs inside is compared with that of all other pairs, so that noise
which all pixels share has no place. The standard error is ``1 / sqrt(N)`` of N pairs (:mod:`.observe.pairs`),
or what the frames' scatter gives where that is more; the sum of squares behind it is skewed, which Wilson and
Hilferty's root takes away. The probability is the union bound over the places of the family, the families,
modes and channels.

Boxes are of cells, each of several rows or columns of a large sensor; each round of finer cells
(:func:`.families.with_sharp_ends`) is another pass over the frames.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import special

from pchem_pipeline.base.arrays import BoolArray
from pchem_pipeline.discrepancy.families import BOXES, Edges, Place, box, box_sums, every_nth, with_sharp_ends
from pchem_pipeline.discrepancy.observe.laws import chi_square
from pchem_pipeline.discrepancy.observe.pairs import (
    FEWEST_PIXELS,
    LARGEST,
    MODES,
    PairContrast,
    Samples,
    energies,
    pairs_of,
)
from pchem_pipeline.discrepancy.observe.sums import CHANNELS
from pchem_pipeline.discrepancy.scan import Suspect
from pchem_pipeline.effects.framework.region import Region, Taps
from pchem_pipeline.model.arithmetic.significance import SIGNIFICANCE

_CONTRAST = 0.4  # mean outside of a place over that inside, at most
#: Guesses that are held against the scatter of the frames, the most significant first.
_MEASURED = 8
#: Families of places (boxes, and two of lines at a period and scattered lines), modes and channels; half of
#: them, since places count to one side only.
_LOG_LOOKS = math.log((len(BOXES) + 2) * len(MODES) * len(CHANNELS) / 2.0)
_LINE_BY_CHANCE = 1e-4  # probability of a line that stands out by itself, among all


@dataclass(frozen=True, kw_only=True)
class Shared(Suspect):
    """A place whose pixels move together, unlike the rest; inside and outside are mean correlations of pairs.

    Attributes:
        channel: 0 for electron numbers, 1 for residuals.
        mode: row, column or frame: what the pixels share.
    """

    channel: int
    mode: str


class _Guess(NamedTuple):
    """The best place of a family, of one channel and mode."""

    place: Place
    channel: int
    mode: str


def scan_pairs(samples: Samples, *, significance: float = SIGNIFICANCE, most: int = 2) -> list[Shared]:
    """Return the places whose pixels share noise, the most significant first, each without those before it.

    Args:
        samples: standardised frames.
        significance: largest probability of a chance in any place, mode and channel.
        most: places at most.
    """
    found: list[Shared] = []
    while len(found) < most and samples.usable.sum() > 2 * FEWEST_PIXELS:
        place = _most_significant(samples, math.log(significance))
        if place is None:
            break
        found.append(place)
        samples = samples.without(place.region.mask(samples.usable.shape))
    return found


def shared_elsewhere(samples: Samples, place: Shared, *, significance: float = SIGNIFICANCE) -> Region | None:
    """Return all pixels outside a place if they share noise among themselves as those inside do; else None.

    Args:
        samples: standardised frames.
        place: found among them.
        significance: largest probability of a chance.
    """
    rest = samples.without(place.region.mask(samples.usable.shape))
    if rest.usable.sum() <= 2 * FEWEST_PIXELS:
        return None
    pairs = pairs_of(rest)[place.channel][place.mode]
    z = float(pairs.sums.flat[-1]) / math.sqrt(max(2.0 * float(pairs.counts.flat[-1]), 1.0))
    return Region.of_mask(rest.usable) if special.log_ndtr(-z) <= math.log(significance) else None


def _most_significant(samples: Samples, log_limit: float) -> Shared | None:
    """Return the place of the smallest probability that holds against the scatter of the frames, too."""
    # the tables of pairs are large, and what is guessed from them is all that is kept
    guesses = [
        _Guess(place, channel, mode)
        for channel, modes in enumerate(pairs_of(samples))
        for mode, contrast in modes.items()
        for place in _places(contrast, mode, samples.usable)
        if place is not None
    ]
    for guess in sorted(guesses, key=lambda each: each.place.log_p)[:_MEASURED]:
        if guess.place.log_p > log_limit - _LOG_LOOKS:
            break
        shared = _measured(samples, guess)
        if _holds(shared, log_limit):
            sharper = _with_ends(samples, guess)
            measured = shared if sharper is guess else _measured(samples, sharper)
            return measured if _holds(measured, log_limit) else shared
    return None


def _holds(place: Shared, log_limit: float) -> bool:
    """Tell whether a place is significant, and little of it is elsewhere."""
    return place.log_p <= log_limit and abs(place.outside) < _CONTRAST * place.inside


def _measured(samples: Samples, guess: _Guess) -> Shared:
    """Return a place with its significance by theory or by the scatter of the frames, whichever is less."""
    place, channel, mode = guess
    parts = samples.usable & place.mask, samples.usable
    energy, total = (samples.energies(channel, mode, part) for part in parts)
    n = energy.size
    # the products of ones are the number of pairs
    own, every = (float(energies(part[None].astype(np.float32), mode)[0]) for part in parts)
    share = own / every
    apart = energy - share * total
    by_theory = math.sqrt(n * own * (1.0 - share))
    by_scatter = float(np.std(apart) * math.sqrt(n))
    z = float(apart.sum()) / max(by_theory, by_scatter)
    # partners of each pixel: squares of sums over w of them have this many degrees of freedom
    partners = 2.0 * own / max(int(parts[0].sum()), 1)
    freedom = 2.0 * n * own / max(partners - 1.0, 1e-9) ** 2
    z = float(chi_square(max(freedom + z * math.sqrt(2.0 * freedom), 0.0), freedom))
    return Shared(
        family=place.family,
        z=z,
        log_p=min(0.0, float(special.log_ndtr(-z)) + place.log_places + _LOG_LOOKS),
        inside=float(energy.sum()) / (n * own),
        outside=(float(total.sum()) - float(energy.sum())) / max(n * (every - own), 1.0),
        region=_region(place),
        channel=channel,
        mode=mode,
    )


def _region(place: Place) -> Region:
    """Return a place as a region, lines at a period as such."""
    if place.family != "period":
        return Region.of_mask(place.mask)
    of_rows = bool(place.mask.all(axis=1).any())
    first, second = np.flatnonzero(place.mask.any(axis=int(of_rows)))[:2].tolist()
    return Region(taps=Taps(every=second - first, which=(first,), along="rows" if of_rows else "columns"))


def _with_ends(samples: Samples, guess: _Guess) -> _Guess:
    """Return a box with its ends among finer cells, each scanned with another pass over the frames."""

    def at(edges: Edges) -> PairContrast:
        return pairs_of(samples, edges)[guess.channel][guess.mode]

    place = with_sharp_ends(guess.place, at)
    if place is guess.place:
        return guess
    # of lines without samples nothing is known
    inside = place.mask & samples.usable
    rows, columns = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
    mask = np.zeros_like(inside)
    mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] = True
    return guess._replace(place=replace(place, mask=mask))


# -- families -----------------------------------------------------------------------------------


def _places(contrast: PairContrast, mode: str, usable: BoolArray) -> Iterator[Place | None]:
    """Yield the best place of each family."""
    if contrast.counts.flat[-1] > 0:
        yield from (box(contrast, family) for family in BOXES)
        yield from (every_nth(contrast, axis) for axis in (1, 0))
        if mode != "frame":
            yield _scattered(contrast, 0 if mode == "row" else 1, usable)


def _scattered(contrast: PairContrast, axis: int, usable: BoolArray) -> Place | None:
    """Return the rows (axis 0) or columns (1) that stand out each by itself, where they are not one band."""
    cells = contrast.edges
    ranges = [(np.array([0]), np.array([each.size - 1])) for each in cells]
    ends = np.arange(cells[axis].size)
    ranges[axis] = ends[:-1], ends[1:]
    sums, counts = (
        box_sums(table, contrast.axes, *ranges).ravel() for table in (contrast.sums, contrast.counts)
    )
    some, n = counts > 0, sums.size
    if some.sum() < 3:
        return None
    usual = float(np.median(sums[some] / counts[some]))
    z = np.zeros(n)
    z[some] = (sums[some] - usual * counts[some]) / np.sqrt(2.0 * counts[some])
    chosen = z > -special.ndtri(_LINE_BY_CHANCE / n)
    lines = np.repeat(chosen, np.diff(cells[axis]))
    mask = np.broadcast_to(lines if axis else lines[:, None], usable.shape)
    size = int((mask & usable).sum())
    if not (np.diff(np.flatnonzero(chosen)) > 1).any() or not FEWEST_PIXELS <= size <= LARGEST * usable.sum():
        return None
    together = float(z[chosen] @ np.sqrt(counts[chosen]) / np.sqrt(counts[chosen].sum()))
    # of all sets of as many lines
    return Place("scattered", mask, together, math.log(2.0 * special.binom(n, int(chosen.sum()))))
