"""One simulated stack, seen as the measured one is: the unit of work of everything that follows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import IntArray
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.discrepancy.observe.observe import fitted_maps, observe
from pchem_pipeline.discrepancy.observe.places import Part, SensorWindow, part_statistics
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps
from pchem_pipeline.simulate.chain import dn_dtype, simulate_block
from pchem_pipeline.simulate.settings import SimulateSettings
from pchem_pipeline.simulate.truth import TruthMaps

#: Begins the names of the statistics of a replicate's second part.
OF_OTHER = "other:"
#: With them, the codes that its fits evaluated, see `Evidence.evaluated`.
EVALUATED = "evaluated"


def by_part(found: Mapping[str, float]) -> tuple[dict[str, float], ...]:
    """Return the statistics of a replicate's first part, and of its second one if it has one."""
    first = {name: value for name, value in found.items() if not name.startswith((OF_OTHER, EVALUATED))}
    second = {name.removeprefix(OF_OTHER): v for name, v in found.items() if name.startswith(OF_OTHER)}
    return (first, second) if second else (first,)


@dataclass(frozen=True)
class Acquisition:
    """How the frames of a split were taken.

    Attributes:
        numbers: frame numbers in the run, whole blocks, shape (n,).
        n_run: frames of the whole run.
        block_frames: frames in a block.
        bit_depth: bits of the ADC.
        integration_time: s.
        other: numbers of the frames of a second part; None: there is none. With one, both are treated as
            the data: all their frames are fitted from nothing, and each part is observed near that fit.
            Without one the fits are begun at the truth, which is faster.
        parts: of sensor and run that have leading statistics of their own.
        window: of the sensor that is simulated; None: all of it.
    """

    numbers: IntArray
    n_run: int
    block_frames: int
    bit_depth: int
    integration_time: float = 1.0
    other: IntArray | None = None
    parts: tuple[Part, ...] = ()
    window: SensorWindow | None = None

    def observe(
        self, frames: NDArray[np.unsignedinteger], numbers: IntArray, maps: PixelMaps | None = None
    ) -> Evidence:
        """Return the evidence of frames, (frame, y, x), DN, with these numbers, fitted near maps if any.

        Data and replicates must be treated alike: a fit from nothing finds a wrong bias more often.
        """
        return observe(
            frames,
            numbers,
            n_run=self.n_run,
            block_frames=self.block_frames,
            exclude=None if maps is None else ~maps.usable,
            start=maps,
        )

    def statistics(
        self, frames: NDArray[np.unsignedinteger], numbers: IntArray, evidence: Evidence
    ) -> dict[str, float]:
        """Return the statistics of frames with this evidence, those of the parts included, by name."""
        own = frames, numbers, evidence.maps, self.parts
        return {**evidence.z, **part_statistics(*own, block_frames=self.block_frames, window=self.window)}


@dataclass(frozen=True)
class Replicate:
    """A stack to simulate from maps and effects, and to observe."""

    key: str  # unique in a run of the workflow
    maps: PixelMaps  # parameters of the pixels
    effects: tuple[Effect, ...]  # of the model, in their order
    seed: int  # root of its random numbers; equal seeds share them whatever the effects
    acquisition: Acquisition

    @property
    def samples(self) -> int:
        """Number of samples that are simulated."""
        other = self.acquisition.other
        n_frames = self.acquisition.numbers.size + (0 if other is None else other.size)
        return int(n_frames * self.maps.usable.size)

    @property
    def memory(self) -> int:
        """Bytes that it takes, about: for each sample, and for the histogram and the law of each pixel."""
        return 8 * self.samples + (self.maps.usable.size << 13)

    def simulated(self) -> NDArray[np.unsignedinteger]:
        """Return the frames of the first part, (frame, y, x), DN."""
        return simulate_frames(self.maps, self.effects, self.seed, self.acquisition)

    def fitted(self) -> PixelMaps:
        """Simulate, and fit the frames of the first part, from nothing, without any effect."""
        return fitted_maps(self.simulated(), ~self.maps.usable)[0]

    def observed(self) -> Iterator[tuple[NDArray[np.unsignedinteger], IntArray, Evidence]]:
        """Simulate; yield the frames of each part, their numbers and their evidence.

        That of the first part has evaluated the codes of the fit from nothing, too.
        """
        taken = self.acquisition
        parts = (taken.numbers,) if taken.other is None else (taken.numbers, taken.other)
        seen = taken.numbers if taken.other is None else np.union1d(taken.numbers, taken.other)
        frames = simulate_frames(self.maps, self.effects, self.seed, replace(taken, numbers=seen))
        anew = taken.other is not None
        start, evaluated = fitted_maps(frames, ~self.maps.usable) if anew else (self.maps, 0.0)
        for numbers in parts:
            some = frames[np.isin(seen, numbers)]
            found = taken.observe(some, numbers, start)
            yield some, numbers, replace(found, evaluated=found.evaluated + evaluated)
            evaluated = 0.0

    def __call__(self) -> dict[str, float]:
        """Simulate, observe, and return the statistics by name, those of the second part behind a mark."""
        found = {EVALUATED: 0.0}
        for mark, seen in zip(("", OF_OTHER), self.observed(), strict=False):
            found |= {mark + name: float(z) for name, z in self.acquisition.statistics(*seen).items()}
            found[EVALUATED] += seen[2].evaluated
        return found


def simulate_frames(
    maps: PixelMaps, effects: tuple[Effect, ...], seed: int, taken: Acquisition
) -> NDArray[np.unsignedinteger]:
    """Return the frames (frame, y, x) of a split, DN, simulated from fitted maps with effects."""
    shape = maps.bias.shape
    settings = SimulateSettings(
        shape=(shape[0], shape[1]),
        n_frames=taken.n_run,
        seed=seed,
        bit_depth=taken.bit_depth,
        integration_time=taken.integration_time,
        effects=effects if taken.window is None else taken.window.effects(effects),
    )
    truth = truth_of(maps)
    out = np.empty((taken.numbers.size, *shape), dn_dtype(taken.bit_depth))
    position = 0
    for run in np.split(taken.numbers, np.flatnonzero(np.diff(taken.numbers) != 1) + 1):
        block = int(run[0]), int(run[-1]) + 1
        out[position : position + run.size], _ = simulate_block(truth, settings, block, electron_frames=0)
        position += run.size
    return out


def truth_of(maps: PixelMaps) -> TruthMaps:
    """Return fitted maps as the truth of a simulated sensor; unusable pixels get medians."""
    values = {}
    for item in fields(PixelMaps):
        if item.name != "usable":
            one = np.array(getattr(maps, item.name), np.float64)
            one[~maps.usable] = np.median(one[maps.usable])
            values[item.name] = one
    analog = np.sqrt(np.maximum(values["read_noise_dn"] ** 2 - QUANTISATION_VARIANCE, 0.0))
    return TruthMaps(
        quanta_exposure=values["quanta_exposure"],
        conversion_gain=values["conversion_gain"],
        bias=values["bias"],
        analog_read_noise_e=analog * values["conversion_gain"],
        defect=np.zeros(maps.usable.shape, np.uint8),
    )
