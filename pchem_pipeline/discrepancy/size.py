"""The size of an effect in e-, in DN and relative to the read noise.

It is the rms difference of simulated values with and without the effect, on the same random numbers, before
rounding and around the mean of each pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.errors import PchEmError
from pchem_pipeline.discrepancy.by_simulation.sensor.replicate import truth_of
from pchem_pipeline.discrepancy.verdict import RARE, Size
from pchem_pipeline.effects.framework.context import EffectContext
from pchem_pipeline.effects.framework.effect import Effect, Plane
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.simulate.chain import simulate_block
from pchem_pipeline.simulate.settings import SimulateSettings

_MOST_ROWS = 12  # and columns: what all pixels of a frame share has one draw a frame
_BLOCKS, _BLOCK_FRAMES = 100, 40  # spread over the run
#: Smallest number of simulated frames, in several stacks of a short run: a size has two digits.
_FEWEST_FRAMES = 20_000
_FEWEST_BLOCKS = 4  # of the whole sensor
_BITS = 24
_CHANGED = 1e-9


def size_of(effect: Effect, maps: PixelMaps, n_frames: int) -> Size | None:
    """Compute the size of an effect in its region and frames of a run; None if it cannot be simulated.

    Its coordinates are those of the pixels with these fitted parameters, (y, x) each.
    """
    if not maps.usable.any():
        return None
    gain, noise = maps.conversion_gain[maps.usable], float(np.median(maps.read_noise_dn[maps.usable]))
    scatter = effect.added_scatter_e(maps.quanta_exposure[maps.usable])
    if scatter is not None:
        electrons, dn = (float(np.sqrt(np.mean(each**2))) for each in (scatter, scatter / gain))
        return Size(electrons=electrons, dn=dn, of_read_noise=dn / noise)
    if effect.empirical and effect.power == 2.0 and effect.unit(effect.strength) == "DN":
        # what samples share as it was measured: of light that varies they change by whole electrons, most of
        # them by their own chance
        dn = float(getattr(effect, effect.strength))
        return Size(electrons=dn * float(np.median(gain)), dn=dn, of_read_noise=dn / noise)
    whole = effect.far_reaching
    maps = maps if whole else maps.of(np.s_[:_MOST_ROWS, :_MOST_ROWS])
    if not maps.usable.any():
        return None
    blocks = max(_BLOCKS * _MOST_ROWS**2 // maps.usable.size, _FEWEST_BLOCKS) if whole else _BLOCKS
    blocks = min(blocks, -(-n_frames // _BLOCK_FRAMES))
    stacks = 1 if whole else -(-_FEWEST_FRAMES // (blocks * _BLOCK_FRAMES))
    try:
        drawn = [_change(effect, maps, n_frames, blocks, seed) for seed in range(1, stacks + 1)]
    except PchEmError:
        return None
    inside = np.ones_like(maps.usable)
    if whole and effect.region is not None:
        inside = effect.region.mask(inside.shape)
    changes = [change[:, inside] for change in drawn if change is not None]
    share = float(np.mean([np.mean(np.abs(each) > _CHANGED) for each in changes])) if changes else 0.0
    if not share:  # alone it changes nothing, as a clamp does whose frames vary by other effects
        return None
    gain = np.where(maps.usable, maps.conversion_gain, np.median(maps.conversion_gain[maps.usable]))[inside]
    in_dn = effect.plane in (Plane.ADC, Plane.READOUT)
    dn = _spread([change if in_dn else change / gain for change in changes], share)
    return Size(
        electrons=_spread([change * gain if in_dn else change for change in changes], share),
        dn=dn,
        of_read_noise=dn / noise,
        samples=share,
    )


def _change(effect: Effect, maps: PixelMaps, n_frames: int, blocks: int, seed: int) -> FloatArray | None:
    """Return what an effect does to the samples of one stack, (frame, y, x); None where it does nothing."""
    seen: list[FloatArray] = []
    kind = type(effect)

    class Watched(kind):  # type: ignore[misc, valid-type]
        def halo(self) -> int:
            return int(maps.usable.shape[0])  # all rows are simulated together

        def apply(self, values: NDArray[Any], context: EffectContext) -> NDArray[Any]:
            changed: NDArray[Any] = super().apply(values, context)
            seen.append((changed.astype(np.float64) - values)[self.history() :])
            return changed

    everywhere = Watched.model_validate(effect.at_place(None).model_dump())
    shape = maps.usable.shape
    settings = SimulateSettings(
        shape=(shape[0], shape[1]), n_frames=n_frames, seed=seed, bit_depth=_BITS, effects=()
    ).model_copy(update={"effects": (everywhere,)})
    truth = truth_of(maps)
    last = max(n_frames - _BLOCK_FRAMES, 0)
    for first in np.unique(np.linspace(0, last, blocks).astype(int)).tolist():
        simulate_block(truth, settings, (first, min(first + _BLOCK_FRAMES, n_frames)), electron_frames=0)
    return np.concatenate(seen) if seen else None


def _spread(changes: Sequence[FloatArray], share: float) -> float:
    """Return by how much samples change from frame to frame, where they change if that is rare."""
    mean_square = np.mean([np.mean((change - change.mean(axis=0)) ** 2) for change in changes])
    return float(np.sqrt(mean_square / (share if 0.0 < share < RARE else 1.0)))
