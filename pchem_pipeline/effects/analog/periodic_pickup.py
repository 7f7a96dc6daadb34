"""Periodic pickup: a sine from outside, sampled row by row as the sensor is read.

Switching supplies, clocks and mains reach the video signal, ``x += a sin(2 pi (f_y y + f_x x + f_t t) +
phi)``. The phase runs on from row to row and frame to frame, or is new in every frame if the frames are not
evenly spaced. The herring-bone pattern of the STIS CCD (Jansen et al. 2003, HST Calibration Workshop) is the
classic.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal, Self, TypeVar

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.estimators.common_modes import (
    mean_response,
    responsivity,
)
from pchem_pipeline.effects.estimators.lines import coherent_line, incoherent_line
from pchem_pipeline.effects.families.offsets import OffsetEffect, sine_values
from pchem_pipeline.effects.framework.effect import Dn, Radians, SharedOffset, Turns, register_effect
from pchem_pipeline.effects.framework.evidence import Wave
from pchem_pipeline.effects.framework.region import Span
from pchem_pipeline.effects.types import EffectContext, Evidence, FloatArray

Pickup = TypeVar("Pickup", bound="PeriodicPickup")


@register_effect
class PeriodicPickup(OffsetEffect):
    """Sine along rows, columns and frames.

    Signature: the spectrum of the row means (over frames and rows) of the readout residual has one line, and
    frame means have one where the phase does not advance along the rows; the charge has none. Where samples
    are read one after the other, only the spectrum over rows, columns and frames has it. A pixel's own
    histogram is smeared by the arcsine law of a sine at random phase.
    """

    tag: Literal["periodic_pickup"] = Field(default="periodic_pickup", description="name of the effect")
    title = "periodic pickup (pattern noise, EMI)"
    source = "Jansen et al. 2003, HST Calibration Workshop (herring-bone noise of the STIS CCD)"
    signature = (
        "space.row.readout.line",
        "frame.readout.line",
        "space.column.readout.line",
        "space.sample.readout.line",
        "space.sample.readout.spectrum",
        "space.row.readout.variance",
    )
    strength = "amplitude_dn"
    power = 2.0
    may_be_at_bound = ("cycles_per_row", "cycles_per_frame", "cycles_per_column")
    separate: ClassVar[Mapping[str, str]] = {
        "row_noise": "spectrum of the row means within a frame: pickup is a line, row noise is flat",
        "frame_noise": "spectrum of the frame means: pickup is a line, frame noise is flat",
        "readout_alternation": "another frame rate: pickup leaves half the frame rate",
        "bias_drift": "a second run: pickup has another phase, a warm-up drift is repeated",
    }
    amplitude_dn: Dn = Field(ge=0, le=1e6, description="amplitude of the sine, DN")
    cycles_per_row: Turns = Field(
        default=0.0, ge=-0.5, le=0.5, description="f_y: advance of the phase from row to row, cycles"
    )
    cycles_per_frame: Turns = Field(
        default=0.0, ge=-0.5, le=0.5, description="f_t: advance of the phase from frame to frame, cycles"
    )
    cycles_per_column: Turns = Field(
        default=0.0,
        ge=-0.5,
        le=0.5,
        description="f_x: advance of the phase from column to column, cycles; 0 with column-parallel readout",
    )
    phase: Radians = Field(default=0.0, ge=-100, le=100, description="phase at row, column and frame 0, rad")
    random_phase: bool = Field(default=False, description="true: random phase in every frame")

    #: at 0.092 DN: along rows and frames, frames alone, at random phase, along columns
    typical_values = (
        {"amplitude_dn": 0.092, "cycles_per_row": 0.17, "cycles_per_frame": 0.23},
        {"amplitude_dn": 0.092, "cycles_per_frame": 0.23},
        {"amplitude_dn": 0.092, "cycles_per_row": 0.17, "random_phase": True},
        {"amplitude_dn": 0.092, "cycles_per_column": 0.17, "cycles_per_frame": 0.23},
    )

    def offsets(self, context: EffectContext) -> FloatArray:
        """Return the sine in a block of frames, DN."""
        turn = 2j * np.pi
        start = np.exp(turn * self.cycles_per_frame * context.frames + 1j * self.phase)[:, None, None]
        if self.random_phase:
            start = start * np.exp(turn * context.random.uniform(("frame",)))
        # a product of unit vectors: as exact as the sine of the sum, and no sine for every sample
        along = start * np.exp(turn * self.cycles_per_row * context.rows)[None, :, None]
        if self.cycles_per_column:
            along = along * np.exp(turn * self.cycles_per_column * np.arange(context.shape[1]))
        return np.asarray(self.amplitude_dn * along.imag)

    def offset_values(self) -> FloatArray:
        """Return values, DN, of a sine at random phase (arcsine law)."""
        return self.amplitude_dn * sine_values(5)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the highest lines of the periodograms of the row and the column means, and of all samples.

        Over frames and lines together (the phase runs on), and within frames (random phase). What alternates
        from row to row, column to column and frame to frame is no pickup.
        """
        if evidence.time is None:
            return ()
        time, alpha = evidence.time, responsivity(evidence)
        found: list[tuple[float, Self]] = []
        for name, means in (("cycles_per_row", time.row_readout), ("cycles_per_column", time.column_readout)):
            line, loose = coherent_line(means, time.frames, time.n_run), incoherent_line(means)
            if line is not None:
                fields: dict[str, Any] = {name: line.along, "cycles_per_frame": line.per_frame}
                fields |= {"amplitude_dn": line.amplitude / alpha, "phase": line.phase}
                found.append((line.excess, cls(**fields)))
            # a phase that runs on explains all that a random one would
            if loose is not None and (line is None or line.amplitude < 0.7 * loose.amplitude):
                fields = {name: loose.along, "amplitude_dn": loose.amplitude / alpha, "random_phase": True}
                found.append((loose.excess, cls(**fields)))
        found += [(wave.excess, cls._of_wave(wave, evidence)) for wave in time.waves if not wave.alternates]
        return _without_doubles(found)

    @classmethod
    def _of_wave(cls, wave: Wave, evidence: Evidence) -> Self:
        """Return the pickup that makes a wave across rows and columns."""
        steady = wave.per_frame is not None
        return cls(
            amplitude_dn=wave.amplitude / mean_response(evidence),
            cycles_per_row=wave.per_row,
            cycles_per_column=wave.per_column,
            cycles_per_frame=wave.per_frame or 0.0,
            phase=wave.phase if steady else 0.0,
            random_phase=not steady,
        )

    def to_window(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with the phase at the first row and column of a window."""
        return self._begun(rows[0], columns[0])

    def to_sensor(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with the phase at the first row and column of the sensor."""
        return self._begun(-rows[0], -columns[0])

    def _begun(self, row: int, column: int) -> Self:
        turns = self.cycles_per_row * row + self.cycles_per_column * column
        phase = (self.phase + 2.0 * np.pi * turns) % (2.0 * np.pi)
        return self.model_copy(update={"phase": 0.0 if self.random_phase else float(phase)})

    def shared_offset(self) -> SharedOffset:
        """Return the wave: in other frames its phase is another one."""
        variance = self.amplitude_dn**2 / 2.0
        if self.cycles_per_row == 0.0 and self.cycles_per_column == 0.0:
            return SharedOffset("frame", variance)
        return SharedOffset("wave", variance, self.cycles_per_row, self.cycles_per_column)


def _without_doubles(found: Sequence[tuple[float, Pickup]]) -> list[Pickup]:
    """Return the hypotheses, the strongest first; rows and columns both see a line along frames alone."""
    kept: list[Pickup] = []
    for _, pickup in sorted(found, key=lambda pair: -pair[0]):
        places = [(p.cycles_per_row, p.cycles_per_column, p.cycles_per_frame) for p in (pickup, *kept)]
        if not any(np.allclose(places[0], other, rtol=0.0, atol=1e-4) for other in places[1:]):
            kept.append(pickup)
    return kept[:4]
