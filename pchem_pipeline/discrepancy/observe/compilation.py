"""Compile what observing and simulating a stack calls, before it is needed."""

from __future__ import annotations

from functools import partial
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel_cache import in_any_order
from pchem_pipeline.discrepancy.observe.digital.misplaced import misplaced_lines
from pchem_pipeline.discrepancy.observe.law_numba import N_TESTS
from pchem_pipeline.discrepancy.observe.sums import pixel_statistics, sum_frames
from pchem_pipeline.discrepancy.observe.tables import pixel_laws
from pchem_pipeline.discrepancy.observe.tables_numba import N_MOMENTS, CodeSums, PixelLaws
from pchem_pipeline.model.fit.engine import compilations
from pchem_pipeline.model.fit.tile_numba import Histograms
from pchem_pipeline.model.histogram.count import histogram_frames
from pchem_pipeline.model.law.inputs import kernel_counts
from pchem_pipeline.model.law.mass import sample_mass
from pchem_pipeline.model.law.sample_law import SampleLaw
from pchem_pipeline.simulate.chain import simulate_block
from pchem_pipeline.simulate.settings import SimulateSettings
from pchem_pipeline.simulate.truth import TruthMaps

_SIDE = 2
_PARAMETERS = (2.0, 0.1, 100.0, 3.0)  # H, g, mu and sigma of the pixels of a stack that nobody looks at


def compile_observation(dtype: np.dtype[Any]) -> None:
    """Compile what looks at frames of a type; of several processes each compiles a share.

    Each step is done by itself on a stack of a few samples, none needs what another finds.
    """
    frames = np.random.default_rng(1).integers(90, 120, (8, _SIDE, _SIDE)).astype(dtype)
    found = histogram_frames(frames)
    counts = found.counts.reshape(_SIDE**2, -1)
    origin = found.origin.ravel().astype(np.int64)
    parameters = np.tile(_PARAMETERS, (_SIDE**2, 1))
    usable = np.ones(_SIDE**2, np.bool_)
    outside, rows = np.zeros((_SIDE**2, 2)), np.zeros((1, 1), np.int64)
    given = Histograms(kernel_counts(counts), rows[0], rows, np.ones(1, np.bool_), np.zeros((1, 1), np.uint8))
    codes = np.arange(90, 120)
    in_any_order(
        [
            partial(pixel_laws, counts, origin, outside, parameters, usable),
            partial(_sum, frames),
            partial(misplaced_lines, frames, counts, origin, usable.reshape(_SIDE, _SIDE)),
            partial(sample_mass, SampleLaw(), list(parameters.T), codes),
            _simulate,
            *compilations(numba.typeof(given), False),
        ]
    )


def _sum(frames: NDArray[Any]) -> None:
    """Sum two blocks of frames over tables of zeros."""
    n = _SIDE**2
    zeros = np.zeros((n, 2))
    laws = PixelLaws(
        np.ones(n, np.bool_), np.zeros((n, N_MOMENTS)), np.zeros((n, 3, N_TESTS)), np.tile([0, 1, 0], (n, 1)),
        np.zeros((1, 2), np.float32), CodeSums(0, 1, zeros, zeros[0], zeros, zeros, zeros),
    )  # fmt: skip
    pixels = pixel_statistics(laws, np.ones(n), np.ones(n), (_SIDE, _SIDE))
    n = len(frames)
    sum_frames(frames, np.arange(n), np.array([0, n // 2, n]), laws, pixels)


def _simulate() -> None:
    """Simulate two frames."""
    exposure, gain, bias, noise = (np.full((_SIDE, _SIDE), each) for each in _PARAMETERS)
    truth = TruthMaps(exposure, gain, bias, gain * noise, np.zeros((_SIDE, _SIDE), np.uint8))
    simulate_block(truth, SimulateSettings(shape=(_SIDE, _SIDE), n_frames=2), (0, 2), electron_frames=0)
