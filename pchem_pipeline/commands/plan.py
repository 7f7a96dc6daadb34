"""``pchem plan``: the frames for a target, from the Cramer-Rao bound and from simulated pixels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pchem_pipeline.base.errors import ConfigError, StoreError
from pchem_pipeline.base.plain import plain
from pchem_pipeline.planning.plan import Plan, SamplesPlan, plan_one_sample, plan_samples
from pchem_pipeline.planning.targets import Point, Target, parse_target
from pchem_pipeline.store.files import write_json


def make_plan(
    run: Path | None = None,
    *,
    read_noise: float | None = None,
    exposure: float | None = None,
    gain: float | None = None,
    target: Sequence[str] = (),
    frames: int | None = None,
    samples: str | None = None,
    max_exposure: float = 10.0,
    max_frames: float = 1e7,
    json: Path | None = None,
) -> str:
    """Return the plan in words, and write its numbers to the file ``json`` if one is given.

    Read noise (quantisation included) and exposures are in e-, the gain in e-/DN; those not given are of the
    median pixel of ``run``. Targets are precisions ``name=value``; ``frames`` are those available,
    ``samples`` exposures separated by commas, or ``best``.

    Raises:
        ConfigError: a number is missing or wrong, or no number of frames reaches a target.
        StoreError: the run has no maps, or a file cannot be written.
    """
    known, effects = _median_pixel(run) if run is not None else ({}, "")
    noise = known.get("noise_e") if read_noise is None else read_noise
    if noise is None:
        raise ConfigError("--read-noise is missing: give it in e-, quantisation included, or give a run")
    if not target and (frames is None or samples is not None):
        other = ", or --frames" if samples is None else ""
        raise ConfigError(f"--target is missing: give a precision, such as conversion_gain=1%{other}")
    exposure = known.get("quanta_exposure") if exposure is None else exposure
    usual = known.get("conversion_gain", 0.09)  # e-/DN, of the cameras that this package was made for
    point = Point(1.0 if exposure is None else exposure, noise, usual if gain is None else gain)
    targets = [parse_target(text) for text in target]
    limits: Any = {"budget": frames, "max_exposure": max_exposure, "max_frames": max_frames}
    if samples is None:
        plan = plan_one_sample(targets, point, exposure_given=exposure is not None, **limits)
        lines = _plan_lines(plan, targets, frames, max_exposure, exposure is not None)
        content = _plan_json(plan, targets)
    else:
        split = plan_samples(targets, _exposures(samples), point, **limits)
        lines, content = _split_lines(split, targets), _split_json(split, targets)
    if effects:
        lines += ["", _effects_line(effects, known, noise)]
    if json is not None:
        write_json(json, plain(content))
        lines += ["", str(json)]
    return "\n".join(lines)


def _median_pixel(run: Path) -> tuple[dict[str, float], str]:
    """Return the medians of a run's maps, with ``noise_e`` that of a sample, and the effects of its model."""
    from pchem_pipeline.commands.apply.characterisation import read_calibration
    from pchem_pipeline.effects.framework.compose import effect_words
    from pchem_pipeline.run.target import find_run, with_maps
    from pchem_pipeline.stages.fit.fitted_model import fitted_effects
    from pchem_pipeline.use.electrons import read_stderr

    store = with_maps(find_run(run).stored())
    summary = store.attributes("maps")["summary"]
    names = ("read_noise_e", "quanta_exposure", "conversion_gain")
    found = {name: summary[name]["median"] for name in names}
    if None in found.values():
        raise StoreError(
            f"{store.path}: every pixel is flagged or has no value; give --read-noise and --exposure"
        )
    found["noise_e"] = found["read_noise_e"]
    effects = fitted_effects(store)
    if effects:
        found["noise_e"] = max(np.nanmedian(read_stderr(read_calibration(store))), found["read_noise_e"])
    return {name: float(value) for name, value in found.items()}, ", ".join(map(effect_words, effects))


def _effects_line(effects: str, known: dict[str, float], noise: float) -> str:
    """Say what of the effects of a run's model is in a plan, and which way the rest errs."""
    if noise == known["noise_e"] > 1.01 * known["read_noise_e"]:
        part = f"noise {noise:.3g} e- instead of {known['read_noise_e']:.3g} e-; what else they change"
    else:
        part = "what they change"
    return f"effects in the model of the run ({effects}): {part} is left out, so more frames may be needed"


def _plan_lines(
    plan: Plan, targets: Sequence[Target], budget: int | None, max_exposure: float, exposure_given: bool
) -> list[str]:
    point = plan.point
    at = f"exposure {point.quanta_exposure:.3g} e-{'' if exposure_given else ' (the best)'}"
    lines = [f"one sample, read noise {point.read_noise_e:.4g} e-, {at}, {point.conversion_gain:.3g} e-/DN"]
    if targets:
        lines += [
            "",
            *(
                f"{target!s:<34}{bound:>14,.0f} frames (Cramer-Rao bound)"
                for target, bound in zip(targets, plan.bounds, strict=True)
            ),
            f"{'simulated, at most 5 % flagged':<34}{plan.needed:>14,.0f} frames",
        ]
    if targets and budget is not None:
        enough = plan.needed <= budget
        lines.append(f"{budget:,} frames are {'enough' if enough else 'too few'}")
    lines += ["", f"with {plan.frames:,.0f} frames, 1 sigma error per pixel (Cramer-Rao bound):"]
    for name, value in plan.precision.items():
        unit, size = ("e-", value) if name == "bias" else ("%", 100 * value)
        if name != "dark_current":  # what the charge rate is called in the dark
            lines.append(f"  {name:<20}{size:>10.3g} {unit}")
    if exposure_given and np.isfinite(plan.best_frames):
        limit = " (the largest allowed)" if plan.best_exposure > 0.99 * max_exposure else ""
        best = f"best exposure: {plan.best_exposure:.3g} e-{limit}, {plan.best_frames:,.0f} frames"
        lines += ["", f"{best}, no quantity flagged in 95 % of the pixels"]
    return lines


def _plan_json(plan: Plan, targets: Sequence[Target]) -> dict[str, Any]:
    return {
        "samples": 1,
        **vars(plan.point),
        "frames": plan.frames,
        "targets": [
            {"target": str(target), "frames_bound": bound}
            for target, bound in zip(targets, plan.bounds, strict=True)
        ],
        "frames_simulated": plan.needed,
        "precision": plan.precision,
        "best_exposure": plan.best_exposure,
        "best_frames": plan.best_frames,
    }


def _exposures(text: str) -> list[float] | None:
    if text.strip() == "best":
        return None
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if len(found) < 2:
        raise ConfigError(f"--samples {text}: give two or more exposures in e-, such as 0,2,8, or best")
    return found


def _split_lines(plan: SamplesPlan, targets: Sequence[Target]) -> list[str]:
    point = plan.point
    lines = [
        f"{len(plan.split.exposures)} samples, read noise {point.read_noise_e:.4g} e-, "
        f"{' and '.join(map(str, targets))}: {plan.frames:,.0f} frames in total",
        "",
        f"{'exposure, e-':>14}{'share':>10}{'frames':>14}",
    ]
    for exposure, share, frames in zip(plan.split.exposures, plan.split.shares, plan.per_sample, strict=True):
        lines.append(f"{exposure:>14.3g}{100 * share:>8.1f} %{frames:>14,}")
    lines.append("")
    lines += [
        f"Cramer-Rao bound: {plan.split.frames:,.0f} frames",
        f"simulated, at most 5 % of the pixels flagged: {plan.needed:,.0f} frames",
    ]
    if len(plan.split.exposures) > 1 and np.isfinite(plan.even):
        lines.append(f"Cramer-Rao bound, evenly divided: {plan.even:,.0f} frames")
    return lines


def _split_json(plan: SamplesPlan, targets: Sequence[Target]) -> dict[str, Any]:
    return {
        "samples": len(plan.split.exposures),
        **vars(plan.point),
        "quanta_exposure": list(plan.split.exposures),
        "shares": list(plan.split.shares),
        "frames": plan.frames,
        "frames_per_sample": list(plan.per_sample),
        "frames_bound": plan.split.frames,
        "frames_evenly": plan.even,
        "frames_simulated": plan.needed,
        "targets": [{"target": str(target)} for target in targets],
    }
