"""Fits of every kind are those that were frozen, all fields of a few dozen histograms.

These cover read noise, exposure and gain, and some are such as no model describes: one code, two, no
electrons, peaks that cannot be told apart, an even spread, samples at the end of the ADC, a few far out.

``FREEZE_FITS=1 pytest tests/golden/test_frozen_fits.py`` freezes anew what the package finds today; what
changed, and why, belongs into the commit. Whole runs are compared by ``scripts/validation/nets.py``.
"""

import os
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pchem_pipeline.base.variables import INTERVALS, PARAMETERS, interval_names
from pchem_pipeline.effects.framework.registry import effect_class
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.status import FAILED
from pchem_pipeline.stages.fit.tile import TileFit, fit_tile

FROZEN = Path(__file__).parent / "data" / "frozen_fits.npz"
ADC = (0, (1 << 14) - 1)
EFFECTS: list[dict[str, Any]] = [
    {"tag": "signal_dependent_noise", "noise_e": 0.09},
    {"tag": "nonlinearity", "step_change": 0.004},
    {"tag": "rts_noise", "fraction": 0.15, "amplitude_e": 1.0, "probability": 0.2},
    {"tag": "row_noise", "row_noise_dn": 1.2},
]
SETTINGS = {
    "plain": FitSettings(),
    "exact": FitSettings(likelihood="exact"),
    "auto": FitSettings(likelihood="auto"),
    "sandwich": FitSettings(errors="sandwich", intervals="profile"),
    "effects": FitSettings(),
    "joint": FitSettings(),
    "joint_exact": FitSettings(likelihood="exact"),
}
SAMPLES = (1.0, 3.0, 8.0, 0.0)  # exposures of a joint fit, relative; the last holds no electrons


def fitted(kind, histograms):
    """Fit the frozen histograms through the package's interface; arrays by name, the pixel first."""
    settings = SETTINGS[kind]
    if kind.startswith("joint"):
        counts = [histograms[f"joint_counts_{j}"] for j in range(len(SAMPLES))]
        origins = [histograms[f"joint_origin_{j}"] for j in range(len(SAMPLES))]
        dark = [each == 0 for each in SAMPLES]
        fit = fit_histograms(counts, origins, dark=dark, settings=settings, adc_limits=ADC)
        found = {each.name: getattr(fit, each.name) for each in fields(fit) if each.name != "intervals"}
        variances = np.diagonal(fit.covariance, axis1=1, axis2=2)
        errors = [variances[:, : len(SAMPLES)], *variances[:, len(SAMPLES) :].T]
        named = zip(PARAMETERS, errors, strict=True)
        return found | {f"{name}_stderr": np.sqrt(each) for name, each in named}
    sample = "coarse" if kind in ("exact", "auto") else "fine"
    counts, origin = histograms[f"{sample}_counts"], histograms[f"{sample}_origin"]
    nothing = np.zeros((counts.shape[0], 1), np.uint32)
    tile = {"counts": counts[:, None], "origin": origin[:, None], "under": nothing, "over": nothing}
    effects = [effect_class(each["tag"])(**each) for each in EFFECTS] if kind == "effects" else []
    found = fit_tile([tile], TileFit(settings, ADC, effects))["fit"]
    return {name: array[:, 0] for name, array in found.items()}


@pytest.fixture(scope="module")
def frozen():
    if os.environ.get("FREEZE_FITS"):
        freeze()
    with np.load(FROZEN) as stored:
        return dict(stored)


@pytest.mark.parametrize("kind", SETTINGS)
def test_a_fit_is_the_frozen_one(kind, frozen):
    old, new = of_kind(kind, frozen), fitted(kind, frozen)
    assert old.keys() <= new.keys()
    assert differences(old, new) == []


def test_the_comparison_sees_what_it_should(frozen):
    old = of_kind("plain", frozen)
    good = int(np.flatnonzero(old["fit_status"] == 0)[0])
    for name, change in (
        ("fit_status", 512),
        ("bias", 0.01 * old["bias_stderr"][good]),
        ("bias_stderr", 0.01 * old["bias_stderr"][good]),
        ("log_likelihood", -1e-4),
        ("likelihood_gap", -1e4),
        ("goodness_chi2", 1.0),
        ("conversion_gain", np.nan),
    ):
        changed = old[name].copy()
        changed[good] += np.asarray(change).astype(changed.dtype)
        assert differences(old, old | {name: changed}) != [], name


def of_kind(kind, frozen):
    """Return the arrays of one kind of fit."""
    return {name.split("/")[1]: array for name, array in frozen.items() if name.startswith(f"{kind}/")}


def differences(old, new):
    """Name the fields that differ by more than a refit may: estimates by 1e-3 of their standard errors."""
    wrong = []

    def within(name, allowed, chosen=True):
        left, right = old[name], new[name]
        with np.errstate(invalid="ignore"):
            same = (np.abs(right - left) <= allowed) | (left == right) | (np.isnan(left) & np.isnan(right))
        off = np.argwhere(~same & chosen)
        wrong.extend(f"{name}{at}: {left[tuple(at)]} -> {right[tuple(at)]}" for at in off.tolist())

    within("fit_status", 0)
    good = (old["fit_status"] & int(FAILED)) == 0
    for name in PARAMETERS:
        error = old[f"{name}_stderr"]
        # without a standard error the parameter is at its bound; the bound of sigma is that of the model
        within(name, np.where(np.isnan(error), 1e-6 * np.abs(old[name]), 1e-3 * error))
        within(f"{name}_stderr", 1e-3 * error)
    for name in INTERVALS:
        for end in interval_names(name):
            if end in old:
                width = np.abs(old[interval_names(name)[1]] - old[interval_names(name)[0]])
                within(end, np.where(np.isnan(width), 1e-6 * np.abs(old[end]), 1e-3 * width))
    lower = old["log_likelihood"] - new["log_likelihood"] > 1e-9 * np.abs(old["log_likelihood"])
    wrong += [f"log_likelihood of pixel {pixel} is lower" for pixel in np.flatnonzero(lower & good)]
    # beyond 30 nats the gap is an estimate of how far down the runner-up is
    shown = np.minimum(old["likelihood_gap"], 30.0), np.minimum(new["likelihood_gap"], 30.0)
    wrong += [f"likelihood_gap[{i}]" for i in np.flatnonzero(good & (np.abs(shown[0] - shown[1]) > 1e-3))]
    within("goodness_dof", 1e-3, good)
    within("goodness_chi2", 1e-3 * np.maximum(old["goodness_dof"], 1), good)
    within("goodness_p", 1e-3, good)
    within("outlier_share", 1e-12, good)
    if "satellite_weight" in old:
        within("satellite_weight", 1e-4, good)
        within("satellite_amplitude_e", 1e-3, good)
    if "correlation" in old:
        within("correlation", 1e-3)
    for name in ("mean", "variance"):  # of the samples, which are no estimates
        if name in old:
            within(name, 1e-9 * np.abs(old[name]))
    return wrong


def freeze():
    """Keep today's fits of the frozen histograms."""
    with np.load(FROZEN) as stored:
        histograms = {name: array for name, array in stored.items() if "/" not in name}
    answers = {f"{kind}/{name}": each for kind in SETTINGS for name, each in fitted(kind, histograms).items()}
    np.savez_compressed(FROZEN, **histograms, **answers)
