"""The results of a run in the words of EMVA 1288, each with how its definition differs from that one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import Arrays, FloatArray
from pchem_pipeline.base.wording import count, measured, short, unit_text
from pchem_pipeline.model.fit.status import FAILED, FLAGGED
from pchem_pipeline.model.maps.defects import FAULTS, Defects
from pchem_pipeline.report.data import ReportData, Samples
from pchem_pipeline.report.pages.tables import Table


@dataclass(frozen=True)
class EmvaRow:
    """A quantity of EMVA 1288; ``value`` is None if this run does not determine it."""

    quantity: str
    symbol: str
    value: float | None
    standard_error: float | None
    unit: str
    definition_here: str
    where_it_differs: str

    @property
    def text(self) -> str:
        """The value with its standard error and unit, for a reader."""
        if self.value is None or not np.isfinite(self.value):
            return "not determined"
        unit = unit_text(self.unit)
        if self.standard_error is None:
            return f"{short(self.value, 2)} {unit}"
        return measured(self.value, self.standard_error, unit)

    def cells(self) -> list[str]:
        """Return the row as text; what is not known is empty."""
        return [
            each if isinstance(each, str) else "" if each is None or not np.isfinite(each) else f"{each:.6g}"
            for each in astuple(self)
        ]


COLUMNS = tuple(field.name for field in fields(EmvaRow))


def emva_tables(data: ReportData) -> list[Table]:
    """Return the table of the report; of a line of channels or without values there is none."""
    names = ("quanta_exposure", "conversion_gain", "bias", "read_noise_dn", "read_noise_e")
    defects, known = data.defects, all(map(data.has_values, names))
    if data.shape[0] == 1 or data.mostly_flagged or defects is None or not known:
        return []
    rows = [
        {
            "quantity": row.quantity,
            "symbol": row.symbol,
            "value": row.text,
            "definition here": row.definition_here,
            "difference to EMVA 1288": row.where_it_differs,
        }
        for row in emva_rows(
            data.maps, data.status, data.kind, defects, data.outlier_sigmas, samples=data.samples
        )
    ]
    words = f"Flagged {data.noun}s are excluded. As a file: pchem export {data.typed_run} --format emva"
    return [Table("emva1288", "Data sheet quantities of EMVA 1288", words, rows, "emva")]


def emva_rows(
    stored: Arrays,
    status: NDArray[Any],
    kind: str,
    defects: Defects,
    outlier_sigmas: float = 6.0,
    samples: Samples | None = None,
) -> list[EmvaRow]:
    """Return the table of a run; pixels without a value and flagged ones are left out.

    Maps, their standard errors and the status words of the fit are (y, x). ``kind`` is what made the charge:
    dark, light or unknown; hot pixels are ``outlier_sigmas`` robust standard deviations above the median H.
    """
    kept = (status & int(FAILED | FLAGGED)) == 0

    def of(name: str, pixels: NDArray[Any] = kept) -> FloatArray:
        values = stored[name][pixels] if name in stored else np.empty(0)
        return values if values.size else np.full(1, np.nan)

    def prnu(name: str, symbol: str, what: str, differs: str) -> EmvaRow:
        faultless = kept & ((defects.kinds & int(FAULTS)) == 0)
        return EmvaRow(
            "photo response non-uniformity", symbol,
            *_relative_spread(of(name, faultless), of(f"{name}_stderr", faultless)), "%",
            f"standard deviation of {what} between the pixels over its mean, corrected for errors; "
            f"{count(int((kept & ~faultless).sum()), 'pixel')} with defects left out",
            differs,
        )  # fmt: skip

    gain, exposure = of("conversion_gain"), stored["quanta_exposure"]
    hot = defects.counts().get("hot", 0) / max(int(np.isfinite(exposure).sum()), 1)
    rows = [
        EmvaRow(
            "overall system gain", "K", *_mean(1.0 / gain), "DN/e-", "mean over the pixels of 1/g",
            "EMVA: one slope of temporal variance over mean for the whole sensor, above dark",
        ),
        EmvaRow(
            "temporal dark noise", "sigma_d", *_root_mean_square(of("read_noise_e")), "e-",
            "root mean square over the pixels of the read noise sigma g, quantisation included",
            "EMVA: from dark frames, including shot noise of the dark current; excluded here",
        ),
        EmvaRow(
            "temporal dark noise", "sigma_y.dark", *_root_mean_square(of("read_noise_dn")), "DN",
            "root mean square over the pixels of sigma, quantisation included", "as above",
        ),
        _dsnu(of, kind),
        prnu(
            "quanta_exposure" if kind == "light" else "", "PRNU_1288 (similar)", "H (input.kind: light)",
            "EMVA: at half saturation, dark subtracted, trends of the illumination filtered out; not done "
            "here",
        ),
        EmvaRow(
            "non-uniformity of the gain", "", *_relative_spread(gain, of("conversion_gain_stderr")), "%",
            "standard deviation of g between the pixels over its mean, corrected for their errors",
            "not in EMVA: K is one number for the sensor; PRNU combines gain and sensitivity",
        ),
        EmvaRow(
            "dark current from mean", "mu_I.mean", *_mean(of("dark_current" if kind == "dark" else "")),
            "e-/px/s", "mean over the pixels of H / integration time (input.kind: dark), or of its slope",
            "EMVA: slope of the mean dark signal over six or more exposure times",
        ),
        EmvaRow(
            "hot pixels", "", 100.0 * hot if kept.any() else np.nan, None, "%",
            f"pixels whose H is above the median by more than {outlier_sigmas:g} robust standard deviations",
            "EMVA: the application sets the limit of defect pixels, on the logarithmic histogram",
        ),
    ]  # fmt: skip
    missing = [("not determined", f"needs {x}") for x in ("calibrated light", "exposures up to saturation")]
    rows += [
        EmvaRow("quantum efficiency", "eta", None, None, "%", *missing[0]),
        EmvaRow("absolute sensitivity threshold", "mu_p.min", None, None, "photons", *missing[0]),
        EmvaRow("saturation capacity", "mu_e.sat", None, None, "e-", *missing[1]),
        EmvaRow("dynamic range", "DR", None, None, "", *missing[1]),
    ]
    ladder = [] if samples is None else _ladder_rows(samples, kept, of, prnu)
    measured_there = {row.symbol for row in ladder}
    return [row for row in rows if row.symbol.removesuffix(" (similar)") not in measured_there] + ladder


def _ladder_rows(
    samples: Samples, kept: NDArray[Any], of: Callable[[str], FloatArray], prnu: Callable[..., EmvaRow]
) -> list[EmvaRow]:
    """Return what exposures at several light levels or integration times determine."""
    lit = [i for i in samples.on_line if samples.samples[i].kind == "exposed"]
    if not lit or not kept.any():
        return []
    exposure, left = (
        samples.arrays[name][lit][:, kept] for name in ("quanta_exposure", "linearity_residual")
    )
    brightest = exposure[np.argmax(np.nanmean(exposure, axis=1))]
    ratio = brightest / np.sqrt(brightest + of("read_noise_e") ** 2)
    signal, floor = _mean(brightest), _root_mean_square(of("read_noise_e"))
    rows = [
        EmvaRow(
            "signal-to-noise ratio at the largest exposure", "SNR", *_mean(ratio), "",
            "mean over the pixels of H / sqrt(H + read noise^2)",
            "EMVA: SNR_max at saturation; here at the largest exposure that was measured",
        ),
        EmvaRow(
            "dynamic range, at least", "DR", signal[0] / floor[0],
            signal[0] / floor[0] * float(np.hypot(signal[1] / signal[0], floor[1] / floor[0])), "",
            "mean H of the largest exposure over the temporal dark noise",
            "EMVA: from the saturation to the absolute sensitivity threshold",
        ),
    ]  # fmt: skip
    if len(lit) > 2:
        on_line, means = np.nanmean(exposure - left, axis=1), [_mean(row) for row in left]
        deviation, error = np.array(means).T / on_line
        rows.append(
            EmvaRow(
                "linearity error", "LE", 100.0 * float(np.abs(deviation).mean()),
                100.0 * float(np.sqrt(np.sum(error**2))) / len(lit), "%",
                "mean of |deviation| of the mean H of each exposure from the line, relative to the line",
                "EMVA: of the mean grey value, between 5 and 95 % of saturation",
            )
        )  # fmt: skip
    slope = next((name for name in ("charge_per_level", "charge_rate") if np.isfinite(of(name)).any()), None)
    if slope is not None:
        rows.append(
            prnu(
                slope, "PRNU_1288", "the slope of H",
                "EMVA: at half saturation, trends of the illumination filtered out; not done here",
            )
        )  # fmt: skip
    return rows


def _mean(values: FloatArray) -> tuple[float, float]:
    error = float(values.std(ddof=1) / np.sqrt(values.size)) if values.size > 1 else np.nan
    return float(values.mean()), error


def _root_mean_square(values: FloatArray) -> tuple[float, float]:
    square, error = _mean(values**2)
    return float(np.sqrt(square)), float(error / (2.0 * np.sqrt(square)))


def _spread(values: FloatArray, variance: FloatArray) -> tuple[float, float]:
    """Return the standard deviation between pixels without their own variance, and its standard error."""
    if values.size < 2:
        return np.nan, np.nan
    whole = float(values.var(ddof=1))
    own = max(whole - float(np.mean(variance)), 0.0)
    square = (values - values.mean()) ** 2
    fourth = float(np.mean(square * square))
    error = np.sqrt(max(fourth - whole**2, 0.0) / values.size)
    return float(np.sqrt(own)), float(error / (2.0 * np.sqrt(own))) if own > 0 else np.nan


def _relative_spread(values: FloatArray, stderr: FloatArray) -> tuple[float, float]:
    spread, error = _spread(values, stderr**2)
    scale = 100.0 / float(values.mean())
    return spread * scale, error * scale


def _dsnu(of: Callable[[str], FloatArray], kind: str) -> EmvaRow:
    gain = float(np.median(of("conversion_gain")))
    if kind == "dark":
        mean = of("bias") + of("quanta_exposure") / of("conversion_gain")
        # the mean of the samples is known far better than bias and H are: its own error is left in
        value, error = _spread(mean * gain, np.zeros_like(mean))
        words = "standard deviation of mu + H/g between the pixels, in e- by the median g"
        differs = "EMVA subtracts the temporal noise of the mean; not subtracted here"
    else:
        value, error = _spread(of("bias") * gain, (of("bias_stderr") * gain) ** 2)
        words = (
            "standard deviation of the bias between the pixels, in e- by the median g, corrected for errors"
        )
        differs = (
            "EMVA: from dark frames, dark current included; here the bias alone (input.kind is not dark)"
        )
    return EmvaRow("dark signal non-uniformity", "DSNU_1288", value, error, "e-", words, differs)
