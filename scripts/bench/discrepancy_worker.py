"""One case of the study: hide in a process of its own, look blind, then open the key and compare."""

from __future__ import annotations

import json
import tempfile
import time
import traceback
from pathlib import Path
from typing import Any

import numpy as np
from discrepancy_cases import Case, make
from discrepancy_command import command_verdict
from discrepancy_null import null_of_range
from numpy.typing import NDArray

PARAMETERS = ("quanta_exposure", "conversion_gain", "bias", "read_noise_e")


def run_case(case: Case, options: dict[str, Any], with_bias: bool, installed: bool = False) -> dict[str, Any]:
    """Return the record of a case, of the installed command if so; whatever goes wrong is part of it."""
    record: dict[str, Any] = {"case": case.to_json(), "error": None}
    with tempfile.TemporaryDirectory(prefix="hidden-") as folder:
        try:
            stack, key = Path(folder) / "stack", Path(folder) / "sealed" / "key.json"
            if case.kind == "range":
                return record | null_of_range(case.index)
            make(case.hidden, case.level, case.seed, case.shape, stack, key)
            frames = np.load(stack / "frames.npy")
            if case.place is not None:
                frames = _in_place(case, frames, Path(folder))
            record |= command_verdict(frames, Path(folder)) if installed else _look(case, frames, options)
            # only now is the key opened
            record["hidden"] = json.loads(key.read_text())["effects"]
            record["read_noise_e"] = float(np.median(np.load(key.with_suffix(".npz"))["read_noise_e"]))
            found = record.pop("found", None)
            if with_bias:
                record |= _compared(case, frames, found, key)
        # a study of hundreds of cases goes on, and counts this one as failed
        except Exception as error:
            record.pop("found", None)
            record["error"] = f"{type(error).__name__}: {error}"
            record["trace"] = traceback.format_exc()[-2000:]
    return record


def _in_place(case: Case, frames: NDArray[np.uint16], folder: Path) -> NDArray[np.uint16]:
    """Return the stack with the effect in its place, and the same sensor without it elsewhere.

    With electrons of its own: an effect on the light makes the same random numbers those of other pixels,
    and pixels of the two stacks would go together in a frame.
    """
    assert case.place is not None
    axis, begin, end = case.place
    make((), case.level, case.seed, case.shape, folder / "twin", folder / "twin" / "key.json", take=1)
    placed = np.load(folder / "twin" / "frames.npy")
    index = [slice(None)] * 3
    index[("frames", "rows", "columns").index(axis)] = slice(begin, end)
    placed[tuple(index)] = frames[tuple(index)]
    return placed


def _look(case: Case, frames: NDArray[np.uint16], options: dict[str, Any]) -> dict[str, Any]:
    from pchem_pipeline.discrepancy.by_simulation.explainer import find_discrepancies
    from pchem_pipeline.discrepancy.settings import DiscrepancySettings

    settings = DiscrepancySettings(exclude=case.exclude, **options)
    wall, cpu = time.perf_counter(), time.process_time()
    found = find_discrepancies(frames, settings=settings)
    return {
        "seconds": time.perf_counter() - wall,
        "cpu_seconds": time.process_time() - cpu,
        "verdict": json.loads(found.verdict.to_json()),
        "found": found,
    }


def fit_maps(
    frames: NDArray[np.uint16], effects: tuple[Any, ...] = (), added: Any = None
) -> dict[str, NDArray[np.float64]]:
    """Fit the whole stack with the PCD, or with the model that effects make of it.

    Returns:
        Maps of H, g, mu and s_e, their standard errors (``*_stderr``), and ``good``.
    """
    from pchem_pipeline.effects.framework.compose import pixel_maps, sample_law
    from pchem_pipeline.model.checks.shrinkage import noise_of
    from pchem_pipeline.model.fit.api import fit_histograms
    from pchem_pipeline.model.fit.status import FAILED
    from pchem_pipeline.model.histogram.count import histogram_frames

    histograms = histogram_frames(frames)
    counts = histograms.counts.reshape(-1, histograms.counts.shape[-1])
    flat = [a.ravel() for a in (histograms.origin, histograms.under, histograms.over)]
    result = fit_histograms(counts, *flat)
    if effects:
        law = sample_law(effects, pixel_maps(result.maps, (result.fit_status & FAILED) == 0), added)
        result = fit_histograms(counts, flat[0], law=law, start=result)
    shape = frames.shape[1:]
    g, sigma, covariance = result.conversion_gain, result.read_noise_dn, result.covariance
    stderr = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    together = covariance[:, 1, 3] / (stderr[:, 1] * stderr[:, 3])
    noise, noise_stderr = noise_of(g, sigma, stderr[:, 1], stderr[:, 3], together)
    maps = {
        "quanta_exposure": result.quanta_exposure,
        "conversion_gain": g,
        "bias": result.bias,
        "read_noise_e": noise,
        "quanta_exposure_stderr": stderr[:, 0],
        "conversion_gain_stderr": stderr[:, 1],
        "bias_stderr": stderr[:, 2],
        "read_noise_e_stderr": noise_stderr,
        "good": (result.fit_status & FAILED) == 0,
    }
    return {name: np.asarray(values).reshape(shape) for name, values in maps.items()}


def _compared(case: Case, frames: NDArray[np.uint16], found: Any, key: Path) -> dict[str, Any]:
    """Return the bias of the maps, or why there is none: the verdict stands by itself."""
    affected = np.load(key.with_suffix(".npz"))[f"affected_{case.hidden[0]}"]
    folder = key.parents[1] / "twin"
    make((), case.level, case.seed, case.shape, folder, folder / "key.json")
    try:
        return {"bias": _bias(frames, np.load(folder / "frames.npy"), found, affected)}
    except Exception as error:
        return {"bias_error": f"{type(error).__name__}: {error}", "trace": traceback.format_exc()[-2000:]}


def _bias(
    frames: NDArray[np.uint16], twin: NDArray[np.uint16], found: Any, affected: NDArray[np.bool_]
) -> dict[str, Any]:
    """Compare fits without and with the named effects to the plain fit of the twin without the effect."""
    reference, before = fit_maps(twin), fit_maps(frames)
    # where nothing was named the bias stays what it is
    after = fit_maps(frames, found.model, found.added) if found.model else before
    good = affected & reference["good"] & before["good"] & after["good"]
    bias: dict[str, Any] = {"pixels": int(good.sum()), "affected": int(affected.sum())}
    for name in PARAMETERS:
        error = reference[f"{name}_stderr"][good]
        moved = [(maps[name] - reference[name])[good] for maps in (before, after)]
        use = np.isfinite(error) & np.isfinite(moved[0]) & np.isfinite(moved[1])
        n = max(int(use.sum()), 1)
        # a few lost pixels must not decide over the mean of all
        low, high = (np.clip((m / error)[use], -50, 50) for m in moved)
        means = [float(each.mean()) if use.any() else 0.0 for each in (low, high)]
        chance = float(high.std() / np.sqrt(n)) if use.any() else 0.0
        bias[name] = {"before": means[0], "after": means[1], "chance": chance, "pixels": n}
    return bias
