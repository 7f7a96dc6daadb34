"""The frames of a search: their split, the parts of sensor and run that differ, and their statistics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, IntArray
from pchem_pipeline.discrepancy.by_simulation.frames.suspects import with_ends
from pchem_pipeline.discrepancy.by_simulation.sensor.replicate import Acquisition
from pchem_pipeline.discrepancy.observe.places import Part, SensorWindow, part_evidence
from pchem_pipeline.discrepancy.splits import Splits, block_length, split_frames
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps

_BLOCKS_IN_A_RANGE, _SHORTEST_BLOCK = 15, 10  # frames


@dataclass(frozen=True)
class FrameStack:
    """The frames that are examined."""

    stack: NDArray[np.unsignedinteger]  # (frame, y, x), DN
    numbers: IntArray  # of the frames in the run, shape (frame,)
    splits: Splits  # train, test and final part
    n_run: int  # frames of the whole run
    bit_depth: int  # bits of the ADC
    integration_time: float  # s
    parts: tuple[Part, ...] = ()  # of sensor and run that differ from the rest
    window: SensorWindow | None = None  # of the sensor; None: all of it

    @classmethod
    def of(
        cls,
        stack: NDArray[np.unsignedinteger],
        numbers: IntArray,
        block_frames: int | None,
        *,
        n_run: int | None,
        bit_depth: int | None,
        integration_time: float,
        window: SensorWindow | None,
    ) -> FrameStack:
        """Split frames; what is None is derived from them.

        Raises:
            InputError: they are too few.
        """
        splits = split_frames(numbers, block_length(stack.shape[0], block_frames))
        if bit_depth is None:
            bit_depth = min(int(stack.max()).bit_length() + 1, 24)
        n_run = n_run or int(numbers[-1]) + 1
        return cls(stack, numbers, splits, n_run, bit_depth, integration_time, window=window)

    @property
    def sensor_window(self) -> SensorWindow:
        """The window of the sensor that the frames are."""
        return self.window or SensorWindow.whole(self.stack.shape)

    @property
    def whole_lines(self) -> set[str]:
        """Kinds of lines of the sensor, "row" and "column", that are here from end to end."""
        window, whole = self.sensor_window, SensorWindow.whole(self.sensor_window.shape)
        lines = {"row": window.columns == whole.columns, "column": window.rows == whole.rows}
        return {of for of, is_whole in lines.items() if is_whole}

    @property
    def seen(self) -> IntArray:
        """Positions of the train and test frames."""
        return np.sort(np.concatenate([self.splits.train, self.splits.test]))

    @property
    def seen_stack(self) -> NDArray[np.unsignedinteger]:
        """The train and test frames, (frame, y, x), DN."""
        return self.stack[self.seen]

    @property
    def seen_numbers(self) -> IntArray:
        """Their numbers in the run, shape (frame,)."""
        return self.numbers[self.seen]

    def observe(self, part: IntArray, maps: PixelMaps | None = None) -> Evidence:
        """Observe some frames as replicates are observed."""
        return self.acquisition().observe(self.stack[part], self.numbers[part], maps)

    def with_parts(self, parts: tuple[Part, ...]) -> FrameStack:
        """Return it with parts, dealt in blocks so short that a range of frames is alike in all splits."""
        shortest = min((int(p.frames(self.numbers).sum()) for p in parts if p.when is not None), default=0)
        length = max(shortest // _BLOCKS_IN_A_RANGE // 2 * 2, _SHORTEST_BLOCK)
        splits = self.splits
        if shortest and length < splits.block_frames:
            splits = split_frames(self.numbers, length)
        window = self.window
        if window is not None:
            parts = tuple(Part(window.on_sensor(part.region), part.when) for part in parts)
        return replace(self, parts=parts, splits=splits)

    def with_ends(self, maps: PixelMaps) -> FrameStack:
        """Return it with the ends of its ranges of frames sharpened by the frames that are seen now."""
        parts = [
            part if part.when is None else with_ends(part, self._apart(Part(part.region), maps, fitted=False))
            for part in self.parts
        ]
        return replace(self, parts=tuple(parts))

    def effects(self, model: Sequence[Effect]) -> tuple[Effect, ...]:
        """Return the effects of a model as they act on these pixels, the first of which is in row 0."""
        return tuple(model) if self.window is None else self.window.effects(model)

    def on_sensor(self, effect: Effect) -> Effect:
        """Return an effect that was found in these pixels as one of the sensor."""
        return effect if self.window is None else self.window.found(effect)

    def statistics(self, part: IntArray, evidence: Evidence) -> dict[str, float]:
        """Return the statistics of some frames, those of the parts included, as replicates have them."""
        return self.acquisition().statistics(self.stack[part], self.numbers[part], evidence)

    def seen_apart(self, evidence: Evidence) -> list[tuple[Part, Evidence]]:
        """Return the evidence of each part, of train and test frames together."""
        return [(part, self._apart(part, evidence.maps)) for part in self.parts]

    def _apart(self, part: Part, maps: PixelMaps, *, fitted: bool = True) -> Evidence:
        """Return the evidence of a part in train and test frames, see :func:`part_evidence`."""
        return part_evidence(
            self.seen_stack,
            self.seen_numbers,
            maps,
            part,
            n_run=self.n_run,
            block_frames=self.splits.block_frames,
            window=self.window,
            fitted=fitted,
        )

    def acquisition(self, as_data: bool = False) -> Acquisition:
        """Return how replicates of the train part are taken; ``as_data``: with the test part as the other."""
        return Acquisition(
            self.numbers[self.splits.train],
            self.n_run,
            self.splits.block_frames,
            self.bit_depth,
            self.integration_time,
            other=self.numbers[self.splits.test] if as_data else None,
            parts=self.parts,
            window=self.window,
        )

    def samples(self, part: Part) -> int:
        """Return how many samples of the train and test frames are in a part."""
        frames, pixels = self.samples_of(part)
        return int(frames.sum()) * int(pixels.sum())

    def samples_of(self, part: Part) -> tuple[BoolArray, BoolArray]:
        """Return which of the train and test frames, (frame,), and which pixels, (y, x), are a part."""
        return part.frames(self.seen_numbers), self.inside(part)

    def inside(self, part: Part) -> BoolArray:
        """Return which of the pixels lie in a part, (y, x)."""
        return self.sensor_window.mask(part.region)
