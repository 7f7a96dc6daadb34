"""Cosmic rays and radioactivity: straight tracks of many electrons.

A relativistic particle frees about 80 electrons per micrometre of silicon (Groom 2002, "Cosmic rays and
other nonsense in astronomical CCD imagers"); muons at sea level come at one to two per square centimetre and
minute. The tracks are independent, Poisson many per frame; what a track leaves in a pixel is Poisson about
its share.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.framework.effect import Effect, Plane, register_effect

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pchem_pipeline.effects.framework.context import EffectContext
    from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps
    from pchem_pipeline.model.law.sample_law import SampleLaw

# points per pixel along a track
_POINTS = 8
# the evidence lists no more hits than this
_MOST_HITS = 20_000
# of a pixel's samples: enough for the fit to disregard those far off, too little to matter for the others
_SHARE_OF_SAMPLES = 1e-6


@register_effect
class CosmicRays(Effect):
    """Straight tracks at random places and angles, of exponentially distributed length.

    Signature: few samples far above all that a pixel's law allows, next to each other in the same frame; the
    rest of the histogram as before.
    """

    tag: Literal["cosmic_rays"] = Field(default="cosmic_rays", description="name of the effect")
    plane: ClassVar[Plane] = Plane.CHARGE
    title: ClassVar[str] = "cosmic rays and radioactivity"
    source: ClassVar[str] = "Groom 2002, Exp. Astron. 14, 45"
    signature: ClassVar[tuple[str, ...]] = ("tail.high.count", "tail.high.clusters", "tail.high.pixels")
    strength: ClassVar[str] = "tracks_per_frame"
    separate: ClassVar[Mapping[str, str]] = {
        "heavy_tailed_noise": "samples far below the bias as well as above: none here",
        "rts_noise": "the same pixels again and again: tracks fall everywhere",
        "branching_counts": "the excess grows with the exposure: tracks do not",
    }
    tracks_per_frame: float = Field(
        ge=0, le=100, description="mean number of tracks on the sensor in a frame"
    )
    length_um: float = Field(
        default=15.0, gt=0, description="mean length of a track projected on the sensor, um"
    )
    electrons_per_um: float = Field(
        default=80.0, gt=0, description="electrons freed per length of the projected track, e-/um"
    )
    pixel_pitch_um: float = Field(default=3.0, gt=0, description="distance between pixels, um")

    def apply(self, values: NDArray[Any], context: EffectContext) -> NDArray[Any]:
        """Return electron numbers (frame, y, x), e-, with those of the tracks; touches frames with tracks."""
        result = values.copy()
        u = context.random.uniform(("frame",))[:, 0, 0]
        # most tracks from the smallest numbers: frames hit at a low rate are hit at a higher one too
        hit = np.flatnonzero(u < -np.expm1(-self.tracks_per_frame))
        for i in hit:
            random = context.random.generator(frame=int(context.frames[i]))
            for _ in range(_poisson_upper(float(u[i]), self.tracks_per_frame)):
                y, x, electrons = self._track(context.shape, random)
                row = y - context.rows[0]
                inside = (row >= 0) & (row < values.shape[1])
                np.add.at(result[i], (row[inside], x[inside]), electrons[inside])
        return result

    def _track(
        self, shape: tuple[int, int], random: np.random.Generator
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Return rows and columns of the pixels of a track on the whole sensor, and its electrons in each."""
        start = random.random(2) * shape
        angle = 2.0 * np.pi * random.random()
        length = random.exponential(self.length_um / self.pixel_pitch_um)
        n = max(1, int(np.ceil(length * _POINTS)))
        along = (np.arange(n) + 0.5) * (length / n)
        place = np.floor(start + along[:, None] * (np.sin(angle), np.cos(angle))).astype(np.int64)
        place = place[((place >= 0) & (place < shape)).all(axis=1)]
        pixels, count = np.unique(place, axis=0, return_counts=True)
        share = length / n * self.pixel_pitch_um * self.electrons_per_um
        return pixels[:, 0], pixels[:, 1], random.poisson(count * share)

    @classmethod
    def typical(cls) -> Sequence[Self]:
        """Return it at one track in 80 frames."""
        return (cls(tracks_per_frame=0.012),)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return rate, length and electrons from the samples far above their pixels' support.

        A frame with such samples counts as one with tracks (their number is Poisson); a track that covers
        m pixels in the mean is about (m - 1) pi / 4 pixels long.
        """
        time, maps = evidence.time, evidence.maps
        if time is None or time.hits.shape[0] < 3:
            return ()
        whole = time.hits.shape[0] < _MOST_HITS
        n_seen = time.frames.size if whole else int(np.searchsorted(time.frames, time.hits[:, 0].max())) + 1
        y, x = time.hits[:, 1], time.hits[:, 2]
        exposure = maps.quanta_exposure[y, x]
        charge = (time.hits[:, 3] - maps.bias[y, x]) * maps.conversion_gain[y, x] - exposure
        # by chance a few samples lie just beyond the support; a track leaves far more
        far = charge > 6.0 * np.sqrt(exposure) + 6.0
        if far.sum() < 3:
            return ()
        n_hit = np.unique(time.hits[far, 0]).size
        tracks = -n_seen * np.log1p(-min(n_hit / n_seen, 1.0 - 0.5 / n_seen))
        pixels = float(far.sum()) / tracks
        # tracks are longer than a pixel; hits that stay alone are something else
        if pixels < 1.2:
            return ()
        pitch = float(cls.model_fields["pixel_pitch_um"].default)
        length = (pixels - 1.0) * np.pi / 4.0 * pitch
        per_um = float(charge[far].sum()) / tracks / length
        if not per_um > 0:
            return ()
        return (cls(tracks_per_frame=float(tracks / n_seen), length_um=length, electrons_per_um=per_um),)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law in which a sample may, very rarely, be anything: how rarely does not matter."""
        return model.with_outliers(_SHARE_OF_SAMPLES) if self.tracks_per_frame > 0 else model


def _poisson_upper(u: float, mean: float) -> int:
    """Return N >= j where u < P(N >= j), N Poisson."""
    n, mass, above = 0, float(np.exp(-mean)), float(-np.expm1(-mean))
    while u < above and n < 10_000:
        n += 1
        mass *= mean / n
        above -= mass
    return n
