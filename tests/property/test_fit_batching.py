"""The answer for a pixel does not depend on the batch that it is in."""

import dataclasses

import numpy as np
from helpers.drawn_pixels import draw
from hypothesis import given, settings
from hypothesis import strategies as st

from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.result import FitResult

_N = 24


def _pixels() -> tuple[np.ndarray, np.ndarray, FitResult]:
    rng = np.random.default_rng(9)
    pixels = draw(
        rng, rng.uniform(0.05, 9, _N), rng.uniform(8, 14, _N), rng.uniform(0.15, 0.5, _N), n_frames=4000
    )
    counts = pixels.counts.copy()
    counts[5] = 0  # a dead pixel amid the others
    return counts, pixels.origin, fit_histograms(counts, pixels.origin)


_COUNTS, _ORIGIN, _WHOLE = _pixels()


@settings(max_examples=25, deadline=None)
@given(
    cuts=st.lists(st.integers(1, _N - 1), unique=True, max_size=6),
    extra=st.integers(0, 40),
    reverse=st.booleans(),
)
def test_any_batching_gives_the_same_bits(cuts: list[int], extra: int, reverse: bool) -> None:
    order = np.arange(_N)[::-1] if reverse else np.arange(_N)
    padded = np.pad(_COUNTS, ((0, 0), (3, extra)))
    for part in np.split(order, sorted(cuts)):
        answer = fit_histograms(padded[part].astype(np.uint16), _ORIGIN[part] - 3)
        for field in dataclasses.fields(FitResult):
            if field.name != "intervals":
                mine, whole = getattr(answer, field.name), getattr(_WHOLE, field.name)
                np.testing.assert_array_equal(mine, whole[part])
