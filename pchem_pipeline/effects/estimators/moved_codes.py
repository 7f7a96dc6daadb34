"""Which samples moved from code to code explain the counts per code, and how many of them.

If a share of the samples of some codes comes out as other codes, the counts per code change by the mass that
leaves and arrives. The pixels' own fits take up what looks like a change of their H, g, mu or sigma; what
they leave is computed to first order for a sample of pixels, as for bends of the ADC's curve, and summed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pchem_pipeline.effects.estimators.bends import sampled_tangents
from pchem_pipeline.effects.estimators.regression import multiple_of
from pchem_pipeline.effects.types import Evidence, FloatArray, IntArray


class MovedShare(NamedTuple):
    """A share of moved samples, its standard error, and by how much it lowers chi2 of the codes."""

    share: float
    error: float
    gain: float


def moved_shares(evidence: Evidence, targets: IntArray) -> list[MovedShare]:
    """Return for each of several kinds of moves the share of samples that explains the counts best.

    Args:
        evidence: of one split.
        targets: where a sample of each code of ``evidence.code`` comes out, as places there, shape (kinds,
            codes); its own place where it stays, -1 where it leaves them.
    """
    code, pixels = evidence.code, sampled_tangents(evidence.maps)
    if pixels is None:
        return []
    n, cells = pixels.mass.shape
    samples = evidence.n_frames * int(evidence.maps.usable.sum()) / n
    places = pixels.first - code.first + np.arange(cells)
    here = (places >= 0) & (places < code.expected.size)
    residual = code.observed - code.expected
    found = []
    for target in targets:
        to = np.where(here, target[np.where(here, places, 0)], -1)
        leaves = here & (to != places)
        change = np.where(leaves, -pixels.mass, 0.0)
        inside = np.zeros(change.shape)
        arrives = leaves & (to >= 0)
        rows, columns = np.nonzero(arrives)
        cell = to[arrives] - places[rows, 0]
        mass = pixels.mass[rows, columns]
        near = (cell >= 0) & (cell < cells)
        np.add.at(inside, (rows[near], cell[near]), mass[near])
        change += inside
        taken_up = np.einsum("nic,nc->ni", pixels.tangents, change / pixels.mass)
        change -= np.einsum("ni,nic->nc", taken_up, pixels.tangents)
        pattern = np.bincount(places[here], change[here], code.expected.size)
        pattern += np.bincount(to[arrives][~near], mass[~near], code.expected.size)
        found.append(_regressed(samples * pattern, residual, code.expected))
    return found


def _regressed(pattern: FloatArray, residual: FloatArray, expected: FloatArray) -> MovedShare:
    """Return the factor of a pattern in the residuals of Poisson counts, by two weighted least squares."""
    share, error = 0.0, np.inf
    for _ in range(2):
        weight = 1.0 / np.maximum(expected + share * pattern, 1.0)
        found, error = multiple_of(pattern, residual, weight)
        share = max(found, 0.0)
    return MovedShare(share, error, (share / error) ** 2)
