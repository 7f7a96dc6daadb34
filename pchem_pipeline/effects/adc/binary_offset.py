"""Binary offset: the converter adds an offset that follows the bits of the sample that it converted before.

Currents of the output drivers, and charge left on the capacitors of a converter, depend on the code that it
gave last: the next sample is off by an amount for each bit that was 1. Seen in 16 of 22 astronomical
instruments, up to 4.5 DN, and it does not average away (Boone et al. 2018).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field, field_validator

from pchem_pipeline.effects.framework.effect import Dn, Effect, Plane, register_effect
from pchem_pipeline.effects.framework.evidence import PreviousBits
from pchem_pipeline.effects.types import AnyArray, EffectContext, Evidence, FloatArray, PixelMaps, SampleLaw

_LEAST_GAIN = 16.0  # fall of chi2 that the best of 8 bits must bring: by chance once in 2,000 stacks
_MORE_GAIN = 25.0  # that of a further bit
_MOST_PEAKS = 3  # bits with levels of their own in the law; of the others the variance


@register_effect
class BinaryOffset(Effect):
    """Each bit that was 1 in the sample read before raises a sample by its offset, and each 0 lowers it.

    Signature: samples follow single bits of the sample before them in the row, beyond its value; a pixel's
    own histogram only broadens, into two levels for each bit.
    """

    tag: Literal["binary_offset"] = Field(default="binary_offset", description="name of the effect")
    plane = Plane.ADC
    along = 2
    title = "binary offset (bit-dependent ADC memory)"
    source = "Boone et al. 2018, PASP 130, 064504"
    signature = ("space.x.bits", "space.x.rk", "space.x.rr")
    strength = "offset_dn"
    separate: ClassVar[Mapping[str, str]] = {
        "interpixel_capacitance": "pixels above and below: ADC memory acts along the row only",
        "optical_crosstalk": "a bright spot: crosstalk depends on nearby charge, a binary offset on the code",
        "adc_dnl": "a dark neighbour: DNL stays, an offset by the previous code vanishes",
    }
    offset_dn: Dn = Field(
        ge=-1e4, le=1e4, description="difference between a bit of 1 and of 0, in units of `bits`, DN"
    )
    bits: tuple[float, ...] = Field(
        default=(1.0,), max_length=24, description="relative offset of each bit, the least significant first"
    )

    #: offsets by the lowest bits of 0.3 DN, and of the other sign
    typical_values = ({"offset_dn": 0.3}, {"offset_dn": -0.3}, {"offset_dn": 0.3, "bits": (0.0, 1.0)})

    @field_validator("bits")
    @classmethod
    def _some_bit(cls, bits: tuple[float, ...]) -> tuple[float, ...]:
        if not any(bits):
            raise ValueError("binary_offset: bits are all 0; give the relative offset of at least one")
        return bits

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal at the ADC (frame, y, x), DN; draws nothing.

        Column by column, since a sample's code has the offset in it; the first of a row has none.
        """
        top, result = 2**context.bit_depth - 1, values.copy()
        for x in range(1, values.shape[2]):
            before = np.clip(np.rint(result[:, :, x - 1]), 0, top).astype(np.int64)
            for bit, relative in enumerate(self.bits):
                if relative:
                    result[:, :, x] += self.offset_dn * relative * ((before >> bit & 1) - 0.5)
        return result

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the bits that samples follow: the best one, with every other that explains much more."""
        if evidence.time is None or evidence.time.previous_bits is None:
            return ()
        offsets = _pursued(evidence.time.previous_bits)
        if not offsets.any():
            return ()
        largest = offsets[np.abs(offsets).argmax()]
        relative = offsets / largest
        used = int(np.flatnonzero(relative)[-1]) + 1
        return (cls(offset_dn=float(largest), bits=tuple(np.round(relative[:used], 4).tolist())),)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with two levels for each bit, as likely each, and a normal law for the smallest."""
        order = sorted(self.bits, key=abs, reverse=True)
        for relative in order[:_MOST_PEAKS]:
            half = 0.5 * self.offset_dn * relative
            if half:
                model = model.with_noise([0.5, 0.5], shift_dn=[-half, half])
        rest = sum(relative**2 for relative in order[_MOST_PEAKS:])
        return model.with_variance(dn2=0.25 * self.offset_dn**2 * rest)


def _pursued(seen: PreviousBits) -> FloatArray:
    """Return the offset of each bit, DN: one bit after the other that lowers chi2 the most, all refitted."""
    offsets = np.zeros(seen.product.size)
    chosen: list[int] = []
    scale = seen.square / seen.variance
    while len(chosen) < offsets.size:
        left = (seen.product - seen.square @ offsets) / seen.variance
        free = np.diag(scale).copy()
        if chosen:
            part = scale[:, chosen]
            free -= np.einsum("ij,ji->i", part, np.linalg.solve(scale[np.ix_(chosen, chosen)], part.T))
        with np.errstate(divide="ignore", invalid="ignore"):
            gain = np.where(free > 1e-3 * np.diag(scale), left**2 / free, 0.0)
        best = int(gain.argmax())
        if gain[best] < (_MORE_GAIN if chosen else _LEAST_GAIN):
            break
        chosen.append(best)
        offsets[chosen] = np.linalg.solve(
            scale[np.ix_(chosen, chosen)], (seen.product / seen.variance)[chosen]
        )
    return offsets
