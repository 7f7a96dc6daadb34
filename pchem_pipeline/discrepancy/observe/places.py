"""The leading statistics in a part of the sensor or of the run, for data and replicates alike.

A part is seen as a sensor of its own, which ends with its rows and columns, its frames alone, beside the fit
of all frames, since those of a part may be too few for a fit of their own. An effect that acts there only
moves these statistics as one that acts everywhere moves those of the whole, which tells the two apart.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from pchem_pipeline.base.arrays import BoolArray, CodeArray, IntArray
from pchem_pipeline.base.errors import ConfigError, PchEmError
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.observe.observe import observe
from pchem_pipeline.discrepancy.observe.sums import MINIMUM_BLOCKS
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps
from pchem_pipeline.effects.framework.region import Region, Span, When
from pchem_pipeline.effects.framework.registry import effect_classes

_SAME = 0.8  # of two regions together, that one and the same has in common as two looks tell it
_LEADING = 2  # statistics of a signature that are looked at


@dataclass(frozen=True)
class SensorWindow:
    """The rows and columns of a sensor that are looked at; regions are in coordinates of the sensor."""

    rows: tuple[int, int]  # first, and end
    columns: tuple[int, int]  # first, and end
    shape: tuple[int, int]  # rows and columns of the sensor
    known: tuple[Region, ...] = ()  # regions of the sensor that a look at all of it found

    @classmethod
    def whole(cls, shape: tuple[int, ...]) -> SensorWindow:
        """Return all of a sensor, or of frames (frame, y, x)."""
        rows, columns = shape[-2:]
        return cls((0, rows), (0, columns), (rows, columns))

    def mask(self, region: Region | None) -> BoolArray:
        """Return which pixels of the window lie in a region, (y, x)."""
        every = np.ones(self.shape, np.bool_) if region is None else region.mask(self.shape)
        return every[slice(*self.rows), slice(*self.columns)]

    def effects(self, effects: Sequence[Effect]) -> tuple[Effect, ...]:
        """Return effects as they act on the window, for itself a sensor; those that do not are left out."""
        found = []
        for effect in (each.to_window(self.rows, self.columns, self.shape) for each in effects):
            mask = self.mask(effect.region)
            if effect.region is None or mask.any():
                region = None if effect.region is None or mask.all() else Region.of_mask(mask)
                found.append(effect.at_place(region, effect.when))
        return tuple(found)

    def found(self, effect: Effect, part: Part | None = None) -> Effect:
        """Return as one of the sensor an effect that was found in the window, or in a part of it."""
        rows, columns = self.rows, self.columns
        if part is not None and part.region is not None:
            inside = np.argwhere(self.mask(part.region))
            (y0, x0), (y1, x1) = inside.min(axis=0).tolist(), (inside.max(axis=0) + 1).tolist()
            rows, columns = (rows[0] + y0, rows[0] + y1), (columns[0] + x0, columns[0] + x1)
        effect = effect.to_sensor(rows, columns, self.shape)
        if part is None:
            return effect
        return effect.at_place(None if effect.localised else part.region, part.when)

    def on_sensor(self, region: Region | None) -> Region | None:
        """Return a region of the window as one of the sensor.

        Without ends here it has none there, and where it ends with the window as a known one shows it does.
        """
        if region is None:
            return None
        y, x = self.rows[0], self.columns[0]
        taps = region.taps
        if taps is not None:
            taps = taps.model_copy(update={"first": taps.first + (x if taps.along == "columns" else y)})
            if taps.every is not None and taps.width == 1:
                which = tuple(sorted((w + taps.first) % taps.every for w in taps.which))
                taps = taps.model_copy(update={"first": 0, "which": which})
        # the known region of which the window shows nearly the same
        found = region.mask((self.rows[1] - y, self.columns[1] - x))
        rows = tuple((a + y, b + y) for a, b in region.rows)
        columns = tuple((a + x, b + x) for a, b in region.columns)
        seen = ((place, self.mask(place)) for place in self.known)
        same = next((p for p, mask in seen if (found & mask).sum() >= _SAME * (found | mask).sum()), None)
        return region.model_copy(
            update={
                "rows": rows if same is None else _beyond(rows, self.rows, same.rows),
                "columns": columns if same is None else _beyond(columns, self.columns, same.columns),
                "pixels": tuple((row + y, a + x, b + x) for row, a, b in region.pixels),
                "taps": taps,
            }
        )


def _beyond(found: tuple[Span, ...], window: Span, known: tuple[Span, ...]) -> tuple[Span, ...]:
    """Return ranges of a window with the ends that they are known to have beyond it, on the sensor."""
    if not found:  # all of the window
        return known
    spans = []
    for first, last in found:
        same = [(begin, end) for begin, end in known if begin < last and first < end]
        low = min((begin for begin, _ in same), default=first) if first == window[0] else first
        high = max((end for _, end in same), default=last) if last == window[1] else last
        spans.append((min(first, low), max(last, high)))
    return tuple(spans)


@dataclass(frozen=True)
class Part:
    """A part of the sensor (None: all pixels), of the run (None: all frames), or of both."""

    region: Region | None = None
    when: When | None = None

    @property
    def text(self) -> str:
        """It in one line, for the names of its statistics."""
        return ",".join(place.text() for place in (self.region, self.when) if place is not None)

    def frames(self, numbers: IntArray) -> BoolArray:
        """Return which frames are its."""
        return np.ones(numbers.size, np.bool_) if self.when is None else self.when.frames(numbers)


def part_evidence(
    frames: CodeArray,
    numbers: IntArray,
    maps: PixelMaps,
    part: Part,
    *,
    n_run: int,
    block_frames: int,
    window: SensorWindow | None = None,
    fitted: bool = True,
    names: Collection[str] = STATISTICS,
) -> Evidence:
    """Return the evidence of a part alone, as of a sensor that ends with it: row 0 is its first.

    The maps are the fit of all these frames, of a window of the sensor (None: all of it); the other arguments
    are those of `observe`. Blocks are shorter where the part has few frames.

    Raises:
        PchEmError: it holds too few frames, or no usable pixel.
    """
    chosen = part.frames(numbers)
    length = min(block_frames, max(int(chosen.sum()) // (2 * MINIMUM_BLOCKS), 1))
    stack = frames if chosen.all() else frames[chosen]
    inside = (window or SensorWindow.whole(frames.shape)).mask(part.region)
    if inside.any() and not inside.all():
        lines = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
        y, x = (slice(int(each[0]), int(each[-1]) + 1) for each in lines)
        stack, maps, inside = stack[:, y, x], maps.of((y, x)), inside[y, x]
    exclude = ~(inside & maps.usable)
    return observe(
        stack, numbers[chosen], n_run=n_run, block_frames=length,
        exclude=exclude, start=maps, fitted=fitted, names=names,
    )  # fmt: skip


def part_statistics(
    frames: CodeArray,
    numbers: IntArray,
    maps: PixelMaps,
    parts: Sequence[Part],
    *,
    block_frames: int,
    window: SensorWindow | None = None,
) -> dict[str, float]:
    """Return the leading statistics of parts, ``name@part``, where it can be; see :func:`part_evidence`."""
    found: dict[str, float] = {}
    # of all effects, in the order of the catalogue
    wanted = {name for effect in effect_classes().values() for name in effect.signature[:_LEADING]}
    leading = [name for name in STATISTICS if name in wanted]
    n_run = int(numbers[-1]) + 1  # on which no statistic depends
    for part in parts:
        try:
            evidence = part_evidence(
                frames, numbers, maps, part,
                n_run=n_run, block_frames=block_frames, window=window, fitted=False, names=leading,
            )  # fmt: skip
        except (PchEmError, ConfigError):
            continue
        found |= {f"{name}@{part.text}": evidence.z[name] for name in leading if name in evidence.z}
    return found
