"""Test of the estimator of an effect, own or third-party, on simulated frames."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.discrepancy.observe.catalogue import check_signature
from pchem_pipeline.discrepancy.observe.observe import observe
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.simulate.chain import simulate_block
from pchem_pipeline.simulate.maps import draw_truth
from pchem_pipeline.simulate.settings import SimulateSettings

#: Frames (frame, y, x) of a seed, DN, unsigned.
Camera = Callable[[int], NDArray[np.unsignedinteger]]
_BLOCK = 50  # frames, as many as a search looks at in one piece


def recovered_strength(
    effect: Effect,
    *,
    camera: Camera | None = None,
    stacks: int = 6,
    n_frames: int = 1500,
    shape: tuple[int, int] = (20, 20),
    seed: int = 1,
) -> FloatArray:
    """Return the strength of the first guess of an estimator in each of n stacks of frames, NaN without any.

    Each stack is of another sensor, drawn as ``pchem simulate`` draws it, and is looked at as a search looks
    at frames: histograms, plain fits, statistics.

    Args:
        effect: with the strength that it has in the frames; 0: there is nothing to be found.
        camera: takes a seed and returns frames that have the effect, by a simulator of your own, for which
            ``n_frames`` and ``shape`` mean nothing; None: this package's, with the effect's own ``apply``.
        stacks: how many.
        n_frames: in each stack, 200 or more.
        shape: rows and columns, px.
        seed: of the first stack; those of the others follow.

    Raises:
        ConfigError: the effect has no strength, its signature names no statistic, or it depends on rows or
            frames that it does not declare.
        InputError: the frames are too few, or not as described.
    """
    if not effect.strength:
        raise ConfigError(f"effect {effect.tag!r} has no strength; name the field that scales it")
    check_signature(effect.signature)
    _check_reach(effect, shape, seed)
    found = np.full(stacks, np.nan)
    for i in range(stacks):
        frames = _simulated(effect, n_frames, shape, seed + i) if camera is None else camera(seed + i)
        evidence = observe(frames, np.arange(len(frames)), n_run=len(frames), block_frames=_BLOCK)
        hypotheses = type(effect).estimate(evidence)
        if hypotheses:
            found[i] = getattr(hypotheses[0], effect.strength)
    return found


def _check_reach(effect: Effect, shape: tuple[int, int], seed: int) -> None:
    """Raise an error where single rows or later frames are not what they are in the whole: bands differ."""
    middle, later = shape[0] // 2 | 1, _BLOCK // 2  # odd: parities differ
    whole = _simulated(effect, _BLOCK, shape, seed)
    band = _simulated(effect, _BLOCK, shape, seed, top=middle)
    block = _simulated(effect, _BLOCK, shape, seed, first=later)
    for same, what, declared in (
        (np.array_equal(whole[:, middle:], band), "rows", "reach_rows"),
        (np.array_equal(whole[later:], block), "frames", "reach_frames"),
    ):
        if not same:
            raise ConfigError(
                f"effect {effect.tag!r}: `apply` gets a band of rows and a block of frames, and needs {what} "
                f"outside of it; set `{declared}` to how many"
            )


def _simulated(
    effect: Effect, n_frames: int, shape: tuple[int, int], seed: int, first: int = 0, top: int = 0
) -> NDArray[np.unsignedinteger]:
    """Return simulated frames from the number ``first`` on, of the rows from ``top`` on."""
    settings = SimulateSettings(shape=shape, n_frames=n_frames, seed=seed, effects=(effect,))
    part = (first, n_frames), (top, shape[0])
    return simulate_block(draw_truth(settings), settings, *part, electron_frames=0)[0]
