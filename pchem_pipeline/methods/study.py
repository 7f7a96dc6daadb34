"""How the error of the gain grows with the read noise, for every method, on simulated pixels.

All methods are given the same number of frames: one sample has all of them, a dark and a bright sample half
each, a series (dark, half and full exposure) a third each.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pchem_pipeline.base.plain import plain
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.methods.base import PixelSamples, Sample, methods
from pchem_pipeline.methods.compare import bounds, compare
from pchem_pipeline.methods.photon_transfer import gain_variance
from pchem_pipeline.methods.settings import MethodsSettings
from pchem_pipeline.model.law.mass import draw_histograms

#: Exposures of the samples in units of H, by what a method needs; frames are shared evenly.
SHARES: dict[str, tuple[float, ...]] = {
    "one sample": (1.0,),
    "a dark and a bright sample": (1.0, 0.0),
    "a series of samples": (1.0, 0.0, 0.5),
}


@dataclass(frozen=True)
class StudyPoint:
    """Where and with what to simulate.

    Attributes:
        read_noise_e: s_e, e-, quantisation included.
        quanta_exposure: H of the bright sample, e-.
        conversion_gain: g, e-/DN.
        n_frames: frames of a pixel, all samples together.
        n_pixels: pixels to simulate.
        seed: of the random numbers.
    """

    read_noise_e: float
    quanta_exposure: float
    conversion_gain: float
    n_frames: int
    n_pixels: int
    seed: int


def study_point(point: StudyPoint, settings: MethodsSettings) -> dict[str, Any]:
    """Return errors of all methods at one read noise, and the bounds there, as plain data.

    Methods that give one gain to the whole sensor are left out: they average over pixels.
    """
    found: dict[str, dict[str, Any]] = {}
    for number, (needs, exposures) in enumerate(SHARES.items()):
        names = [n for n, m in methods().items() if m.needs == needs and not m.sensor_wide]
        rng = np.random.default_rng([point.seed, number, round(1e6 * point.read_noise_e)])
        frames = max(point.n_frames // len(exposures), 4)
        bias = 100.0 + rng.random(point.n_pixels)  # pixels differ in where a DN begins
        noise = max(point.read_noise_e, point.conversion_gain * np.sqrt(QUANTISATION_VARIANCE))
        drawn = [
            draw_histograms(rng, share * point.quanta_exposure, point.conversion_gain, bias, noise, frames)
            for share in exposures
        ]
        pixels = PixelSamples(tuple(Sample(one.counts, one.origin) for one in drawn))
        results = compare(pixels, drawn[0].truth, settings, only=names)
        found |= {result.facts["name"]: result.facts for result in results}
    return {
        "read_noise_e": point.read_noise_e,
        "bounds": _gain_bounds(point),
        "methods": {name: found[name] for name in methods() if name in found},
    }


def _gain_bounds(point: StudyPoint) -> dict[str, float | None]:
    """Return the smallest relative errors of g: one sample, dark and bright, and photon transfer's own."""
    exposure, noise = point.quanta_exposure, point.read_noise_e
    gain, n = point.conversion_gain, point.n_frames
    one = bounds((exposure,), noise, gain, (n,))[1]
    both = bounds((exposure, 0.0), noise, gain, (n / 2, n / 2))[1]
    transfer = np.sqrt(gain_variance(exposure, 0.0, noise, n / 2, n / 2))
    found = {"one sample": one, "a dark and a bright sample": both, "photon_transfer": transfer}
    return {name: plain(value) for name, value in found.items()}
