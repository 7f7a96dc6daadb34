"""The tables of a report, as plain rows of text."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pchem_pipeline.discrepancy.quick.checks import Check, QuickLook
from pchem_pipeline.model.maps.maps import summarise
from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.figures.ensemble import bias_remark
from pchem_pipeline.report.figures.maps import status_counts
from pchem_pipeline.report.figures.plan import frames_text, target_text
from pchem_pipeline.report.figures.samples import AXES, middle
from pchem_pipeline.report.figures.trust import noise_shares
from pchem_pipeline.report.pages.quick_look import check_title
from pchem_pipeline.report.pages.quick_look import size_text as check_size
from pchem_pipeline.report.pages.summary import summaries
from pchem_pipeline.report.style.ranges import finite
from pchem_pipeline.report.style.wording import (
    count,
    measured,
    percent,
    scientific,
    short,
    signed,
    symbol,
    unit_text,
)


@dataclass(frozen=True)
class Table:
    """A table: the first cell of each row is its heading; ``section`` is the id of the one that shows it."""

    id: str
    title: str
    caption: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    section: str = "tables"


def result_tables(data: ReportData) -> list[Table]:
    """Return the tables of results that the data allow."""
    makers = (
        _channels, _parameters, _flagged, _against_truth, _rmse, _moments, _electrons, _misfits, _intervals,
        _status, _samples, _plan, _quick_look,
    )  # fmt: skip
    return [table for make in makers if (table := make(data)).rows]


def _quick_look(data: ReportData) -> Table:
    look = data.quick_look or QuickLook(())
    rows = tuple(
        (
            check_title(check),
            ("in the model" if check.in_model else "yes") if check.found else "no",
            check_size(check) if check.found else "",
            _limit_text(check),
            _chance_text(check.p_global),
            check.where if check.found else "",
        )
        for check in look.checks
    )
    missing = "".join(f" Not tested: {part} ({why})." for part, why in look.missing.items())
    return Table(
        "quick-look",
        "Quick look",
        "Under the model, samples of different pixels and frames are independent. This is tested for all "
        f"pixels from sums that every run keeps; p-values are corrected for the number of checks.{missing}",
        ("check", "found", "size", "detection limit", "p-value", "where"),
        rows,
        "discrepancy",
    )


def _limit_text(check: Check) -> str:
    if not math.isfinite(check.limit):
        return "not known"
    return f"{short(check.limit, 2)}{f' {check.unit}' if check.unit != '1' else ''}"


def _chance_text(p: float) -> str:
    return "< 10⁻⁶" if p < 1e-6 else short(p, 2) if p > 1e-3 else scientific(p, 1)


def _parameters(data: ReportData) -> Table:
    rows = []
    found = summaries(data)
    for name, summary in ((name, found[name]) for name in _ORDER if data.has_values(name)):
        _, words, unit = symbol(name)
        error = data.pixel_error(name)
        values = [short(summary.percentiles[p], 4) for p in data.percentiles]
        rows.append(
            (
                f"{words} ({unit})",
                measured(summary.median, summary.median_stderr),
                short(summary.robust_sd),
                "not known" if error is None else short(error, 2),
                *values,
                f"{summary.n_low + summary.n_high:,}",
                f"{summary.n_valid:,}",
            )
        )
    return Table(
        "parameters",
        "Parameters",
        f"Median over the {data.noun}s with its standard error, robust standard deviation between "
        f"{data.noun}s (1.4826 MAD), median 1 sigma error per {data.noun}, percentiles, and outliers beyond "
        f"{data.outlier_sigmas:g} robust standard deviations.{_left_out(data)}",
        (
            "parameter",
            "median",
            "spread",
            f"error per {data.noun}",
            *(f"{p:g} %" for p in data.percentiles),
            "outliers",
            "pixels",
        ),
        tuple(rows),
    )


def _left_out(data: ReportData) -> str:
    flagged = int(data.flagged.sum())
    return f" {count(flagged, f'flagged {data.noun}')} excluded (see the table below)." if flagged else ""


def _flagged(data: ReportData) -> Table:
    """Return what flagged pixels read; their errors are no errors and are not shown."""
    rows = []
    for name in _ORDER if data.any_flagged else ():
        if not data.has_values(name):
            continue
        flagged = data.flagged_in(name)
        if not flagged.any():
            continue
        summary = summarise(data.maps[name][flagged], percentiles=(5.0, 95.0))
        _, words, unit = symbol(name)
        numbers = (summary.median, *summary.percentiles.values(), summary.minimum, summary.maximum)
        rows.append((f"{words} ({unit})", *(short(number, 4) for number in numbers), f"{summary.n_valid:,}"))
    return Table(
        "flagged",
        f"Flagged {data.noun}s",
        "The data do not fix these values: they can be off by an electron or more, far beyond their standard "
        "errors. Excluded from the other tables.",
        ("parameter", "median", "5 %", "95 %", "smallest", "largest", f"{data.noun}s"),
        tuple(rows),
    )


#: More channels than these are in the maps of the store only.
_MOST_CHANNELS = 100


def _channels(data: ReportData) -> Table:
    names = [name for name in _ORDER if data.has_values(name)]
    rows = []
    if data.shape[0] == 1 and data.shape[1] <= _MOST_CHANNELS:
        status = np.ravel(data.fit.get("fit_status", np.zeros(data.shape, dtype=np.uint16)))
        for x in range(data.shape[1]):
            label = data.channel_names[x] if x < len(data.channel_names) else ""
            values = []
            for name in names:
                stderr = data.maps.get(f"{name}_stderr")
                error = float(stderr[0, x]) if stderr is not None else float("nan")
                values.append(measured(float(data.maps[name][0, x]), error))
            words = "; ".join(text for bit, text in data.status_words.items() if int(status[x]) & bit)
            rows.append((f"{x} {label}".strip(), *values, words or "good fit"))
    head = tuple(f"{symbol(name)[1]} ({symbol(name)[2]})" for name in names)
    return Table(
        "channels",
        "Channels",
        "Estimates with their standard errors.",
        ("channel", *head, "fit status"),
        tuple(rows),
    )


_ORDER = (
    "quanta_exposure",
    "charge_rate",
    "dark_current",
    "charge_per_level",
    "spurious_charge",
    "dark_signal",
    "conversion_gain",
    "bias",
    "read_noise_dn",
    "read_noise_e",
    "analog_read_noise_e",
)


def _against_truth(data: ReportData) -> Table:
    rows = []
    for name, truth in data.truth.items():
        if name not in data.maps:
            continue
        estimate = np.where(data.flagged_in(name), np.nan, data.maps[name])
        error = estimate - truth
        known = finite(error)
        if known.size == 0:
            continue
        pull = finite(error / data.maps[f"{name}_stderr"]) if f"{name}_stderr" in data.maps else np.empty(0)
        _, words, unit = symbol(name)
        rows.append(
            (
                f"{words} ({unit})",
                short(float(np.median(truth[np.isfinite(error)])), 4),
                short(float(np.median(finite(estimate))), 4),
                short(float(np.sqrt(np.mean(known**2)))),
                measured(float(pull.mean()), float(1 / np.sqrt(pull.size))) if pull.size else "not known",
                measured(float(pull.std()), float(1 / np.sqrt(2 * pull.size))) if pull.size else "not known",
            )
        )
    return Table(
        "truth",
        "Estimates against the truth",
        "Simulated data only. Pull: (estimate − truth) / standard error; mean 0 and standard deviation 1 if "
        f"estimates are unbiased and errors correct.{_left_out(data)}",
        ("parameter", "true median", "estimated median", "RMSE", "mean pull", "sd of pulls"),
        tuple(rows),
    )


_RMSE_ROWS = (
    ("epcd_exact", "raw, exact mean over pixels", "noise_floor"),
    ("epcd_dependent", "raw, dependent parameters", "noise_floor"),
    ("epcd_independent", "raw, independent parameters", "noise_floor"),
    ("nuced_exact", "NUCed, exact mean over pixels", "nuced_noise_floor"),
    ("nuced_dependent", "NUCed, dependent parameters", "nuced_noise_floor"),
    ("nuced_independent", "NUCed, independent parameters", "nuced_noise_floor"),
)


def rmse_words(name: str) -> str:
    """Return what a prediction of the ensemble is called, or the sampling noise beside it."""
    words = {row[0]: row[1] for row in _RMSE_ROWS}
    floors = {"noise_floor": "raw, sampling noise alone", "nuced_noise_floor": "NUCed, sampling noise alone"}
    return {**words, **floors}.get(name, name.replace("_", " "))


def rmse_unit(name: str) -> str:
    """Return the unit of the densities of an ensemble, raw or after correction."""
    return "1/e⁻" if name.startswith("nuced") else "1/DN"


def _rmse(data: ReportData) -> Table:
    rmse: Mapping[str, float] = data.ensemble_facts.get("rmse", {})
    rows = []
    for name, words, floor_name in _RMSE_ROWS:
        if rmse.get(name) is None:
            continue
        floor = rmse.get(floor_name)
        unit = rmse_unit(name)
        rows.append(
            (
                words,
                f"{scientific(rmse[name], 3)} {unit}",
                f"{scientific(floor, 3)} {unit}" if floor else "not known",
                short(rmse[name] / floor) if floor else "not known",
            )
        )
    return Table(
        "rmse",
        "Ensemble prediction against data",
        "Root mean square difference of densities, and its expectation from sampling noise alone.",
        ("prediction", "RMSE", "sampling noise", "ratio"),
        tuple(rows),
        section="ensemble",
    )


def _moments(data: ReportData) -> Table:
    rows = []
    for row in data.moments:
        unit = unit_text(str(row.get("unit", "")))
        observed, error = row.get("observed"), row.get("stderr")
        predicted = float(row["predicted"])
        if observed is None:
            expected, seen, difference = short(predicted), "", ""
        elif error:
            # to the digits of the data that it is compared with
            expected = measured(predicted, float(error)).partition(" ±")[0]
            seen = measured(float(observed), float(error))
            difference = signed((float(observed) - predicted) / float(error))
        else:
            expected, seen, difference = short(predicted, 5), short(float(observed), 5), ""
        rows.append(
            (
                f"{row['quantity']} ({unit})" if unit else str(row["quantity"]),
                expected,
                seen,
                difference,
            )
        )
    return Table(
        "moments",
        "Moments of the ensemble",
        "From the parameter maps (Hendrickson et al. 2023, Appendix A) and from the data with their "
        f"standard error.{_of_bias(data)}",
        ("moment", "from the maps", "from the data", "difference / standard error"),
        tuple(rows),
        section="ensemble",
    )


def _of_bias(data: ReportData) -> str:
    remark = bias_remark(data)
    return f" Variance of the bias:{remark}" if remark else ""


#: Larger electron numbers are in ``report.json`` only.
_MOST_NUMBERS = 24


def _electrons(data: ReportData) -> Table:
    arrays, facts = data.ensemble, data.ensemble_facts
    if "electron_mass" not in arrays:
        return Table("electron-table", "", "", (), ())
    k = np.asarray(arrays["k"])
    mass, pmf = np.asarray(arrays["electron_mass"]), np.asarray(arrays["electron_pmf"])
    expected = np.asarray(arrays["electron_pmf_map"]) if "electron_pmf_map" in arrays else None
    seen = np.flatnonzero(mass > 1e-3)
    last = int(seen[-1]) if seen.size else 0
    samples = float(np.sum(arrays["electron_counts"])) if "electron_counts" in arrays else 0.0
    errors = np.sqrt(mass * (1.0 - mass) / samples) if samples else np.full(mass.shape, np.nan)
    rows = [
        (
            str(int(k[i])),
            measured(float(mass[i]), float(errors[i])) if samples else f"{mass[i]:.5f}",
            f"{pmf[i]:.5f}",
            f"{expected[i]:.5f}" if expected is not None else "",
        )
        for i in range(min(last + 1, _MOST_NUMBERS))
    ]
    words = ""
    if facts.get("error_rate") is not None:
        rate, error = 100.0 * float(facts["error_rate"]), 100.0 * float(facts.get("error_rate_stderr") or 0.0)
        words += f" {measured(rate, error)} % of the estimates are wrong (truth known)."
    if facts.get("expected_error_rate") is not None:
        expected_errors = percent(float(facts["expected_error_rate"]), 1.0)
        words += f" Expected from the fitted parameters: {expected_errors}."
    return Table(
        "electron-table",
        "Electron numbers",
        f"Share of each estimated electron number, and its prediction.{words}",
        ("k", "estimated", "predicted p(k)", "expected share"),
        tuple(rows),
        section="electrons",
    )


def _misfits(data: ReportData) -> Table:
    facts = data.misfits
    rows = [
        (
            f"channel {row['x']}" if data.shape[0] == 1 else f"y = {row['y']}, x = {row['x']}",
            f"{row['chi2']:.1f}",
            f"{row['dof']:.1f}".removesuffix(".0"),
            scientific(float(row["p"])),
            scientific(float(row["q"])),
            "yes" if float(row["q"]) <= float(facts["false_discovery_rate"]) else "no",
        )
        for row in facts.get("worst", ())
    ]
    if not rows:
        return Table("misfits", "", "", (), ())
    return Table(
        "misfits",
        f"Worst {data.noun}s",
        f"{int(facts['misfits']):,} of {int(facts['tested']):,} tested {data.noun}s disagree with the model "
        f"at a false-discovery rate of {facts['false_discovery_rate']:g} (Benjamini and Hochberg 1995). "
        f"{count(int(facts['pixels_with_outliers']), data.noun)} with excluded samples, at most "
        f"{percent(float(facts['largest_outlier_share']), 1.0)} of their frames.",
        (data.noun, "χ²", "degrees of freedom", "p", "q", "misfit"),
        tuple(rows),
        section="goodness",
    )


def _intervals(data: ReportData) -> Table:
    rows = []
    shares = noise_shares(data, _ORDER)
    for name in (name for name in _ORDER if data.has_values(name)):
        _, words, unit = symbol(name)
        error = data.pixel_error(name, with_flagged=True)
        if error is None:
            continue
        ends = ["", ""]
        if name in data.intervals:
            values, errors = data.maps[name], data.maps[f"{name}_stderr"]
            low, high = data.intervals[name]
            ends = [short(float(np.nanmedian(part / errors)), 3) for part in (values - low, high - values)]
        rows.append(
            (
                f"{words} ({unit})",
                short(error, 3),
                percent(error, abs(data.summary(name, with_flagged=True).median)),
                percent(min(shares[name], 1.0), 1.0) if name in shares else "not known",
                *(ends if data.intervals else ()),
            )
        )
    profile = ("profile: below", "profile: above") if data.intervals else ()
    head = ("quantity", f"error per {data.noun}", "relative error", "noise in the map", *profile)
    words = (
        f" Profile: distance of the ends of the {100 * data.interval_level:g} % profile-likelihood interval "
        "from the estimate, in standard errors."
    )
    return Table(
        "uncertainties",
        "Uncertainties",
        f"Median 1 sigma error per {data.noun}, and its share of the map's variance."
        + (words if data.intervals else ""),
        head,
        tuple(rows),
        section="uncertainty",
    )


def _status(data: ReportData) -> Table:
    status = data.fit.get("fit_status")
    if status is None:
        return Table("failures", "", "", (), ())
    total = status.size
    unfitted = int(data.unfitted.sum())
    good = int((status == 0).sum()) - int((data.unfitted & (status == 0)).sum())
    rows: list[tuple[str, ...]] = [("good fit", f"{good:,}", percent(good, total), f"{good:,}")]
    if unfitted:
        rows.append(("not fitted yet", f"{unfitted:,}", percent(unfitted, total), "none"))
    kept = status[(status & data.failed_mask) == 0]
    for bit, text, n in status_counts(status, data.status_words):
        usable = int(((kept & bit) != 0).sum())
        rows.append((text, f"{n:,}", percent(n, total), f"{usable:,}, with caution" if usable else "none"))
    return Table(
        "failures",
        "Fit status by reason",
        "A pixel with several reasons counts for each.",
        ("reason", "pixels", "share", "with a value"),
        tuple(rows),
        section="status",
    )


def _samples(data: ReportData) -> Table:
    if data.samples is None:
        return Table("samples", "", "", (), ())
    found = data.samples
    words, unit, *_ = AXES.get(found.against, ("exposure", ""))
    rows = []
    for i, sample in enumerate(found.samples):
        centre, error, *_ = middle(found.arrays["quanta_exposure"][i])
        exposure = "0 (bias)" if sample.kind == "bias" else measured(centre, error)
        residual = share = "–"
        if sample.x is not None and len(found.on_line) > 2 and "linearity_residual" in found.arrays:
            rest, rest_error, *_ = middle(found.arrays["linearity_residual"][i])
            residual = measured(rest, rest_error)
            if centre > 0:
                share = f"{100.0 * rest / centre:+.2f} %".replace("-", "−")
        x = "–" if sample.x is None else f"{sample.x:g}"
        rows.append((sample.name, x, f"{sample.n_frames:,}", exposure, residual, share))
    p = finite(found.arrays.get("linearity_p", np.empty(0)))
    off = percent(int((p < 0.01).sum()), p.size)
    remark = f" {off} of the {data.noun}s are off the line (p < 0.01; 1 % expected)." if p.size else ""
    head = f"{words} ({unit})" if unit else words
    return Table(
        "samples",
        "Samples",
        f"Medians over the {data.noun}s, with their standard errors.{remark}",
        ("sample", head, "frames", "H (e⁻)", "residual (e⁻)", "residual / H"),
        tuple(rows),
        section="exposures",
    )


def _plan(data: ReportData) -> Table:
    plan = data.plan
    if plan is None:
        return Table("plan-table", "", "", (), ())
    rows = []
    for row in plan["rows"]:
        reached = plan["reached"].get(row["name"])
        unit, scale = ("e⁻", 1.0) if row["name"] == "bias" else ("%", 100.0)
        now = "" if reached is None else f"{short(scale * reached, 2)} {unit}"
        rows.append((target_text(row["target"]), frames_text(row["frames"]), now))
    exposure, noise = plan["mark"]
    caption = (
        f"Cramer-Rao bound for the median pixel (H = {short(exposure)} e⁻, read noise {short(noise)} e⁻). "
        "Best exposure, other sensors, several samples, check by simulation: pchem plan."
    )
    head = ("precision", "frames needed", "this run's")
    return Table("plan-table", "Frames for a precision", caption, head, tuple(rows), section="plan")
