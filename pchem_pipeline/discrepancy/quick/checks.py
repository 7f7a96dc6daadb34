"""The results of a quick look: one check for each way in which samples may fail to be independent.

A check has a size in DN, in electrons and as a share of the read noise, its p-value among all checks, and its
detection limit.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from pchem_pipeline.model.arithmetic.significance import SIGNIFICANCE
from pchem_pipeline.model.arithmetic.statistics import look_elsewhere

if TYPE_CHECKING:
    from pchem_pipeline.effects.framework.effect import Effect

Level = Literal["good", "note", "caution", "serious"]
GRAVEST_FIRST: tuple[Level, ...] = ("serious", "caution", "note", "good")


@dataclass(frozen=True)
class Check:
    """One check."""

    name: str  # row_noise, lag, ..
    title: str  # the disturbance, a noun
    p: float  # p-value of this check alone
    size: float  # estimate; the root of a variance is 0 if the variance is negative
    unit: str  # unit of the size: DN, LSB, or 1 for correlations and shares
    limit: float = math.nan  # size found in 19 of 20 runs like this one; NaN if unknown
    where: str = ""  # rows, columns, frames or codes concerned, in words; empty for all
    region: dict[str, Any] | None = None  # part of the sensor, as in ``model.effects``; None: uniform
    advice: str = ""  # consequence for the results, and the cure
    level: Level = "good"  # severity; "good" if not significant
    p_global: float = math.nan  # p-value corrected for the number of checks
    in_model: bool = False  # whether the fitted model has such an effect
    size_e: float = math.nan  # the size in electrons, if it is in DN
    share: float = math.nan  # the size over the read noise, if it is in DN

    @property
    def found(self) -> bool:
        """Whether it is significant."""
        return self.p_global < SIGNIFICANCE


class _Kind(NamedTuple):
    """What is said of a check, and what explains it.

    Attributes:
        signs: statistics of the catalogue that show the same: an effect with one of them in its signature
            explains the check.
        limits: sizes (of those in DN shares of the read noise) from which it deserves caution, and from which
            it is serious: in quadrature a tenth adds half a per cent to the read noise, a half an eighth.
        map: of the sensor that shows where it fails; empty: none.
    """

    unit: str
    title: str
    advice: str
    signs: str = ""
    limits: tuple[float, float] = (0.1, 0.5)
    map: str = ""


_IN_NOISE = "included in each pixel's read noise, not reduced by averaging along a"
_GAIN = "gain (e⁻/DN) is too {} by about"
_COUPLE = f"if neighbours share charge, {_GAIN} twice this share"
#: All checks by name.
KINDS: dict[str, _Kind] = {
    "levels": _Kind("DN", "frames of several exposures", "make one run per exposure (own files, or "
                    "input.frame_range) and fit them jointly (pchem joint)",
                    r"frame\.charge\.(variance|slow|trend)"),
    "odd_frames": _Kind("1", "outlying frames", "included in the fit; leave them out {}",
                        r"frame\.readout\.(largest|quadrants)", (0.0, 0.01)),
    "empty_frames": _Kind("1", "empty frames", "left out", limits=(0.01, 1.0)),
    "repeated_frames": _Kind("1", "repeated frames", "left out, as exact copies of earlier frames; check the "
                             "camera's link", r"frame\.repeated", (1e-3, 1.0)),
    "moved_frames": _Kind("1", "moved frames", "included in the fit; leave them out {}", limits=(0.0, 0.01)),
    "frame_noise": _Kind("DN", "frame noise", f"{_IN_NOISE} frame",
                         r"frame\.(readout|charge)\.(variance|slow|trend)|frame\.covariance", map="next_x"),
    "row_noise": _Kind("DN", "row noise", f"{_IN_NOISE} row", r"space\.row\.readout\.variance",
                       map="next_x"),
    "column_noise": _Kind("DN", "column noise", f"{_IN_NOISE} column", r"space\.column\.readout\.variance",
                          map="next_y"),
    "drift": _Kind("DN", "drift of the frame mean", "adds to the read noise; the exposure may drift",
                   r"frame\.(readout|charge|gain)\.(slow|trend)", map="spread"),
    "period": _Kind("DN", "periodic frame mean", "adds to the read noise",
                    r"frame\.(readout|charge)\.line|frame\.readout\.alternating|space\.row\.readout\.line"),
    "frame_lag": _Kind("1", "correlation of successive frame means", "frame noise is not white",
                       r"frame\.(readout|charge)\.lag1|time\.lag1\.readout\.mean|time\.cross\.readout_charge",
                       (math.inf, math.inf)),
    "lag": _Kind("1", "correlation of successive samples",
                 f"charge or signal is carried over: {_GAIN} this share",
                 r"time\.lag1\.(readout|charge)\.mean|time\.cross\.readout_charge|frame\.repeated",
                 (0.005, 0.05), "lag"),
    "neighbours_x": _Kind("1", "correlation of neighbours in a row", _COUPLE,
                          r"space\.x\.(kk|rk|bits)|space\.row\.readout\.lag1|tail\.high\.clusters",
                          (0.005, 0.05), "next_x"),
    "neighbours_y": _Kind("1", "correlation of neighbours in a column", _COUPLE,
                          r"space\.y\.(kk|rk)|tail\.high\.clusters", (0.005, 0.05), "next_y"),
    "wandering_pixels": _Kind("1", "pixels with a changing level",
                              "exposure and read noise are averages over these levels; check for a moved "
                              "sensor, a drift, or blinking pixels",
                              r"time\.block\.(charge|readout)\.(chi|cnt)", (0.01, 0.2)),
    "local_drift": _Kind("DN", "drift of a part of the sensor", "adds to the read noise there",
                         r"frame\.(readout|charge)\.(trend|quadrants)"),
    "wave": _Kind("DN", "pickup or periodic noise", "adds to the read noise{}",
                  r"space\.sample\.readout\.(line|spectrum)"),
    "codes": _Kind("LSB", "unequal code widths (DNL)",
                   "the histograms of all pixels deviate from the model at the same DN",
                   r"code\.(rough|smooth)", (0.1, 0.5)),
    "top_code": _Kind("1", "saturation", "larger signals are cut off there: lower the exposure. The fit does "
                      "not know this limit: set input.bit_depth, or add the effect clipping with this high "
                      "to model.effects", r"code\.top", (1e-4, 1e-2)),
    "top_limit": _Kind("1", "saturation", "larger signals are cut off there: lower the exposure. The fit "
                       "treats these samples as {} or more, so values are right, with larger errors",
                       r"code\.top", (1e-4, 1.0)),
    "bottom_code": _Kind("1", "clipping at the lowest code", "values are cut off there: raise the black "
                         "level. If the camera clips, add the effect clipping with this low to model.effects",
                         r"code\.bottom", (1e-4, 1e-2)),
    "bottom_limit": _Kind("1", "clipping at the lowest code", "the black level is too low: raise it. The fit "
                          "treats these samples as {} or less, so values are right, with larger errors",
                          r"code\.bottom", (1e-4, 1.0)),
}  # fmt: skip


def check_of(name: str, p: float, size: float, *, how: str = "", **rest: Any) -> Check:
    """Make a check with its title and advice; ``how`` fills the gap in the advice."""
    kind = KINDS[name]
    return Check(name, kind.title, p, size, kind.unit, advice=kind.advice.format(how), **rest)


@dataclass(frozen=True)
class QuickLook:
    """All checks of a run, in the order in which they were made."""

    checks: tuple[Check, ...]
    missing: dict[str, str] = field(default_factory=dict)  # checks that were not made, and why
    samples: int = 0  # frames x pixels of the checks
    command: str = ""  # command for a full search

    @property
    def found(self) -> tuple[Check, ...]:
        """Return the significant checks, the most severe first."""
        beyond = [check for check in self.checks if check.found]
        return tuple(sorted(beyond, key=lambda check: (GRAVEST_FIRST.index(check.level), check.p)))

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON; unknown numbers are NaN."""
        return {
            "checks": [{**asdict(check), "found": check.found} for check in self.checks],
            "missing": dict(self.missing),
            "samples": self.samples,
            "significance": SIGNIFICANCE,
            "command": self.command,
        }


def graded(checks: list[Check], gain: float, read_noise: float, model: Sequence[Effect]) -> tuple[Check, ...]:
    """Compute p-values corrected for the number of checks (Sidak), sizes in e- and read noises, and levels.

    Given are the median gain, e-/DN, the median read noise, DN, and the effects of the fitted model.
    """
    shown = {name for effect in model for name in effect.signature}
    found = [
        replace(
            check,
            p_global=look_elsewhere(check.p, len(checks)),
            in_model=any(re.fullmatch(KINDS[check.name].signs, name) for name in shown),
            size_e=check.size * gain if check.unit == "DN" else math.nan,
            share=check.size / read_noise if check.unit == "DN" else math.nan,
        )
        for check in checks
    ]
    return tuple(replace(check, level=_level(check)) for check in found)


def _level(check: Check) -> Level:
    if not check.found:
        return "good"
    size = check.share if check.unit == "DN" else abs(check.size)
    some, much = KINDS[check.name].limits
    if check.in_model or not size >= some:
        return "note"
    return "serious" if size >= much else "caution"
