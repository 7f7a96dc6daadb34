"""Strikes: rare events that leave charge in several pixels, by cosmic rays and radioactivity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, NamedTuple, Self

import numpy as np
from pydantic import Field
from scipy import special
from scipy.sparse import coo_array, csgraph
from scipy.spatial import KDTree

from pchem_pipeline.effects.framework.effect import (
    Effect,
    Electrons,
    ElectronsPerUm,
    Factors,
    Micrometres,
    PerFrame,
    Plane,
    Ratio,
)
from pchem_pipeline.effects.framework.evidence import MOST_HITS
from pchem_pipeline.effects.types import (
    AnyArray,
    EffectContext,
    Evidence,
    FloatArray,
    IntArray,
    PixelMaps,
    SampleLaw,
)

# points per pixel along a track
_POINTS = 8
# of a pixel's samples: enough for the fit to disregard those far off, too little to matter for the others
_SHARE_OF_SAMPLES = 1e-6
# standard deviations of a cloud out to which it is drawn: of some ten thousand electrons none is farther
_REACH = 5.0
# pixels beyond those that a straight line of the same height and width can cross, of a cloud
_BEYOND_A_LINE = 2
# variance of a place within its pixel, pixels^2
_OF_A_PIXEL = 1.0 / 12.0


#: Rows and columns of pixels, and the electrons in each.
_Electrons = tuple[IntArray, IntArray, IntArray]


class _Event(NamedTuple):
    """Hits of a frame that touch each other."""

    pixels: int
    charge: float  # e-
    spread: float  # standard deviation of the charge along an axis, pixels
    is_cloud: bool  # they are more than a straight line crosses


class CosmicRays(Effect, tag="cosmic_rays"):
    """Tracks at random places and angles, straight and of exponentially distributed length, or round clouds.

    A relativistic particle frees about 80 electrons per micrometre of silicon (Groom 2002, "Cosmic rays
    and other nonsense in astronomical CCD imagers"); muons at sea level come at one to two per square
    centimetre and minute. An alpha particle from the materials of the sensor stops in a few micrometres,
    and its charge spreads from there into a round cloud ("spots" among Groom's kinds). All are
    independent, Poisson many per frame; what one leaves in a pixel is Poisson about its share.

    Signature: few samples far above all that a pixel's law allows, next to each other in the same frame; the
    rest of the histogram as before.
    """

    plane = Plane.CHARGE
    title = "cosmic rays and radioactivity"
    source = "Groom 2002, Exp. Astron. 14, 45"
    factors = Factors("electron number", "pixels along a track", "in single frames")
    signature = ("tail.high.count", "tail.high.clusters", "tail.high.pixels")
    strength = "tracks_per_frame"
    separate: ClassVar[Mapping[str, str]] = {
        "heavy_tailed_noise": "samples far below the bias: none by tracks",
        "rts_noise": "a longer run: RTS noise stays in the same pixels, tracks hit all",
        "branching_counts": "several exposures: tracks are independent of the exposure",
    }
    typical_values = ({"tracks_per_frame": 0.012},)
    tracks_per_frame: PerFrame = Field(ge=0, le=100, description="mean number of tracks and clouds per frame")
    length_um: Micrometres = Field(
        default=15.0, gt=0, description="mean length of a track projected on the sensor, um"
    )
    electrons_per_um: ElectronsPerUm = Field(
        default=80.0, gt=0, description="electrons per length of the projected track, e-/um"
    )
    pixel_pitch_um: Micrometres = Field(default=3.0, gt=0, description="distance between pixels, um")
    cloud_share: Ratio = Field(default=0.0, ge=0, le=1, description="share of round clouds (alpha particles)")
    cloud_electrons: Electrons = Field(
        default=2e4, gt=0, description="median of the electrons of a cloud, e-"
    )
    cloud_range: Ratio = Field(
        default=0.0, ge=0, le=3, description="standard deviation of the logarithm of these electrons, no unit"
    )
    cloud_um: Micrometres = Field(
        default=3.0, gt=0, description="standard deviation of a cloud along an axis, um"
    )

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return electron numbers (frame, y, x), e-, with those of the tracks; touches frames with tracks."""
        result = values.copy()
        u = context.random.uniform(("frame",))[:, 0, 0]
        # most tracks from the smallest numbers: frames hit at a low rate are hit at a higher one too
        hit = np.flatnonzero(u < -np.expm1(-self.tracks_per_frame))
        for i in hit:
            random = context.random.generator(frame=int(context.frames[i]))
            for _ in range(_poisson_upper(float(u[i]), self.tracks_per_frame)):
                is_cloud = self.cloud_share > 0 and random.random() < self.cloud_share
                y, x, electrons = (self._cloud if is_cloud else self._track)(context.shape, random)
                row = y - context.rows[0]
                inside = (row >= 0) & (row < values.shape[1])
                np.add.at(result[i], (row[inside], x[inside]), electrons[inside])
        return result

    def _track(self, shape: tuple[int, int], random: np.random.Generator) -> _Electrons:
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

    def _cloud(self, shape: tuple[int, int], random: np.random.Generator) -> _Electrons:
        """Return the same of a cloud; of more electrons it is wider, its density at the middle the same."""
        middle = random.random(2) * shape
        more = float(np.exp(self.cloud_range * random.standard_normal()))
        width = self.cloud_um / self.pixel_pitch_um * np.sqrt(more)
        first = np.clip(middle - _REACH * width, 0, shape).astype(np.int64)
        end = np.ceil(np.clip(middle + _REACH * width, 0, shape)).astype(np.int64)
        edges = [np.arange(low, high + 1) for low, high in zip(first, end, strict=True)]
        along = [np.diff(special.ndtr((each - c) / width)) for each, c in zip(edges, middle, strict=True)]
        electrons = random.poisson(self.cloud_electrons * more * np.outer(*along))
        i, j = np.nonzero(electrons)
        return edges[0][i], edges[1][j], electrons[i, j]

    def details(self) -> tuple[str, ...]:
        """Return what tracks are like, and clouds if there are any."""
        tracks = ("length_um", "electrons_per_um") if self.cloud_share < 1.0 else ()
        clouds = ("cloud_share", "cloud_electrons", "cloud_um") if self.cloud_share > 0.0 else ()
        return tracks + clouds

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return rate, length and electrons from the samples far above their pixels' support.

        A frame with such samples counts as one with tracks (their number is Poisson); a track that covers
        m pixels in the mean is about (m - 1) pi / 4 pixels long. Hits that touch each other are one event,
        and a cloud where they are more than a straight line crosses.
        """
        time, maps = evidence.time, evidence.maps
        if time is None or time.hits.shape[0] < 3:
            return ()
        whole = time.hits.shape[0] < MOST_HITS
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
        # tracks are longer than a pixel; hits that stay alone are something else
        if far.sum() / tracks < 1.2:
            return ()
        events = _events(time.hits[far, :3], charge[far])
        found = cls(tracks_per_frame=float(tracks / n_seen))
        lines = [event for event in events if not event.is_cloud]
        clouds = [event for event in events if event.is_cloud]
        update: dict[str, float] = {"cloud_share": len(clouds) / len(events)}
        # few events merge: those that a frame has in all are as many as its tracks
        pixels = sum(event.pixels for event in lines) / max(tracks * (1.0 - update["cloud_share"]), 1e-12)
        if lines and pixels > 1.0:
            update["length_um"] = (pixels - 1.0) * np.pi / 4.0 * found.pixel_pitch_um
            update["electrons_per_um"] = (
                sum(event.charge for event in lines) / len(lines) / update["length_um"]
            )
        if clouds:
            sizes = np.log([event.charge for event in clouds])
            update["cloud_electrons"] = float(np.exp(sizes.mean()))
            update["cloud_range"] = min(float(sizes.std()), 3.0)
            update["cloud_um"] = found.pixel_pitch_um * float(np.median([event.spread for event in clouds]))
        return (found.model_copy(update=update),)

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


def _events(hits: IntArray, charge: FloatArray) -> list[_Event]:
    """Return the events of hits (frame, y, x), shape (n, 3), whose charges are of shape (n,), e-."""
    # frames are two apart, so that only pixels of one frame touch each other
    pairs = KDTree(hits * (2, 1, 1)).query_pairs(1.0, p=np.inf, output_type="ndarray")
    n = len(hits)
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    _, label = csgraph.connected_components(graph, directed=False)
    found = []
    for members in np.split(np.argsort(label, kind="stable"), np.cumsum(np.bincount(label))[:-1]):
        place, weight = hits[members, 1:], charge[members]
        off = place - np.average(place, axis=0, weights=weight)
        variance = float(np.average((off**2).mean(axis=1), weights=weight))
        line = int(np.ptp(place, axis=0).sum()) + 1
        found.append(
            _Event(
                pixels=len(members),
                charge=float(weight.sum()),
                spread=float(np.sqrt(max(variance - _OF_A_PIXEL, _OF_A_PIXEL))),
                is_cloud=len(members) > line + _BEYOND_A_LINE,
            )
        )
    return found
