"""The criteria of the sensor: quantity, value found, limit, and whether it passes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.model.maps.maps import hot_pixels
from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.style.wording import percent, short


@dataclass(frozen=True)
class Criterion:
    """One limit beside what was found.

    Attributes:
        setting: its key in ``report.criteria``.
        words: what is judged.
        found: the number, as text.
        limit: the limit, as text.
        met: whether the sensor meets it.
    """

    setting: str
    words: str
    found: str
    limit: str
    met: bool


#: A share of pixels or a ratio, and what it is of; None where this sensor cannot be judged by it.
_Found = tuple[float, str] | None


def criteria(data: ReportData) -> list[Criterion]:
    """Judge the sensor by each criterion that has a limit and can be judged."""
    found = []
    for setting, (measure, show) in _MEASURES.items():
        limit = getattr(data.criteria, setting)
        value = None if limit is None else measure(data)
        if value is not None:
            number, words = value
            found.append(Criterion(setting, words, show(number), f"≤ {show(limit)}", number <= limit))
    return found


def _read_noise(data: ReportData) -> _Found:
    if not data.has_values("read_noise_e"):
        return None
    median = data.summary("read_noise_e").median
    return (median, "median read noise") if np.isfinite(median) else None


def _failed(data: ReportData) -> _Found:
    status = data.fit.get("fit_status")
    if status is None:
        return None
    failed = ((status & data.failed_mask) != 0) | data.unfitted
    return float(failed[(status & int(FitStatus.EXCLUDED)) == 0].mean()), f"{data.noun}s without a value"


def _flagged(data: ReportData) -> _Found:
    return float(data.flagged.mean()), f"flagged {data.noun}s"


def _hot(data: ReportData) -> _Found:
    """Return the share of hot pixels; a flagged one is hot, too, whatever electrons it is open by."""
    if data.few_channels or not data.has_values("quanta_exposure"):
        return None
    values, flagged = data.maps["quanta_exposure"], data.flagged_in("quanta_exposure")
    if flagged[np.isfinite(values)].all():
        return None
    stderr = data.maps.get("quanta_exposure_stderr", np.zeros(data.shape))
    hot = hot_pixels(values, stderr, flagged, data.outlier_sigmas)
    return float(hot.sum() / np.isfinite(values).sum()), f"hot {data.noun}s"


def _outlying(data: ReportData) -> _Found:
    """Return the largest share of outliers in the maps of gain, bias and read noise."""
    if data.few_channels:
        return None
    shares = []
    for name in ("conversion_gain", "bias", "read_noise_e"):
        if data.has_values(name):
            summary = data.summary(name)
            share = (summary.n_low + summary.n_high) / max(summary.n_valid, 1)
            shares.append((share, f"outliers in {name.removesuffix('_e').replace('_', ' ')}"))
    return max(shares, default=None)


def _gain_spread(data: ReportData) -> _Found:
    """Return the spread of the gain between pixels over its median, without that of the pixels' errors."""
    if data.few_channels or not data.has_values("conversion_gain"):
        return None
    summary = data.summary("conversion_gain")
    if summary.n_valid < 2:
        return None
    own = data.pixel_error("conversion_gain") or 0.0
    spread = np.sqrt(max(summary.robust_sd**2 - own**2, 0.0))
    return float(spread / summary.median), "non-uniformity of the gain"


def _share(value: float) -> str:
    return percent(value, 1.0)


def _electrons(value: float) -> str:
    return f"{short(value, 3)} e⁻"


_MEASURES: dict[str, tuple[Callable[[ReportData], _Found], Callable[[float], str]]] = {
    "read_noise_e": (_read_noise, _electrons),
    "failed_pixels": (_failed, _share),
    "flagged_pixels": (_flagged, _share),
    "hot_pixels": (_hot, _share),
    "outlying_pixels": (_outlying, _share),
    "gain_nonuniformity": (_gain_spread, _share),
}
