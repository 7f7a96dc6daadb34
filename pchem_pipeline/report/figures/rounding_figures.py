"""Figure of what rounding to whole DN does to estimates from the density, and where the sensor stands."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pchem_pipeline.model.fit.exact import LARGEST_BIAS, rounding_bias
from pchem_pipeline.report.style.ranges import finite
from pchem_pipeline.report.style.style import COLUMN_MM, GREEN, PALETTE, SKY, new_figure, styled

__all__ = ["rounding", "rounding_curves"]

_STEPS = np.geomspace(1.5, 30.0, 40)  # DN per electron
_PHASES = 8  # biases over a whole DN
_NEEDED = ("quanta_exposure", "conversion_gain", "read_noise_e")
_LEAST_NOISE = 0.01  # e-
_NAMES = ("quanta exposure", "conversion gain", "bias", "read noise")


def rounding_curves(maps: Mapping[str, NDArray[Any]], n_frames: int | None) -> dict[str, NDArray[np.float64]]:
    """Return the largest bias by rounding of each parameter against 1/g, at the median H and read noise.

    Args:
        maps: of the run; the medians of H, g and the read noise are taken.
        n_frames: frames of a pixel.

    Returns:
        ``step``, DN per electron, and for each parameter the bias in standard errors of a pixel; empty where
        the run does not know what is needed.
    """
    needed = [finite(maps[name]) for name in _NEEDED if name in maps]
    if len(needed) < len(_NEEDED) or not n_frames or any(values.size == 0 for values in needed):
        return {}
    exposure, gain, total = (float(np.median(values)) for values in needed)
    noise = np.sqrt(max(total**2 - gain**2 / 12.0, _LEAST_NOISE**2))
    steps = np.repeat(_STEPS, _PHASES)
    phases = np.tile(np.arange(_PHASES) / _PHASES, _STEPS.size)
    sigma = np.sqrt((noise * steps) ** 2 + 1.0 / 12.0)
    found = rounding_bias(
        [np.full(steps.size, exposure), 1.0 / steps, 100.0 + phases, sigma],
        np.full(steps.size, float(n_frames)),
    )
    largest = np.abs(found).reshape(_STEPS.size, _PHASES, 4).max(axis=1)
    # beyond this the first order says no more than that the bias is large
    largest = np.where(largest < 30.0, largest, np.nan)
    return {"step": _STEPS, **{name: largest[:, i] for i, name in enumerate(_NAMES)}}


@styled
def rounding(
    curves: Mapping[str, NDArray[np.float64]], gain: NDArray[Any], *, width_mm: float = COLUMN_MM
) -> Figure:
    """Draw the bias of the density's estimates against 1/g, with the range of this sensor.

    Args:
        curves: from :func:`rounding_curves`.
        gain: map of the conversion gain, e-/DN.
        width_mm: width of the figure.
    """
    figure = new_figure(width_mm, 62.0)
    axes = figure.add_subplot()
    for colour, name in zip(PALETTE, _NAMES, strict=False):
        axes.plot(curves["step"], curves[name], color=colour, label=name)
    axes.axhline(LARGEST_BIAS, color=GREEN, linewidth=0.9, linestyle=":")
    low, high = (1.0 / float(q) for q in np.quantile(finite(gain), [0.99, 0.01]))
    axes.axvspan(low, high, color=SKY, alpha=0.3, linewidth=0, label="this sensor, 1–99 %")
    axes.set(xscale="log", yscale="log", ylim=(1e-4, 30.0))
    axes.set(xlabel="1/g (DN per electron)", ylabel="bias (standard errors)")
    axes.set_xlim(min(float(curves["step"][0]), 0.9 * low), max(float(curves["step"][-1]), 1.1 * high))
    ticks = [tick for tick in (1, 2, 5, 10, 20, 50) if axes.get_xlim()[0] <= tick <= axes.get_xlim()[1]]
    axes.set_xticks(ticks, labels=[str(tick) for tick in ticks])
    axes.minorticks_off()
    axes.legend(loc="upper right")
    return figure
