"""What the figures of a discrepancy verdict are drawn from: small arrays made of an ``Evidence``.

The arrays are those of group ``discrepancy`` in :mod:`pchem_pipeline.base.variables`. Where the null
hypothesis gives a standard deviation, values are divided by it, so that a reader sees at once what is beyond
chance.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.errors import error_words
from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.discrepancy.by_simulation.sensor.replicate import truth_of
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.observe.sums import CHANNELS
from pchem_pipeline.discrepancy.where import PAIRS, pixel_maps
from pchem_pipeline.effects.framework.context import EffectContext
from pchem_pipeline.effects.framework.effect import Effect, Plane
from pchem_pipeline.effects.framework.evidence import SCORES, Evidence, TimeSeries
from pchem_pipeline.simulate.streams import KeyedStreams

_log = logging.getLogger(__name__)


def evidence_arrays(
    evidence: Evidence,
    before: Mapping[str, float] | None = None,
    after: Mapping[str, float] | None = None,
    effects: Sequence[Effect] = (),
    integration_time: float = 1.0,
    bit_depth: int = 16,
    code_extended: FloatArray | None = None,
) -> dict[str, NDArray[Any]]:
    """Return the arrays of group ``discrepancy``, by their names without the group.

    ``before`` and ``after`` are the statistics standardised by replicates of the plain model (None: those of
    the evidence) and of that with effects (None: no effects), ``code_extended`` the samples expected at each
    code with these. Paths of effects are drawn where they do not depend on chance. What the evidence lacks
    (everything along time for ready-made histograms) is absent.
    """
    code = evidence.code
    found: dict[str, NDArray[Any]] = {
        "goodness": np.asarray(evidence.goodness, np.float32),
        "tail": np.stack([evidence.tail_low, evidence.tail_high]).astype(np.uint32),
        "code_dn": (code.first + np.arange(code.observed.size)).astype(np.int32),
        "code_observed": np.asarray(code.observed, np.float64),
        "code_expected": np.asarray(code.expected, np.float64),
        "z_before": _vector(evidence.z if before is None else before),
    }
    if all(name in evidence.scores for name in SCORES):
        found["score"] = np.stack([np.asarray(evidence.scores[name], np.float32) for name in SCORES])
    if code_extended is not None:
        found["code_extended"] = np.asarray(code_extended, np.float64)
    if after is not None:
        found["z_after"] = _vector(after)
    if evidence.time is not None:
        found |= _time_arrays(evidence, evidence.time)
        found |= path_arrays(evidence, effects, integration_time, bit_depth)
    return found


def _vector(z: Mapping[str, float]) -> FloatArray:
    return np.array([z.get(name, np.nan) for name in STATISTICS], dtype=np.float64)


def _time_arrays(evidence: Evidence, time: TimeSeries) -> dict[str, NDArray[Any]]:
    usable = evidence.maps.usable
    variance = [np.where(usable, std, 0.0) ** 2 for std in (evidence.charge_std, evidence.readout_std)]
    total = float(np.where(usable, evidence.maps.quanta_exposure, 0.0).sum())
    sizes = np.array([total, float(usable.sum())])
    with np.errstate(divide="ignore", invalid="ignore"):
        frame_sd = np.sqrt([float(v.sum()) for v in variance]) / sizes
    found: dict[str, NDArray[Any]] = {
        "frame_number": np.asarray(time.frames, dtype=np.int64),
        "frame_charge": np.asarray(time.frame_charge, np.float64),
        "frame_readout": np.asarray(time.frame_readout, np.float64),
        "frame_sd": np.where(np.isfinite(frame_sd), frame_sd, np.nan),
    }
    if time.frame_noise is not None:
        found["frame_noise"] = np.asarray(time.frame_noise, np.float64)
    maps = pixel_maps(evidence)
    for name, short in (("lag1", "lag"), ("block_spread", "spread"), ("trend", "trend")):
        found[name] = np.asarray(np.stack([maps[f"{short}.{channel}"] for channel in CHANNELS]), np.float32)
    if time.neighbour_maps:
        nothing = np.full(usable.shape, np.nan)
        found["neighbour"] = np.asarray(np.stack([maps.get(name, nothing) for name in PAIRS]), np.float32)
    for line, axis, charge, readout in (
        ("row", 1, time.row_charge, time.row_readout),
        ("column", 0, time.column_charge, time.column_readout),
    ):
        with np.errstate(divide="ignore", invalid="ignore"):
            sd = [np.sqrt(v.sum(axis=axis)) / usable.sum(axis=axis) for v in variance]
            scaled = np.stack([charge / sd[0], readout / sd[1]])
        scaled[~np.isfinite(scaled)] = np.nan
        found[f"{line}_rms"] = np.sqrt(np.mean(scaled.astype(np.float64) ** 2, axis=1))
        found[f"{line}_image"] = np.asarray(scaled[:, :96], np.float32)
    return found


def path_arrays(
    evidence: Evidence, effects: Iterable[Effect], integration_time: float = 1.0, bit_depth: int = 16
) -> dict[str, FloatArray]:
    """Return how frame means move under the effects whose path is not a matter of chance.

    Each effect acts alone on a few rows of a noiseless sensor with the fitted maps, twice with different
    random numbers: what comes out alike is its path. An effect that cannot do this is left out. The posterior
    mean k follows a change only in part, and the residual takes the rest: an exposure H (1 + a) moves the
    mean of k by a Var(k), and an offset of d electrons moves it by d E[Var(K|x)] / sigma_e^2, both to first
    order (scores of H and mu of the PCD, Hendrickson et al. 2023, eq. update_eqns). The arrays are
    ``frame_charge_model`` (relative) and ``frame_readout_model`` (DN), shape (n_frames,) each; none where no
    effect has a path.
    """
    time = evidence.time
    if time is None or not evidence.maps.usable.any():
        return {}
    exposure, offset = np.zeros(time.frames.size), np.zeros(time.frames.size)
    for effect in effects:
        try:
            first, second = (
                _path(evidence, time, effect, seed, integration_time, bit_depth) for seed in (1, 2)
            )
        # an effect of others may expect more than a noiseless sensor
        except Exception as error:
            _log.warning("no path of %s: %s", effect.tag, error_words(error))
            continue
        if np.allclose(first, second, rtol=1e-6, atol=1e-12) and np.isfinite(first).all():
            exposure += first[0] - first[0].mean()
            offset += first[1] - first[1].mean()
    if not np.ptp(exposure) and not np.ptp(offset):
        return {}
    return _seen(evidence, exposure, offset)


def _seen(evidence: Evidence, exposure: FloatArray, offset: FloatArray) -> dict[str, FloatArray]:
    """Turn relative exposure and offset (DN) of the frames into what their means of k and r show."""
    usable, maps = evidence.maps.usable, evidence.maps
    h, g, sigma = (m[usable] for m in (maps.quanta_exposure, maps.conversion_gain, maps.read_noise_dn))
    variance = np.minimum(evidence.charge_std[usable] ** 2, h)
    leak = np.clip((h - variance) / (sigma * g) ** 2, 0.0, 1.0)
    return {
        "frame_charge_model": (exposure * variance.sum() + offset * (g * leak).sum()) / h.sum(),
        "frame_readout_model": exposure * ((h - variance) / g).mean() + offset * (1.0 - leak).mean(),
    }


def _path(
    evidence: Evidence, time: TimeSeries, effect: Effect, seed: int, integration_time: float, bit_depth: int
) -> FloatArray:
    """Return relative exposure and offset (DN) of every frame under one effect alone, shape (2, n_frames)."""
    ny, nx = evidence.maps.usable.shape
    rows = np.unique(np.linspace(0, ny - 1, 4).astype(np.int64))
    whole = truth_of(evidence.maps)
    truth = {name: getattr(whole, name)[rows] for name in (*PARAMETERS[:3], "analog_read_noise_e")}
    parts, step = [], 256
    for start in range(0, time.frames.size, step):
        frames = np.asarray(time.frames[start : start + step], dtype=np.int64)
        context = EffectContext(
            frames=frames,
            n_frames=time.n_run,
            rows=rows,
            shape=(ny, nx),
            integration_time=integration_time,
            bit_depth=bit_depth,
            truth=truth,
            random=KeyedStreams(seed, "path", frames, rows, np.arange(nx)),
        )
        parts.append(_moved(effect, context))
    return np.concatenate(parts, axis=1)


def _moved(effect: Effect, context: EffectContext) -> FloatArray:
    """Return relative exposure and offset (DN) of the frames of a block, shape (2, n_frames)."""
    truth, gain = context.truth, context.truth["conversion_gain"]
    full = (context.frames.size, *gain.shape)
    mean = np.array(np.broadcast_to(truth["quanta_exposure"], full))
    charge, found = np.rint(mean), np.zeros((2, context.frames.size))
    if effect.plane is Plane.EXPOSURE:
        found[0] = (effect.apply(mean, context) / np.maximum(mean, 1e-12) - 1.0).mean(axis=(1, 2))
        return found
    context = replace(context, exposure=mean, charge=charge.astype(np.int64), read_noise=np.zeros(full))
    if effect.plane is Plane.ANALOG:
        found[1] = ((effect.apply(charge, context) - charge) / gain).mean(axis=(1, 2))
    elif effect.plane is Plane.ADC:
        signal = charge / gain + truth["bias"]
        found[1] = (effect.apply(signal, context) - signal).mean(axis=(1, 2))
    return found
