"""Where data and model disagree: statistics that deviate, and the pixels, DN and frames that carry them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import special

from pchem_pipeline.discrepancy.null import NullModel, look_elsewhere
from pchem_pipeline.discrepancy.verdict import Place
from pchem_pipeline.effects.framework.evidence import Evidence, TimeSeries

__all__ = ["locate"]

FloatArray = NDArray[np.float64]

_FALSE_DISCOVERY_RATE = 0.05
_MOST_LISTED = 50
_MOST_PLACES = 20
_WIDEST_CODE_WINDOW = 24


def locate(evidence: Evidence, null: NullModel, z: FloatArray, significance: float) -> list[Place]:
    """Return the disagreements that are significant among all statistics, the largest first.

    Args:
        evidence: of the train split.
        null: of the model.
        z: mean of the statistics of the train and test splits, shape (m,).
        significance: largest probability of a chance.
    """
    pulls, p_values = null.pulls(z, splits=2), null.p_values(z, splits=2)
    places = []
    for index in np.argsort(-np.abs(pulls))[:_MOST_PLACES]:
        p = look_elsewhere(float(p_values[index]), null.effective_tests)
        if p > significance:
            break
        name = null.names[index]
        places.append(
            Place.of(
                name,
                z=float(pulls[index]),
                p=p,
                pixels=_pixels(name, evidence),
                dn=_codes(name, evidence),
                frames=_frames(name, evidence),
            )
        )
    return places


def _pixels(name: str, evidence: Evidence) -> tuple[tuple[int, int], ...]:
    """Return the pixels that stand out in the map behind a statistic (Benjamini-Hochberg)."""
    values = _pixel_map(name, evidence)
    if values is None:
        return ()
    deviations = np.abs(np.where(evidence.maps.usable, values, 0.0)).ravel()
    p = 2.0 * special.ndtr(-deviations)
    order = np.argsort(p, kind="stable")
    allowed = _FALSE_DISCOVERY_RATE * np.arange(1, p.size + 1) / max(int(evidence.maps.usable.sum()), 1)
    passed = np.flatnonzero(p[order] <= allowed)
    count = min(int(passed[-1]) + 1, _MOST_LISTED) if passed.size else 0
    return tuple((int(i) // values.shape[1], int(i) % values.shape[1]) for i in order[:count])


def _pixel_map(name: str, evidence: Evidence) -> NDArray[np.floating] | None:
    """Return a map of about standard normal deviations behind a statistic of few pixels."""
    parts = name.split(".")
    if parts[-1] not in ("cnt", "chi", "pixels", "count"):
        return None
    time = evidence.time
    if parts[0] == "shape":
        return evidence.goodness if parts[1] == "goodness" else evidence.scores[parts[1]]
    if parts[0] == "tail":
        counts = evidence.tail_low if parts[1] == "low" else evidence.tail_high
        return 6.0 * np.asarray(counts > 0, np.float64)
    if parts[0] == "time" and time is not None:
        if parts[1] == "lag1":
            lag = time.lag_charge if parts[2] == "charge" else time.lag_readout
            return np.asarray(lag[0] * np.sqrt(time.n_pairs))
        blocks, std = (
            (time.block_charge, evidence.charge_std)
            if parts[2] == "charge"
            else (time.block_readout, evidence.readout_std)
        )
        n = blocks.shape[0]
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = blocks.var(axis=0, ddof=1) * time.block_frames / std**2
        return np.asarray((ratio - 1.0) * np.sqrt((n - 1) / 2.0))
    return None


def _codes(name: str, evidence: Evidence) -> tuple[int, int] | None:
    """Return the window of DN that stands out most, of any width."""
    if not name.startswith("code."):
        return None
    code = evidence.code
    if name == "code.top":
        return (code.maximum, code.maximum)
    if name == "code.bottom":
        return (code.minimum, code.minimum)
    expected = np.maximum(code.expected, 1.0)
    deviation = (code.observed - code.expected) / np.sqrt(expected)
    total = np.concatenate([[0.0], np.cumsum(deviation)])
    best, window = 0.0, (0, 1)
    for width in range(1, min(_WIDEST_CODE_WINDOW, deviation.size) + 1):
        sums = np.abs(total[width:] - total[:-width]) / np.sqrt(width)
        start = int(np.argmax(sums))
        if sums[start] > best:
            best, window = float(sums[start]), (start, start + width)
    return (code.first + window[0], code.first + window[1] - 1)


def _frames(name: str, evidence: Evidence) -> tuple[int, ...]:
    """Return the frames that carry a statistic."""
    time = evidence.time
    if time is None:
        return ()
    if name == "frame.repeated":
        return tuple(int(f) for f in time.repeated[:_MOST_LISTED])
    if name.startswith("tail.high") and time.hits.size:
        return tuple(int(f) for f in np.unique(time.hits[:, 0])[:_MOST_LISTED])
    if name.endswith(".largest"):
        series = _series(name, time)
        spread = 1.4826 * np.median(np.abs(series - np.median(series)))
        order = np.argsort(-np.abs(series - np.median(series)))
        outlying = [i for i in order if abs(series[i] - np.median(series)) > 5.0 * spread]
        return tuple(sorted(int(time.frames[i]) for i in (outlying or order[:1])[:_MOST_LISTED]))
    return ()


def _series(name: str, time: TimeSeries) -> FloatArray:
    return time.frame_charge if ".charge." in name else time.frame_readout
