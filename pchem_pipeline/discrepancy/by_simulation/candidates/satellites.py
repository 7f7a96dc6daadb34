"""Parameters of effects that give single pixels satellite peaks, as a trap in the source follower does.

It is in few pixels, and differs from one to the other. The pixels that the model does not fit are fitted with
free satellites (:attr:`~pchem_pipeline.model.law.sample_law.SampleLaw.free_satellites`) of amplitudes over a
wide range: what is found in them is a sample of amplitudes and weights.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import error_words
from pchem_pipeline.discrepancy.effort import Effort
from pchem_pipeline.effects.framework.compose import pixel_maps, sample_law
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.model.arithmetic.significance import SIGNIFICANCE
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.result import FitResult
from pchem_pipeline.model.histogram.count import histogram_frames

#: Amplitudes that are tried, 0.35 to 5 e-: a fit refines the best one.
_AMPLITUDES = tuple(0.35 * 1.35**i for i in range(10))
_MOST_PIXELS = 64
#: Share of what the best one explains, by which another one is far behind it.
FAR_SHARE = 0.1


def with_satellites(
    frames: NDArray[np.unsignedinteger],
    maps: PixelMaps,
    present: Sequence[Effect],
    guesses: Mapping[str, Sequence[Effect]],
    effort: Effort,
    defects: dict[str, str],
) -> dict[str, list[Effect]]:
    """Return effects with parameters from fitted free satellites of the pixels, by tag, the likeliest first.

    Effects whose law has no free satellites are left out, and so are all where no pixel has any.

    Args:
        frames: (frame, y, x), DN.
        maps: of their pixels under the model.
        present: effects of the model, which act everywhere.
        guesses: effects by tag.
        effort: counts the work.
        defects: effects that failed, and why; out.
    """
    usable = np.flatnonzero(maps.usable)
    start = maps.columns[usable]
    near = pixel_maps(list(start.T), np.ones(usable.size, np.bool_))
    laws = {}
    for guess in (g for own in guesses.values() for g in own):
        # one of a plug-in may raise anything, which is noted where it is fitted
        try:
            law = sample_law((*present, guess), near)
        except Exception:
            continue
        if law.free_satellites:
            laws[guess] = replace(law, free_satellites=_AMPLITUDES)
    if not laws:
        return {}
    histograms = histogram_frames(frames.reshape(len(frames), 1, -1)[:, :, usable])
    counts, origin = histograms.counts[0], histograms.origin[0]
    plain = fit_histograms(counts, origin, law=sample_law(present, near), start=start)
    poor = np.flatnonzero(plain.goodness_p < SIGNIFICANCE)
    if not poor.size:
        return {}
    some = poor[:: -(-poor.size // _MOST_PIXELS)]
    fits: dict[tuple[tuple[float, float], ...], FitResult] = {}
    found: list[tuple[float, Effect]] = []
    for guess, law in laws.items():
        fit = fits.get(law.free_satellite_pattern)
        if fit is None:
            fit = fit_histograms(counts[some], origin[some], law=law.of(some), start=start[some])
            effort.evaluate(fit.evaluated(counts[some]), law.components, ())
            fits[law.free_satellite_pattern] = fit
        has = fit.satellite_weight > 0.0
        if has.any():
            rise = float(np.nansum(fit.log_likelihood - plain.log_likelihood[some]))
            own = fit.satellite_amplitude_e[has], fit.satellite_weight[has]
            share = float(has.mean()) * poor.size / usable.size
            # an effect of a plug-in may raise anything: the others are compared all the same
            try:
                found.append((rise, guess.with_satellites(*own, share)))
            except Exception as error:
                defects[guess.tag] = error_words(error)
    least = (1.0 - FAR_SHARE) * max((rise for rise, _ in found), default=0.0)
    likely: dict[str, list[Effect]] = {}
    for rise, effect in sorted(found, key=lambda one: -one[0]):
        if rise >= least:
            likely.setdefault(effect.tag, []).append(effect)
    return likely
