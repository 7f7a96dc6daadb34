"""The outcome of a quick look: one check for each way in which samples may fail to be independent.

A check has a size in DN, in electrons and as a share of the read noise, its probability by chance among all
checks, and the size that would have been found for sure: without that a check that finds nothing says
nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

from pchem_pipeline.model.arithmetic.robust import look_elsewhere

if TYPE_CHECKING:
    from pchem_pipeline.effects.framework.effect import Effect

Level = Literal["good", "note", "caution", "serious"]

#: A check counts as failed when chance does as much, in any of the checks, with a smaller probability.
SIGNIFICANCE = 1e-3
#: Share of the read noise from which something is no mere remark, and from which it is serious: added in
#: quadrature a tenth is half a per cent of the read noise, a half is an eighth.
_SOME, _MUCH = 0.1, 0.5


@dataclass(frozen=True)
class Check:
    """One check.

    Attributes:
        name: row_noise, lag, ...
        title: what was looked for, as the subject of a sentence.
        p: probability of as much by chance, in this check alone.
        size: estimate; the root of a variance has no sign, and is 0 where the variance comes out negative.
        unit: of the size: DN, LSB, or 1 for correlations and shares.
        limit: size that is found in 19 of 20 runs like this one; NaN where that is not known.
        where: rows, columns, frames or codes that carry it, in words; empty for all.
        region: part of the sensor that it is in, as ``model.effects`` takes a region; None: everywhere alike.
        advice: what it does to the results, in words.
        level: how grave it is; "good" where it is not beyond chance.
        p_global: probability of as much by chance in any of the checks.
        in_model: whether the fitted model has an effect like it.
        size_e: the size in electrons, where it is in DN.
        share: of the read noise, where the size is in DN.
    """

    name: str
    title: str
    p: float
    size: float
    unit: str
    limit: float = math.nan
    where: str = ""
    region: dict[str, Any] | None = None
    advice: str = ""
    level: Level = "good"
    p_global: float = math.nan
    in_model: bool = False
    size_e: float = math.nan
    share: float = math.nan

    @property
    def found(self) -> bool:
        """Whether it is beyond chance."""
        return self.p_global < SIGNIFICANCE


_IN_NOISE = "it is in the noise of each pixel and does not average out over pixels"
_GAIN = "the gain, e⁻/DN, reads {} by about"
_COUPLE = f"if neighbours couple, {_GAIN} twice the correlation"
#: Of each check the unit of its size, what was looked for, and what it does to the results.
_WORDS: dict[str, tuple[str, str, str]] = {
    "levels": ("DN", "the frames are of several exposures", "make a run of each, from its own files or by "
               "input.frame_range, and fit them together with pchem joint"),
    "odd_frames": ("1", "frames stand out", "the fit has them: leave them out {}"),
    "empty_frames": ("1", "frames are empty", "they are not counted"),
    "repeated_frames": ("1", "frames equal an earlier one",
                        "there are fewer samples than frames, and standard errors are too small"),
    "frame_noise": ("DN", "the pixels of a frame move together", _IN_NOISE),
    "row_noise": ("DN", "the pixels of a row move together", _IN_NOISE),
    "column_noise": ("DN", "the pixels of a column move together", _IN_NOISE),
    "drift": ("DN", "the mean of the frames drifts", "it widens the read noise, and what is taken for one "
              "exposure changes along the run"),
    "period": ("DN", "the mean of the frames has a period", "it widens the read noise"),
    "frame_lag": ("1", "the mean of a frame resembles that of the frame before",
                  "noise that the frames share has a memory"),
    "lag": ("1", "samples resemble those of the frame before",
            f"charge or signal is carried over: {_GAIN} as much"),
    "neighbours_x": ("1", "neighbours in a row resemble each other", _COUPLE),
    "neighbours_y": ("1", "neighbours in a column resemble each other", _COUPLE),
    "wandering_pixels": ("1", "pixels change their level along the run",
                         "their exposure and read noise are of several levels: a region that was moved, "
                         "a drift, or blinking pixels"),
    "local_drift": ("DN", "a part of the sensor drifts apart from the rest",
                    "it widens the read noise there"),
    "wave": ("DN", "a wave runs across the samples in the order of reading",
             "pickup: it widens the read noise; pchem discrepancy finds its frequency"),
    "codes": ("LSB", "codes have different widths",
              "the histograms of all pixels deviate from the model at the same DN"),
    "top_code": ("1", "samples pile up at the highest code",
                 "larger signals are cut off there: exposures of bright pixels come out too low"),
    "bottom_code": ("1", "samples pile up at the lowest code", "the black level is too low: raise it, or set "
                    "input.bit_depth"),
    "zero_code": ("1", "samples pile up at 0 DN", "the black level is too low: raise it. The fit counts "
                  "them as 0 DN or less, so values hold, with larger errors"),
}  # fmt: skip


def check_of(name: str, p: float, size: float, *, how: str = "", **rest: Any) -> Check:
    """Return a check with its words; ``how`` is what its advice leaves open."""
    unit, title, advice = _WORDS[name]
    return Check(name, title, p, size, unit, advice=advice.format(how), **rest)


@dataclass(frozen=True)
class QuickLook:
    """All checks of a run.

    Attributes:
        checks: in the order in which they were made.
        missing: parts that were not looked at, and why.
        samples: frames x pixels that the checks rest on.
        command: what looks closer.
    """

    checks: tuple[Check, ...]
    missing: dict[str, str] = field(default_factory=dict)
    samples: int = 0
    command: str = ""

    @property
    def found(self) -> tuple[Check, ...]:
        """Return the checks that are beyond chance, the gravest first."""
        order = ("serious", "caution", "note", "good")
        beyond = [check for check in self.checks if check.found]
        return tuple(sorted(beyond, key=lambda check: (order.index(check.level), check.p)))

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain data for JSON; what is not known is NaN."""
        return {
            "checks": [{**asdict(check), "found": check.found} for check in self.checks],
            "missing": dict(self.missing),
            "samples": self.samples,
            "significance": SIGNIFICANCE,
            "command": self.command,
        }


#: The statistics of a closer look (names of its catalogue) that show what a check finds: an effect of the
#: model in whose signature one of them is explains it.
_SIGNS: dict[str, tuple[str, ...]] = {
    "frame_noise": (
        "frame.readout.variance", "frame.readout.slow", "frame.readout.trend",
        "frame.charge.variance", "frame.charge.slow", "frame.charge.trend", "frame.covariance",
    ),
    "levels": ("frame.charge.variance", "frame.charge.slow", "frame.charge.trend"),
    "row_noise": ("space.row.readout.variance",),
    "column_noise": ("space.column.readout.variance",),
    "drift": (
        "frame.readout.slow", "frame.readout.trend", "frame.charge.slow", "frame.charge.trend",
        "frame.gain.slow", "frame.gain.trend",
    ),
    "local_drift": (
        "frame.readout.trend", "frame.readout.quadrants", "frame.charge.trend", "frame.charge.quadrants",
    ),
    "period": (
        "frame.readout.line", "frame.readout.alternating", "frame.charge.line", "space.row.readout.line",
    ),
    "frame_lag": (
        "frame.readout.lag1", "frame.charge.lag1", "time.lag1.readout.mean", "time.cross.readout_charge",
    ),
    "lag": (
        "time.lag1.readout.mean", "time.lag1.charge.mean", "time.cross.readout_charge", "frame.repeated",
    ),
    "neighbours_x": (
        "space.x.kk", "space.x.rk", "space.x.bits", "space.row.readout.lag1", "tail.high.clusters",
    ),
    "neighbours_y": ("space.y.kk", "space.y.rk", "tail.high.clusters"),
    "wandering_pixels": (
        "time.block.charge.chi", "time.block.charge.cnt", "time.block.readout.chi", "time.block.readout.cnt",
    ),
    "repeated_frames": ("frame.repeated",),
    "codes": ("code.rough", "code.smooth"),
    "top_code": ("code.top",),
    "bottom_code": ("code.bottom",),
    "zero_code": ("code.bottom",),
    "wave": ("space.sample.readout.line", "space.sample.readout.spectrum"),
    "odd_frames": ("frame.readout.largest", "frame.readout.quadrants"),
    "empty_frames": (),
}  # fmt: skip


def graded(checks: list[Check], gain: float, read_noise: float, model: Sequence[Effect]) -> tuple[Check, ...]:
    """Return checks with their probability among all, their size in other units, and their level.

    Args:
        checks: those made.
        gain: of the median pixel, e-/DN.
        read_noise: of the median pixel, DN.
        model: the effects that the pixels were fitted with.
    """
    shown = {name for effect in model for name in effect.signature}
    found = []
    for check in checks:
        p_global = look_elsewhere(check.p, len(checks))
        in_dn = check.unit == "DN"
        done = replace(
            check,
            p_global=p_global,
            in_model=not shown.isdisjoint(_SIGNS[check.name]),
            size_e=check.size * gain if in_dn else math.nan,
            share=check.size / read_noise if in_dn else math.nan,
        )
        found.append(replace(done, level=_level(done)))
    return tuple(found)


#: Sizes from which a check is no mere remark, and from which it is serious, by its unit and name.
_LIMITS: dict[str, tuple[float, float]] = {
    "lag": (0.005, 0.05),
    "frame_lag": (math.inf, math.inf),
    "neighbours_x": (0.005, 0.05),
    "neighbours_y": (0.005, 0.05),
    "repeated_frames": (1e-3, 0.05),
    "wandering_pixels": (0.01, 0.2),
    "codes": (0.1, 0.5),
    "top_code": (1e-4, 1e-2),
    "bottom_code": (1e-4, 1e-2),
    "zero_code": (1e-4, 1.0),
    "odd_frames": (0.0, 0.01),
    "empty_frames": (0.01, 0.1),
}


def _level(check: Check) -> Level:
    if not check.found:
        return "good"
    if check.in_model:
        return "note"
    size = check.share if check.unit == "DN" else abs(check.size)
    some, much = (_SOME, _MUCH) if check.unit == "DN" else _LIMITS[check.name]
    if size >= much:
        return "serious"
    return "caution" if size >= some else "note"
