"""``report.json``: the numbers of the report for programs."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import numpy as np

from pchem_pipeline.base.plain import plain
from pchem_pipeline.base.wording import stored_unit
from pchem_pipeline.model.fit.status import FAILED, MEANINGS, FitStatus
from pchem_pipeline.model.maps.maps import MapSummary
from pchem_pipeline.report.data import ReportData, reasons_in, truth_errors
from pchem_pipeline.report.figures.samples import middle
from pchem_pipeline.report.pages.summary import (
    answers,
    flags,
    key_numbers,
    next_steps,
    pixel_counts,
    sentence,
)
from pchem_pipeline.report.style.ranges import finite


def report_numbers(data: ReportData) -> dict[str, Any]:
    """Return the numbers of a report as JSON data; what is not known is None.

    The keys ``summary``, ``ensemble`` (with ``rmse``) and ``fit_status`` are always there.
    """
    remarks, p = flags(data), finite(data.fit.get("goodness_p", np.empty(0)))
    numbers: dict[str, Any] = plain(
        {
            "report_version": 1,  # of this layout
            "title": data.title,
            "sentence": sentence(data),
            "answers": [asdict(answer) for answer in answers(data, remarks)],
            "headline": [asdict(number) for number in key_numbers(data)],
            "flags": [asdict(flag) for flag in remarks],
            "next": [asdict(step) for step in next_steps(data)],
            "sensor": {
                "ny": data.shape[0],
                "nx": data.shape[1],
                "n_frames": data.n_frames,
                "integration_time": data.integration_time,
                "camera": data.camera or None,
            },
            "summary": {
                name: {
                    **_numbers_of(name, data.summary(name)),
                    "pixel_stderr": data.pixel_error(name),
                    "parts": [asdict(parts) for parts in data.parts.get(name, ())],
                }
                for name in data.maps
                if not name.endswith("_stderr")
            },
            "regions": {
                region: {name: _numbers_of(name, each) for name, each in data.in_region(region).items()}
                for region in data.regions
            },
            "fit_status": _fit_status(data),
            "goodness_of_fit": {
                "n_pixels": int(p.size),
                "median_p": float(np.median(p)) if p.size else None,
                "fraction_below_0.001": float((p < 1e-3).mean()) if p.size else None,
            },
            "ensemble": {"rmse": {}, **data.ensemble_facts},
            "moments": list(data.moments),
            "electron_numbers": {
                name.removeprefix("electron_"): data.ensemble[name]
                for name in ("k", "electron_counts", "electron_mass", "electron_pmf", "electron_pmf_map")
                if name in data.ensemble
            },
            "truth": {
                name: {
                    "median": found.true_median,
                    "rmse": found.rmse,
                    "pull_mean": np.mean(found.pulls) if found.pulls.size else None,
                    "pull_sd": np.std(found.pulls) if found.pulls.size else None,
                }
                for name, found in truth_errors(data).items()
            },
            "samples": _samples(data),
            "overscan": data.overscan_medians or None,
            "missing": dict(data.missing),
            # its evidence is in discrepancy.json
            "discrepancy": None
            if data.discrepancy is None
            else data.discrepancy.found.model_dump(include={"verdict", "sentence", "effects"}),
            "quick_look": None if data.quick_look is None else data.quick_look.to_dict(),
            "run": dict(data.run),
            "inputs": list(data.inputs),
            "stages": list(data.stages),
        }
    )
    return numbers


def report_json(data: ReportData) -> str:
    """Return ``report.json`` as text: strict JSON (no NaN), sorted as written, ending in a newline."""
    return json.dumps(report_numbers(data), indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def _numbers_of(name: str, summary: MapSummary) -> dict[str, Any]:
    return {
        "unit": stored_unit(name),
        "median": summary.median,
        "median_stderr": summary.median_stderr,
        "robust_sd": summary.robust_sd,
        "percentiles": {f"{p:g}": value for p, value in summary.percentiles.items()},
        "minimum": summary.minimum,
        "maximum": summary.maximum,
        "n_pixels": summary.n_valid,
        "n_without_value": summary.n_missing,
        "n_flagged": summary.n_left_out,
        "n_outliers_low": summary.n_low,
        "n_outliers_high": summary.n_high,
    }


def _fit_status(data: ReportData) -> dict[str, Any]:
    pixels = pixel_counts(data)
    found = {bit: n for bit, _, n in reasons_in(data.status)}
    return {
        "n_pixels": pixels.total,
        "n_good": pixels.fitted - pixels.caution,
        "n_caution": pixels.caution,
        "n_flagged": int(data.flagged.sum()),
        "n_failed": pixels.failed,
        "n_unfitted": int(data.unfitted.sum()),
        "reasons": {
            bit.name.lower(): {"pixels": found.get(bit, 0), "meaning": MEANINGS[bit], "failed": bit in FAILED}
            for bit in FitStatus
            if bit.name and int(bit)
        },
    }


def _samples(data: ReportData) -> dict[str, Any] | None:
    """Return what each exposure has of its own; None for a run of one."""
    if data.samples is None:
        return None
    arrays = data.samples.arrays
    names = [name for name in ("quanta_exposure", "linearity_residual") if name in arrays]
    rows = [
        {"name": sample.name, "bias": sample.kind == "bias", "x": sample.x, "n_frames": sample.n_frames}
        | {
            name: dict(zip(("median", "median_stderr"), middle(arrays[name][i]), strict=False))
            for name in names
        }
        for i, sample in enumerate(data.samples.samples)
    ]
    return {"against": data.samples.against, "rows": rows}
