"""Levels that single pixels show tell the kind of their traps, step, probability and share."""

import numpy as np
import pytest

from pchem_pipeline.discrepancy.by_simulation.candidates.satellites import with_satellites
from pchem_pipeline.discrepancy.effort import Effort
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.effects.framework.registry import effect_class

SHAPE, FRAMES, STEP, NOISE, EXPOSURE = (12, 24), 2000, 8.0, 0.27, 1.2  # pixels, frames, DN per e-, e-, e-
WITH_TRAP = np.arange(288).reshape(SHAPE) % 12 == 0
TRAPS = effect_class("rts_noise")
GUESSES = {tag: list(effect_class(tag).typical()) for tag in ("rts_noise", "row_noise")}


def frames_of(jumps: np.ndarray, seed: int) -> np.ndarray:
    """Return frames of which some pixels have jumps, e-: an own simulator, independent of the product's."""
    rng = np.random.default_rng(seed)
    signal = rng.poisson(EXPOSURE, (FRAMES, *SHAPE)) + rng.normal(0.0, NOISE, (FRAMES, *SHAPE))
    signal[:, WITH_TRAP] += jumps
    return np.rint(100.0 + STEP * signal).astype(np.uint16)


def maps() -> PixelMaps:
    values = (EXPOSURE, 1.0 / STEP, 100.0, STEP * NOISE)
    return PixelMaps.known([np.full(SHAPE, v) for v in values], np.ones(SHAPE, np.bool_))


@pytest.mark.parametrize(("reads", "step", "scatter"), [(1, 1.3, 0.3), (4, 1.6, 0.05)])
def test_steps_and_weights_of_traps_are_those_of_the_pixels_that_have_one(
    reads: int, step: float, scatter: float
) -> None:
    rng, weight, n = np.random.default_rng(3), 0.4, int(WITH_TRAP.sum())
    steps = step * np.exp(scatter * rng.standard_normal(n))
    # a jump falls between two successive samples of the 2 N, or after them
    heights = np.concatenate([np.arange(1, reads + 1), np.arange(reads - 1, 0, -1)]) / reads
    jumps = rng.choice(heights, (FRAMES, n)) * rng.choice([-1.0, 1.0], (FRAMES, n))
    frames = frames_of(steps * np.where(rng.random((FRAMES, n)) < weight, jumps, 0.0), 5)
    found = with_satellites(frames, maps(), (), GUESSES, Effort(None), {})
    assert list(found) == ["rts_noise"]
    best = found["rts_noise"][0]
    assert (best.sampling, best.samples) == ("correlated", reads)  # type: ignore[attr-defined]
    # the median of n steps, and of n weights of so many samples each
    error = step * max(scatter, 0.03) * np.sqrt(np.pi / 2.0 / n)
    assert abs(best.amplitude_e - np.median(steps)) < 4.0 * error + 0.02 * step  # type: ignore[attr-defined]
    assert abs(best.probability - weight) < 0.05  # type: ignore[attr-defined]
    assert best.spread == ("lognormal" if scatter > 0.2 else "equal")  # type: ignore[attr-defined]
    # a step that blurs the peaks passes for read noise
    assert 0.7 * WITH_TRAP.mean() < best.fraction <= 1.05 * WITH_TRAP.mean()  # type: ignore[attr-defined]


def test_an_effect_that_cannot_take_its_numbers_is_noted(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("no such thing")

    jumps = np.random.default_rng(7).choice([-1.6, 0.0, 1.6], (FRAMES, int(WITH_TRAP.sum())))
    monkeypatch.setattr(TRAPS, "with_satellites", broken)
    defects: dict[str, str] = {}
    one = {"rts_noise": GUESSES["rts_noise"][:1]}
    assert with_satellites(frames_of(jumps, 5), maps(), (), one, Effort(None), defects) == {}
    assert "no such thing" in defects.pop("rts_noise")
    # pixels without levels tell nothing
    assert (
        with_satellites(frames_of(0.0 * jumps, 6), maps(), (), GUESSES, Effort(None), defects)
        == defects
        == {}
    )
