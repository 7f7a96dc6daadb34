"""Noise that is correlated in the order of reading: 1/f noise of an output amplifier.

Where pixels leave the sensor one after the other through one amplifier (CCD, EMCCD, skipper) or few of them,
the slow part of that amplifier's noise is common to samples that follow each other: stripes along the rows
that are soft at their ends, of all widths. Each tap reads a block of columns, row by row, with noise of its
own (correlated pink noise of near-infrared arrays: Rauscher 2015; Pyxel ``correlated_pink_noise_cmos``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.families.offsets import OffsetEffect
from pchem_pipeline.effects.framework.effect import Count, Dn, register_effect
from pchem_pipeline.effects.framework.region import Span
from pchem_pipeline.effects.types import EffectContext, Evidence, FloatArray

# frames in a record of noise, of which one is used: what is cut from a longer one has no period
_RECORD = 4


@register_effect
class ReadOrderNoise(OffsetEffect):
    """Noise with a spectrum of ``1 / f`` along the samples of a tap, from one cycle per frame on.

    Signature: row means of the readout residual scatter, those of adjacent rows alike, and neighbours along
    the row are correlated more than pixels far apart in it. A pixel's own histogram only broadens.
    """

    tag: Literal["read_order_noise"] = Field(default="read_order_noise", description="name of the effect")
    title = "1/f noise along the readout"
    source = "Rauscher 2015, PASP 127, 1144 (correlated pink noise)"
    signature = (
        "space.row.readout.lag1",
        "space.row.readout.variance",
        "space.x.rr",
        "space.y.rr",
        "frame.readout.quadrants",
    )
    strength = "noise_dn"
    power = 2.0
    separate: ClassVar[Mapping[str, str]] = {
        "row_noise": "distant pixels of a row: 1/f noise correlates them less than neighbours",
        "frame_noise": "distant rows of a frame: 1/f noise does not correlate them",
        "interpixel_capacitance": "dark frames: amplifier noise stays, coupled charge vanishes",
        "periodic_pickup": "spectrum in readout order: pickup is a line, 1/f noise falls",
        "bias_jumps": "successive frames: 1/f noise is independent",
    }
    noise_dn: Dn = Field(ge=0, le=1e6, description="standard deviation, DN")
    taps: Count = Field(
        default=1, ge=1, le=4096, description="column blocks read in parallel, with independent noise"
    )

    #: at 0.5 DN, of one tap and of several
    typical_values = tuple({"noise_dn": 0.5, "taps": taps} for taps in (1, 4, 2, 8))

    def to_window(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with as many taps as these columns have of its width."""
        return self._with_taps((columns[1] - columns[0]) / shape[1])

    def to_sensor(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with taps of the same width on all columns; one tap is one whatever the window."""
        return self if self.taps == 1 else self._with_taps(shape[1] / (columns[1] - columns[0]))

    def _with_taps(self, factor: float) -> Self:
        return self.model_copy(update={"taps": max(round(self.taps * factor), 1)})

    def offsets(self, context: EffectContext) -> FloatArray:
        """Return the noise of the taps in a block of frames, DN."""
        if self.noise_dn == 0:
            return np.zeros((1, 1, 1))
        rows, columns = context.shape
        taps = min(self.taps, columns)
        width = -(-columns // taps)
        amplitudes = _pink_amplitudes(rows * width)
        noise = np.empty((context.frames.size, context.rows.size, columns))
        for t, frame in enumerate(context.frames):
            random = context.random.generator(frame=int(frame))
            white = np.fft.rfft(random.standard_normal((taps, _RECORD * rows * width)))
            record = np.fft.irfft(amplitudes * white, _RECORD * rows * width)
            series = record[:, : rows * width].reshape(taps, rows, width)
            noise[t] = series.transpose(1, 0, 2).reshape(rows, taps * width)[context.rows, :columns]
        noise *= self.noise_dn
        return noise

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return it with few taps, as strong as adjacent rows are alike: noise of rows makes none alike."""
        columns = evidence.maps.usable.shape[1]
        return [one for one in cls.typical_as_seen(evidence, cls.signature[0]) if columns % one.taps == 0]


def _pink_amplitudes(n: int) -> FloatArray:
    """Return factors of the spectrum that make white noise of a record 1/f, of variance 1.

    Args:
        n: samples of a frame; there is nothing slower than one cycle in so many.

    Returns:
        (_RECORD n // 2 + 1,), real.
    """
    cycles = np.arange(_RECORD * n // 2 + 1)
    amplitudes = np.where(cycles >= min(_RECORD, cycles[-1]), np.maximum(cycles, 1) ** -0.5, 0.0)
    weight = np.where((cycles == 0) | (2 * cycles == _RECORD * n), 1.0, 2.0)
    return np.asarray(amplitudes / np.sqrt((weight * amplitudes**2).sum() / (_RECORD * n)))
