"""The comparison of methods in words: the table of the command line, and who wins up to which read noise."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pchem_pipeline.report.style.wording import short

__all__ = ["bound_crossing", "measured_crossing", "method_rows", "methods_text", "verdict_words"]

_COLUMNS = (
    "pixels",
    "g, e-/DN",
    "g bias %",
    "g rmse %",
    "g bound %",
    "rmse/bound",
    "s_e rmse %",
    "H rmse %",
    "us/pixel",
)


def methods_text(result: Mapping[str, Any]) -> str:
    """Return the comparison as the command prints it.

    Args:
        result: content of ``methods.json``.
    """
    against = {"truth": "the truth", "fit": "this run's fit of the same frames"}[result["reference"]]
    lines = [f"{result['pixels']:,} pixels, errors against {against}"]
    lines += [f"sample {i}: {_sample(sample)}" for i, sample in enumerate(result["samples"])]
    head = f"{'method':<34}" + "".join(f"{column:>12}" for column in _COLUMNS)
    lines += ["", head, "-" * len(head)]
    for row in method_rows(result):
        lines.append(
            f"{row[0]:<34}" + (f"  {row[1]}" if len(row) == 2 else "".join(f"{c:>12}" for c in row[1:]))
        )
    if result["study"]:
        at = result["study_at"]
        lines += [
            "",
            f"simulated, H = {at['quanta_exposure']:.3g} e-, {at['n_frames']:,} frames for every method, "
            f"{at['n_pixels']} pixels at each read noise: rmse of g in %",
            *_study_lines(result["study"]),
            "",
            verdict_words(result["study"]),
        ]
    return "\n".join(lines)


def _sample(sample: Mapping[str, Any]) -> str:
    exposure = sample["quanta_exposure"]
    words = "exposure not known" if exposure is None else f"H = {exposure:.3g} e-"
    return f"{sample['run']}, {sample['n_frames']:,} frames, {words}"


def method_rows(result: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return a row of text for every method: title and numbers, or title and why it was not run.

    Against a fit of the same frames an error is no multiple of the bound: the reference errs too.

    Args:
        result: content of ``methods.json``.
    """
    rows: list[tuple[str, ...]] = []
    for method in result["methods"]:
        if method["missing"]:
            rows.append((method["title"], method["missing"]))
            continue
        errors = method["errors"]
        gain = errors.get("conversion_gain", {})
        ratio = _ratio(gain.get("rmse"), gain.get("bound")) if result["reference"] == "truth" else "-"
        if not errors:
            cells = ["reference", "", "", "", "", ""]
        else:
            cells = [_percent(gain.get(name)) for name in ("bias", "rmse", "bound")]
            cells += [
                ratio,
                *(_percent(errors[name]["rmse"]) for name in ("read_noise_e", "quanta_exposure")),
            ]
        time = f"{1e6 * method['seconds_per_pixel']:.0f}"
        gain_value = method["medians"]["conversion_gain"]
        value = "-" if gain_value is None else f"{gain_value:.5g}"
        rows.append((method["title"], f"{method['n_answered']:,}", value, *cells, time))
    return rows


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.3g}"


def _ratio(value: float | None, bound: float | None) -> str:
    return "-" if value is None or not bound else f"{value / bound:.2f}"


def _study_lines(study: Sequence[Mapping[str, Any]]) -> list[str]:
    titles = {name: method["title"] for name, method in study[0]["methods"].items()}
    lines = [f"{'read noise, e-':<34}" + "".join(f"{point['read_noise_e']:>9g}" for point in study)]
    for name, title in titles.items():
        cells = [_percent(_rmse(point, name)) for point in study]
        lines.append(f"{title:<34}" + "".join(f"{cell:>9}" for cell in cells))
    for name in ("one sample", "a dark and a bright sample"):
        cells = [_percent(point["bounds"][name]) for point in study]
        lines.append(f"{'bound, ' + name:<34}" + "".join(f"{cell:>9}" for cell in cells))
    return lines


def _rmse(point: Mapping[str, Any], name: str) -> float | None:
    method = point["methods"][name]
    # of few answered pixels the easy ones are left
    if method["n_answered"] < 0.5 * method["n_pixels"]:
        return None
    found = method["errors"]["conversion_gain"]["rmse"]
    return None if found is None else float(found)


def bound_crossing(study: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the read noise, e-, at which photon transfer's error falls below the bound of one sample."""
    return _crossing(
        study,
        [point["bounds"]["one sample"] for point in study],
        [point["bounds"]["photon_transfer"] for point in study],
    )


def measured_crossing(study: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the same from the simulated pixels: PCH-EM of one sample against two-sample photon transfer."""
    return _crossing(
        study,
        [_rmse(point, "pchem_em") for point in study],
        [_rmse(point, "photon_transfer") for point in study],
    )


def _crossing(
    study: Sequence[Mapping[str, Any]], one: Sequence[float | None], other: Sequence[float | None]
) -> float | None:
    """Interpolate where ``one`` grows above ``other``; None where it does not, or is above from the start."""
    known = sorted(
        (point["read_noise_e"], np.log(a / b))
        for point, a, b in zip(study, one, other, strict=True)
        if a and b
    )
    for (x0, y0), (x1, y1) in itertools.pairwise(known):
        if y0 < 0 <= y1:
            return float(x0 + (x1 - x0) * y0 / (y0 - y1))
    return None


def verdict_words(study: Sequence[Mapping[str, Any]]) -> str:
    """Say up to which read noise one-sample PCH-EM beats photon transfer with as many frames."""
    expected, measured = bound_crossing(study), measured_crossing(study)
    if expected is None and measured is None:
        return "one-sample PCH-EM and two-sample photon transfer do not cross in the read noises simulated"
    parts = []
    if expected is not None:
        parts.append(f"{short(expected, 2)} e- by the Cramer-Rao bound")
    if measured is not None:
        parts.append(f"{short(measured, 2)} e- on the simulated pixels")
    return (
        "one-sample PCH-EM knows the gain better than two-sample photon transfer with as many frames up to a "
        f"read noise of {', '.join(parts)}; above it, take several exposures"
    )
