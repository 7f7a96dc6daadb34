"""In-camera pixel correction: a sample far above its neighbours is replaced by what they predict.

Scientific cameras correct hot and blinking pixels in their firmware, often by default and without a word in
the file: hot-pixel correction with levels (Hamamatsu ``HOTPIXELCORRECT_LEVEL``), dynamic filters of telegraph
noise (Andor ``SpuriousNoiseFilter``), static maps of blemishes. The rule is a threshold: a sample that
exceeds the median of its eight neighbours by more than so many DN comes out as that median.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.estimators.prediction import PREDICTORS, Predictor, predicted
from pchem_pipeline.effects.framework.effect import Code, Effect, Plane, Ratio, Replacement, register_effect
from pchem_pipeline.effects.framework.evidence import PredictedSamples
from pchem_pipeline.effects.types import AnyArray, EffectContext, Evidence, FloatArray
from pchem_pipeline.model.arithmetic.significance import CERTAIN, CLEAR

_NEARLY_ALL = 0.8  # share of the samples beyond which what some have is taken for all
_FEWEST = 20.0  # samples above the threshold by chance


@register_effect
class PixelCorrection(Effect):
    """A sample that exceeds what its neighbours predict by more than a threshold becomes the prediction.

    Signature: samples equal what their neighbours predict more often than what those of the next frame do,
    and exceed it less often; the upper tail of a pixel is cut, the more so the darker its neighbours. A
    pixel's own histogram has no law of its own, since the cut is where the neighbours put it: the search
    learns the sensor by what those predict (:meth:`replacement`), and in a fit the pixels keep the parameters
    of their corrected samples.
    """

    tag: Literal["pixel_correction"] = Field(default="pixel_correction", description="name of the effect")
    plane = Plane.READOUT
    along = 1
    title = "in-camera pixel correction (hot pixels, spurious noise)"
    source = "Hamamatsu DCAM-API (HOTPIXELCORRECT_LEVEL); Andor SDK3 (SpuriousNoiseFilter)"
    signature = ("space.predicted.equal", "space.predicted.above", "shape.C3.mean")
    strength = "share"
    reach_rows = 1
    separate: ClassVar[Mapping[str, str]] = {
        "row_noise": "camera corrections switched off: row noise stays",
        "frame_noise": "camera corrections switched off: frame noise stays",
        "optical_crosstalk": "camera corrections switched off: crosstalk stays",
        "clipping": "pixels of different bias: clipping is at one code, a correction at none",
    }
    threshold_dn: Code = Field(
        ge=1, le=1 << 20, description="excess over the prediction from which samples are replaced, DN"
    )
    share: Ratio = Field(
        default=1.0, ge=0, le=1, description="share of those samples that are replaced, no unit"
    )
    predictor: Predictor = Field(
        default="median",
        description="median or mean: of the eight neighbours; row: mean of the left and the right one",
    )

    #: at 60 DN above the median
    typical_values = ({"threshold_dn": 60},)

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the digital numbers (frame, y, x), DN, corrected; those at the border stay as they are."""
        rule = self.replacement(values)
        replaced = (values - rule.value > rule.excess) & rule.inside
        if self.share < 1.0:
            replaced &= context.random.uniform(("frame", "y", "x")) < self.share
        return np.where(replaced, rule.value, values).astype(values.dtype)

    def replacement(self, frames: AnyArray) -> Replacement:
        """Return the rule: what the neighbours predict, inside the border."""
        value, inside = frames.astype(np.int32), np.zeros(frames.shape[1:], np.bool_)
        if min(inside.shape) >= 3:
            value[:, 1:-1, 1:-1] = predicted(frames, self.predictor)
            inside[1:-1, 1:-1] = True
        return Replacement(value, inside, self.threshold_dn, self.share)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the threshold above which samples are too few, and the share that is replaced.

        Of the kinds of prediction, the one that samples equal too often the most. Firmware replaces all or
        none: a share near 1 is also guessed to be 1, since replaced neighbours lower later predictions, and
        samples then exceed those that did not exceed the first ones.
        """
        if evidence.time is None:
            return ()
        kinds = evidence.time.predicted
        best = max(PREDICTORS, key=lambda kind: kinds[kind].equal_z if kind in kinds else 0.0)
        if best not in kinds or kinds[best].equal_z < CERTAIN:
            return ()
        found = _threshold(kinds[best])
        if found is None:
            return ()
        shares = (1.0, found[1]) if _NEARLY_ALL <= found[1] < 1.0 else (found[1],)
        return [cls(threshold_dn=found[0], share=share, predictor=best) for share in shares]


def _threshold(seen: PredictedSamples) -> tuple[int, float] | None:
    """Return the threshold, DN, and the share of samples replaced above it; None where none is.

    Of all thresholds the one at which a share explains the deficit above it best (Poisson likelihood).
    """
    own, (one, _, _) = seen.above, seen.above_chance
    with np.errstate(divide="ignore", invalid="ignore"):
        fall = np.where(own > 0, own * np.log(own / one), 0.0) - (own - one)
        z = (one - own) / np.sqrt(own + one / 3.0)
    fall = np.where((z > CLEAR) & (one >= _FEWEST), fall, 0.0)
    place = int(fall.argmax())
    if fall[place] <= 0.0:
        return None
    share = _replaced_share(float(own[place]), seen.above_chance[:, place])
    return int(seen.thresholds[place]), share


def _replaced_share(own: float, moments: FloatArray) -> float:
    """Return the share s of replaced samples from how many are above their own and others' predictions.

    A sample x exceeds the prediction of a chance frame with probability q(x). Of the samples before the
    correction, those that come out are ``1 - s q`` (in other places), so that ``(1 - s) E[q / (1 - s q)]`` of
    those that came out exceed their own; the expectation is a series in the moments of q.

    Args:
        own: samples above their own prediction.
        moments: those above one, two, three given predictions of other frames, as E[q], E[q^2], E[q^3] times
            the number of samples.
    """
    first, second, third = moments
    ratio = min(third / second, 1.0) if second > 0 else 0.0
    share = np.linspace(0.0, 1.0, 2001)
    series = first + share * second + share**2 * third / np.maximum(1.0 - share * ratio, 1e-9)
    expected = (1.0 - share) * series
    return float(share[np.abs(expected - own).argmin()])
