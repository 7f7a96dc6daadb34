"""Bits of the digital number that come out wrong: stuck, lost or flipped in a share of the samples.

A solder joint, a marginal set-up time of a parallel bus or a weak driver makes one line of the data path read
0 (or 1, or its opposite) at times; a broken one makes it read so always (stuck-at faults of digital circuits,
Eldred 1959). The sample is then off by the weight of that bit, 2^b DN.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.estimators.regression import Multiple, multiple_of
from pchem_pipeline.effects.framework.effect import Count, Effect, Plane, Ratio, register_effect
from pchem_pipeline.effects.framework.evidence import CodeResiduals
from pchem_pipeline.effects.types import (
    AnyArray,
    EffectContext,
    Evidence,
    FloatArray,
    IntArray,
    PixelMaps,
    SampleLaw,
)
from pchem_pipeline.model.arithmetic.significance import CERTAIN, CLEAR

Fault = Literal["zero", "one", "flip"]
_FAULTS: tuple[Fault, ...] = ("zero", "one", "flip")
_MOST_BITS = 24
_FEWEST_PERIODS = 4  # of a bit, that codes must span for it to be stuck


@register_effect
class BitErrors(Effect):
    """In a share of the samples one bit of the digital number reads 0, or 1, or its opposite.

    Signature: counts per DN, summed over the pixels, deviate with a period of twice the bit's weight: codes
    with the bit on one side lose what those with it on the other side gain; samples lie below or above all
    that the pixel allows; nothing moves in time or between pixels.
    """

    tag: Literal["bit_errors"] = Field(default="bit_errors", description="name of the effect")
    plane = Plane.READOUT
    title = "stuck, missing or flipping bit"
    source = "Eldred 1959, J. ACM 6, 33 (stuck-at faults); Boone et al. 2018, PASP 130, 064504"
    signature = (
        "code.smooth",
        "tail.low.count",
        "code.period16",
        "code.period8",
        "code.period4",
        "shape.goodness.mean",
    )
    strength = "share"
    rough_law = True
    separate: ClassVar[Mapping[str, str]] = {
        "adc_dnl": "a ramp of light: bit errors put samples far from the ramp, DNL does not",
        "heavy_tailed_noise": "a shifted bias: bit errors are fixed in DN, heavy tails shift with the peaks",
        "rts_noise": "a shifted bias: bit errors affect all pixels and are fixed in DN",
        "clipping": "a shifted bias: clipping affects one code, a bit error is periodic in DN",
    }
    share: Ratio = Field(ge=0, le=1, description="share of the samples with an error, no unit")
    bit: Count = Field(ge=0, lt=_MOST_BITS, description="the bit, 0 is the least significant")
    fault: Fault = Field(default="zero", description="value in error: zero, one, or flip (the opposite)")

    #: bits of 4, 8 and 16 DN that are lost in one of a thousand samples, and one that flips
    typical_values = (
        *({"share": 1e-3, "bit": bit} for bit in (2, 3, 4)),
        {"share": 1e-3, "bit": 3, "fault": "flip"},
    )

    def faulty(self, codes: AnyArray) -> AnyArray:
        """Return what comes out instead of codes, DN."""
        weight = codes.dtype.type(1 << self.bit)
        if self.fault == "flip":
            return np.asarray(codes ^ weight)
        return np.asarray(codes | weight if self.fault == "one" else codes & ~weight)

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the digital numbers (frame, y, x), DN; a bit that the ADC does not have is never wrong."""
        if self.bit >= context.bit_depth:
            return values.copy()
        wrong = context.random.uniform(("frame", "y", "x")) < self.share
        return np.asarray(np.where(wrong, self.faulty(values), values))

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the bit that explains the counts per code best, with each fault that it may have.

        Bits are told from peaks by pixels of different bias, and not in single histograms.
        """
        code = evidence.code
        codes = code.first + np.arange(code.expected.size)
        if evidence.time is None or evidence.strongest(*cls.signature) < CLEAR:
            return ()
        broken = _never_seen(codes, code.observed)
        if broken is not None:
            return (cls(share=1.0, bit=broken[0], fault=broken[1]),)
        bits = range(min(int(codes[-1]).bit_length(), _MOST_BITS))
        faults = [cls(share=1.0, bit=bit, fault=fault) for bit in bits for fault in _FAULTS]
        seen = [_moved(code, fault.faulty(codes)) for fault in faults]
        best = max(range(len(seen)), key=lambda i: seen[i].sigmas)
        same = [i for i, fault in enumerate(faults) if fault.bit == faults[best].bit]
        likely = sorted((i for i in same if seen[i].sigmas > CERTAIN), key=lambda i: -seen[i].sigmas)
        return [faults[i].model_copy(update={"share": min(seen[i].value, 1.0)}) for i in likely]

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with satellites at the weight of the bit, of the share that each pixel has there.

        Right in how many samples move, and how far; not in from which of a pixel's codes.
        """
        up, down = self._moving(maps)
        weight = float(1 << self.bit)
        weights = self.share * np.stack([down, up], axis=1)
        weights = np.concatenate([weights, 1.0 - weights.sum(axis=1, keepdims=True)], axis=1)
        return model.with_noise(weights, shift_dn=np.array([-weight, weight, 0.0]))

    def _moving(self, maps: PixelMaps) -> tuple[FloatArray, FloatArray]:
        """Return the shares of each pixel's samples whose bit is 0 and goes up, or 1 and goes down, (n,)."""
        from pchem_pipeline.effects.estimators.codes import code_range
        from pchem_pipeline.model.law.mass import sample_mass
        from pchem_pipeline.model.law.sample_law import SampleLaw

        first, last = code_range(maps)
        codes = np.arange(first, last + 1)
        mass = np.nan_to_num(sample_mass(SampleLaw(), maps, codes, far_tails=False))
        is_set = (codes >> self.bit & 1).astype(np.float64)
        up, down = mass @ (1.0 - is_set), mass @ is_set
        return (up * (self.fault != "zero"), down * (self.fault != "one"))


def _moved(code: CodeResiduals, to: IntArray) -> Multiple:
    """Return the share of the samples that come out as other codes, as the counts have it."""
    leaves = to != code.first + np.arange(to.size)
    at = to - code.first
    arrives = leaves & (at >= 0) & (at < to.size)
    change = np.where(leaves, -code.expected, 0.0)
    change += np.bincount(at[arrives], code.expected[arrives], to.size)
    return multiple_of(change, code.observed - code.expected, 1.0 / np.maximum(code.observed, 1.0))


def _never_seen(codes: IntArray, observed: FloatArray) -> tuple[int, Literal["zero", "one"]] | None:
    """Return the lowest bit that is the same in all samples although they span several of its periods."""
    used = codes[observed > 0]
    if not used.size:
        return None
    span, always, ever = int(used[-1] - used[0]), np.bitwise_and.reduce(used), np.bitwise_or.reduce(used)
    for bit in range(_MOST_BITS):
        if span < _FEWEST_PERIODS << (bit + 1):
            return None
        if not ever >> bit & 1:
            return bit, "zero"
        if always >> bit & 1:
            return bit, "one"
    return None
