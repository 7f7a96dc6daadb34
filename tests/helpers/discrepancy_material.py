"""Synthetic discrepancy verdicts: evidence drawn by hand, and ``discrepancy.json`` of each verdict."""

import functools
from typing import Any

import numpy as np

from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.verdict import Verdict
from pchem_pipeline.effects.framework.evidence import SCORES, CodeResiduals, Evidence, PixelMaps, TimeSeries
from pchem_pipeline.report.data import DiscrepancyData
from pchem_pipeline.stages.discrepancy.arrays import evidence_arrays

FAMILIES = ("shape", "code", "tail", "time", "frame", "space")
VERDICTS = ("named", "named_in_part", "ambiguous", "unexplained", "consistent")
UNTESTABLE = {
    "charge_lag": "Poisson electrons that are delayed by chance stay Poisson",
    "charge_diffusion": "Poisson electrons that move by chance stay Poisson",
    "spurious_charge": "electrons that come from elsewhere add to H and nothing else",
}


@functools.cache
def evidence(shape: tuple[int, int] = (32, 40), n_frames: int = 1200, seed: int = 5) -> Evidence:
    """Pure chance, with some structure: a drift, stripes, a comb of codes, a few odd pixels."""
    rng = np.random.default_rng(seed)
    ny, nx = shape
    usable = rng.random(shape) > 0.01
    maps = PixelMaps(
        *(np.where(usable, m, np.nan) for m in (
            rng.uniform(0.5, 4, shape), np.full(shape, 0.09), rng.normal(100, 2, shape),
            rng.normal(3.4, 0.1, shape),
        )),
        usable=usable,
    )  # fmt: skip
    charge_std = np.sqrt(maps.quanta_exposure) * 0.97
    readout_std = np.where(usable, 2.9, np.nan)
    normal = {name: rng.standard_normal(shape).astype(np.float32) for name in SCORES}
    goodness = rng.standard_normal(shape).astype(np.float32)
    odd = rng.integers(0, (ny, nx), (12, 2))
    for y, x in odd:
        goodness[y, x] += rng.uniform(6, 30)
        normal["He4"][y, x] += rng.uniform(10, 40)
    for values in (*normal.values(), goodness):
        values[~usable] = np.nan
    code = np.arange(70, 190)
    expected = 4e6 * np.exp(-0.5 * ((code - 118) / 16) ** 2) / 40
    observed = rng.poisson(expected * (1 + 0.006 * (-1.0) ** code)).astype(float)
    observed[code == 150] += 2500
    return Evidence(
        maps=maps,
        n_frames=n_frames,
        charge_std=charge_std,
        readout_std=readout_std,
        scores=normal,
        goodness=goodness,
        peaks=goodness,
        tail_low=rng.poisson(0.01, shape).astype(np.uint32),
        tail_high=rng.poisson(0.01, shape).astype(np.uint32),
        code=CodeResiduals(70, observed, expected, 72, 186),
        time=time_series(shape, n_frames, charge_std, readout_std, usable, maps, rng),
        z={name: float(rng.standard_normal() * 1.2) for name in STATISTICS},
    )


def time_series(
    shape: tuple[int, int], n: int, charge_std: Any, readout_std: Any, usable: Any, maps: Any, rng: Any
) -> TimeSeries:
    ny, nx = shape
    block = 100
    kept = np.concatenate([np.arange(s, s + block) for s in range(0, 2 * n, 2 * block)])[:n]
    starts = kept[::block]
    h_sum, n_good = float(np.nansum(maps.quanta_exposure)), int(usable.sum())
    sd_k = np.sqrt(np.nansum(charge_std**2)) / h_sum
    sd_r = np.sqrt(np.nansum(readout_std**2)) / n_good
    position = kept / kept[-1] - 0.5
    row_sd, column_sd, row_k, column_k = (
        np.sqrt(np.nansum(values**2, axis=axis)) / usable.sum(axis=axis)
        for values in (readout_std, charge_std)
        for axis in (1, 0)
    )
    pairs = [f"{axis}.{pair}" for axis in "xy" for pair in ("kk", "rr", "rk")]
    pickup = 1.6 * np.sin(2 * np.pi * (0.17 * np.arange(ny)[None, :] + 0.031 * np.arange(n)[:, None]))
    blocks = (starts.size, ny, nx)
    return TimeSeries(
        frames=kept,
        n_run=2 * n,
        block_frames=block,
        block_start=starts,
        frame_charge=rng.normal(0, sd_k, n) + 0.004 * position,
        frame_readout=rng.normal(0, sd_r, n) + 0.12 * position,
        frame_gain=rng.normal(0, 1e-3, n),
        frame_noise=np.random.default_rng(8).standard_normal(n),
        quadrant_readout=rng.normal(0, 2 * sd_r, (n, 4)),
        row_charge=(row_k * rng.standard_normal((n, ny))).astype(np.float32),
        row_readout=(row_sd * (rng.standard_normal((n, ny)) + pickup)).astype(np.float32),
        column_charge=(column_k * rng.standard_normal((n, nx))).astype(np.float32),
        column_readout=(column_sd * rng.standard_normal((n, nx))).astype(np.float32),
        block_charge=(charge_std / 10 * rng.standard_normal(blocks)).astype(np.float32),
        block_readout=(readout_std / 10 * rng.standard_normal(blocks)).astype(np.float32),
        lag_charge=(rng.standard_normal((3, ny, nx)) / np.sqrt(n)).astype(np.float32),
        lag_readout=(rng.standard_normal((3, ny, nx)) / np.sqrt(n)).astype(np.float32),
        lag_readout_charge=(rng.standard_normal(shape) / np.sqrt(n)).astype(np.float32),
        n_pairs=n,
        neighbours=dict.fromkeys(pairs, 0.0),
        repeated=np.empty(0, np.int64),
        repeated_rows=0,
        hits=np.empty((0, 4), np.int64),
        neighbour_maps={pair: rng.standard_normal(shape).astype(np.float32) for pair in pairs},
    )


def _candidates(*scored: tuple[str, float, float, float]) -> list[dict[str, Any]]:
    return [
        {"effect": e, "score": s, "stderr": err, "probability": p, "parameters": {"amplitude_dn": 0.21}}
        for e, s, err, p in scored
    ]


PULLS = {
    "space.row.readout.variance": (84.0, 1.1),
    "frame.readout.trend": (-31.2, -0.4),
    "code.alternating": (22.5, 2.2),
    "frame.readout.slow": (14.1, -1.3),
    "space.row.readout.lag1": (-9.8, 0.2),
    "shape.He4.cnt": (8.0, 0.9),
    "code.top": (6.1, -1.7),
    "shape.goodness.mean": (-5.2, 0.1),
    "space.x.rr": (4.9, 1.2),
    "frame.readout.variance": (4.4, -0.8),
    "shape.C2.mean": (-4.3, 2.6),
    "tail.low.count": (3.1, 0.5),
}


def _pulls(extended: bool) -> list[dict[str, Any]]:
    return [
        {"statistic": n, "sentence": STATISTICS[n].sentence, "before": b, "after": a if extended else None}
        for n, (b, a) in PULLS.items()
    ]


def _place(statistic: str, channel: str, z: float, p: float, **where: Any) -> dict[str, Any]:
    found = {"statistic": statistic, "channel": channel, "direction": "+", "z": z, "p": p}
    found["sentence"] = STATISTICS[statistic].sentence
    return found | {"pixels": [], "dn": None, "frames": []} | where


def step(effect: str | None, verdict: str, before: float, after: float) -> dict[str, Any]:
    """One round of the workflow; gaps in micro-nats per sample."""
    micro = 1e-6
    return {
        "effect": effect,
        "verdict": verdict,
        "candidates": _candidates(
            (effect or "row_noise", 0.0, 0.0, 0.985),
            ("periodic_pickup", -16.8, 3.3, 0.012),
            ("interpixel_capacitance", -262.0, 9.0, 0.0),
        ),
        "parameters": {"row_noise_dn": {"value": 0.3512, "stderr": 0.0041, "unit": "DN"}},
        "gap_before": before * micro,
        "gap_after": after * micro,
        "gap_floor": 0.66 * micro,
        "gap_interval_after": [max(after - 0.5, 0.1) * micro, (after + 0.7) * micro],
        "families": {
            when: dict(zip(FAMILIES, (micro * gap for gap in gaps), strict=True))
            for when, gaps in (
                ("before", (4.0, 12.0, -0.1, 0.3, 60.0, before - 76.0)),
                ("after", (0.2, 0.1, -0.1, 0.2, 0.7, 0.7)),
            )
        },
        "size": {"electrons": 0.032, "dn": 0.351, "of_read_noise": 0.103, "samples": 1.0},
        "rivals": [
            {
                "effect": "periodic_pickup",
                "gap_after": 120 * micro,
                "behind": -16.8,
                "why": f"it leaves a deviation of 9.1 sigma: {STATISTICS['space.row.readout.lag1'].sentence}",
            },
            {"effect": "interpixel_capacitance", "gap_after": 300 * micro, "behind": -262.0, "why": ""},
        ],
        "moved": {
            "quanta_exposure": {"median": 0.0004, "in_stderr": 0.02, "unit": "e-"},
            "conversion_gain": {"median": -2.1e-5, "in_stderr": -0.08, "unit": "e-/DN"},
            "bias": {"median": 0.001, "in_stderr": 0.02, "unit": "DN"},
            "read_noise_dn": {"median": -0.0182, "in_stderr": -0.64, "unit": "DN"},
        },
        "separate": {
            "periodic_pickup": "a faster or slower row time moves the line of a pickup, not row noise"
        },
        "pulls": _pulls(extended=effect is not None),
    }


def result(verdict: str) -> dict[str, Any]:
    """``discrepancy.json`` of a verdict."""
    micro = 1e-6
    steps = {
        "named": [step("row_noise", "named", 477.0, 31.0), step("bias_drift", "named", 120.0, 0.4)],
        "ambiguous": [step(None, "ambiguous", 120.0, 120.0)],
        "named_in_part": [step("row_noise", "named", 477.0, 31.0), step(None, "unexplained", 31.0, 31.0)],
        "unexplained": [step(None, "unexplained", 120.0, 120.0)],
        "consistent": [],
    }[verdict]
    effects = [s["effect"] for s in steps if s["effect"]]
    after = steps[-1]["gap_after"] if steps else 0.2 * micro
    before = steps[0]["gap_before"] if steps else 0.2 * micro
    where = [
        _place("space.row.readout.variance", "readout", 84.0, 0.0),
        _place("code.alternating", "digital", 22.5, 1e-4, dn=[148, 152]),
        _place("shape.He4.cnt", "readout", 8.0, 2e-3, pixels=[[3, 4], [10, 20], [30, 39]]),
        _place("frame.readout.trend", "readout", 31.2, 0.0, frames=[0, 1, 2]),
    ]
    return {
        "schema_version": 3,
        "verdict": verdict,
        "sentence": {
            "named": "Row noise of 0.351 DN and a drift of the bias explain the disagreement.",
            "ambiguous": "Something is missing: row noise or periodic pickup; these data cannot tell which.",
            "named_in_part": "Row noise is a part of it; a comb of codes stays unexplained.",
            "unexplained": "A comb of codes remains that no known effect explains.",
            "consistent": "Data and model agree within sampling noise.",
        }[verdict],
        "effects": effects,
        "model_effects": [{"tag": tag} for tag in effects],
        "steps": steps,
        "gap": {
            "unit": "nats/sample",
            "before": before,
            "after": after,
            "floor": 0.66 * micro,
            "closed_fraction": 1 - after / before if steps else None,
            "interval_after": [0.5 * after, 1.6 * after],
        },
        "where": where if verdict != "consistent" else [],
        "untestable": UNTESTABLE,
        "unexplained": [
            {"statistic": "code.alternating", "z": 22.5, "sentence": STATISTICS["code.alternating"].sentence}
        ]
        if verdict in ("unexplained", "named_in_part")
        else [],
        "examined": {
            "frames": 4000,
            "rows": [0, 64],
            "columns": [0, 64],
            "train": 1800,
            "test": 1800,
            "final": 400,
            "histograms": None,
        },
        "defects": {"odd_plugin": "ValueError: boom"} if verdict == "named" else {},
        "p_global": {
            "before": 1e-4 if verdict != "consistent" else 0.41,
            "after": 0.37 if verdict == "named" else None,
        },
        "replicates": 100,
        "versions": {"statistics": "1", "numpy": "2.1"},
    }


def verdict_of(verdict: str, **changes: Any) -> Verdict:
    """The same as typed values, some keys changed."""
    return Verdict.model_validate({**result(verdict), **changes})


def discrepancy_data(verdict: str = "named", **changes: Any) -> DiscrepancyData:
    """What the page is drawn from."""
    seen = evidence()
    pulls = {} if verdict == "consistent" else PULLS
    before = seen.z | {name: pull[0] for name, pull in pulls.items()}
    after = {name: float(np.tanh(z)) for name, z in seen.z.items()}
    after |= {name: pull[1] for name, pull in pulls.items()}
    arrays = evidence_arrays(seen, before, after=after if verdict in ("named", "named_in_part") else None)
    if verdict == "named":
        position = arrays["frame_number"] / arrays["frame_number"][-1] - 0.5
        arrays["frame_readout_model"] = 0.12 * position
        arrays["frame_charge_model"] = 0.004 * position
    return DiscrepancyData(verdict_of(verdict, **changes), arrays)
