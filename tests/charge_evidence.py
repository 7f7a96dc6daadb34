"""Evidence of the charge channel by the book: plain sums over whole arrays, for tests of estimators.

The true parameters take the place of fitted ones, and every sum is written as its definition reads.
"""

from __future__ import annotations

import numpy as np

from pchem_pipeline.effects.evidence import CodeResiduals, Evidence, PixelMaps, TimeSeries
from pchem_pipeline.model.pcd import pcd_mass
from pchem_pipeline.simulate.chain import simulate_block
from pchem_pipeline.simulate.settings import SimulateSettings
from pchem_pipeline.simulate.truth import TruthMaps

BLOCK = 50


def a_sensor(shape=(24, 24), seed=5, exposure=(0.5, 4.0)):
    """Return maps of a sensor drawn evenly from ranges."""
    rng = np.random.default_rng(seed)
    return TruthMaps(
        quanta_exposure=rng.uniform(*exposure, shape),
        conversion_gain=1.0 / rng.uniform(8.0, 14.0, shape),
        bias=rng.uniform(100.0, 104.0, shape),
        analog_read_noise_e=rng.uniform(0.2, 0.35, shape),
        defect=np.zeros(shape, np.uint8),
    )


def frames_of(truth, *effects, n_frames, seed=1):
    """Return frames (frame, y, x), DN, of a sensor with effects."""
    settings = SimulateSettings(shape=truth.shape, n_frames=n_frames, seed=seed, effects=effects, bit_depth=14)
    return simulate_block(truth, settings, (0, n_frames), electron_frames=0)[0]


def evidence_of(truth, *effects, n_frames=2000, seed=1, every=1):
    """Return the evidence of every n-th block of the frames of a sensor with effects."""
    frames = frames_of(truth, *effects, n_frames=n_frames, seed=seed)
    numbers = np.flatnonzero(np.arange(n_frames) // BLOCK % every == 0)
    return seen(frames[numbers], numbers, n_frames, truth)


def seen(frames, numbers, n_run, truth):
    """Return the evidence of frames (frame, y, x), DN, the true maps taken as fitted."""
    everything = np.ones(truth.shape, np.bool_)
    maps = PixelMaps(
        truth.quanta_exposure, truth.conversion_gain, truth.bias, truth.read_noise_dn, everything
    )
    low, high = int(frames.min()), int(min(frames.max(), truth.bias.max() + 30 / truth.conversion_gain.min()))
    codes = np.arange(low - 40, high + 40)[:, None, None]
    mass = pcd_mass(codes, *(getattr(truth, n) for n in _NAMES))
    weights = _posterior(codes, truth)
    k = np.arange(weights.shape[0])[:, None, None, None]
    table = (weights * k).sum(0)
    place = np.clip(frames.astype(np.int64), low, high) - codes[0, 0, 0]
    take = (place, *np.ogrid[: truth.shape[0], : truth.shape[1]])
    charge = table[take] - truth.quanta_exposure
    std = np.sqrt((mass * table**2).sum(0) - (mass * table).sum(0) ** 2)
    scores = {"C2": _charlier_score(place, weights, mass, codes, truth).astype(np.float32)}
    nothing = np.zeros(truth.shape, np.uint32)
    empty = CodeResiduals(low, np.zeros(1), np.zeros(1), low, high)
    return Evidence(
        maps=maps,
        n_frames=len(frames),
        charge_std=std,
        readout_std=np.ones(truth.shape),
        scores=scores,
        goodness=np.zeros(truth.shape, np.float32),
        tail_low=nothing,
        tail_high=nothing,
        code=empty,
        time=_time(frames, charge, numbers, n_run, truth),
    )


_NAMES = ("quanta_exposure", "conversion_gain", "bias", "analog_read_noise_e")


def _posterior(codes, truth, most=30):
    """Return P(K = k | x) of each code and pixel, (k, code, y, x)."""
    h, step = truth.quanta_exposure, 1 / truth.conversion_gain
    joint = [
        np.exp(k * np.log(h) - h - np.log(np.arange(1, k + 1)).sum())
        * np.exp(-0.5 * ((codes - truth.bias - k * step) / truth.read_noise_dn) ** 2)
        + 1e-280 * (k == 0) * (codes < truth.bias)
        + 1e-280 * (k == most - 1) * (codes > truth.bias)
        for k in range(most)
    ]
    return np.array(joint) / np.sum(joint, axis=0)


def _charlier_score(place, weights, mass, codes, truth):
    """Return the standardised efficient score of (k - H)^2 - k, (y, x)."""
    k = np.arange(weights.shape[0])[:, None, None, None]
    h = truth.quanta_exposure
    r = (codes - truth.bias - k / truth.conversion_gain) / truth.read_noise_dn
    nuisance = np.array([(weights * s).sum(0) for s in (k - h, r, r * k, r**2 - 1)])
    score = (weights * ((k - h) ** 2 - k)).sum(0)
    products = np.einsum("icyx,jcyx,cyx->yxij", nuisance, nuisance, mass)
    overlap = np.einsum("icyx,cyx,cyx->yxi", nuisance, score, mass)
    slopes = np.linalg.solve(products, overlap[..., None])[..., 0]
    score = score - np.einsum("yxi,icyx->cyx", slopes, nuisance)
    sums = score[(place, *np.ogrid[: h.shape[0], : h.shape[1]])].sum(0)
    return sums / np.sqrt(len(place) * (mass * score**2).sum(0))


def _time(frames, charge, numbers, n_run, truth):
    n, ny, nx = frames.shape
    starts = np.concatenate([[True], np.diff(numbers // BLOCK) > 0])
    block = np.cumsum(starts) - 1
    pixels = charge.reshape(n, -1)
    std = pixels.std(0)
    whole = pixels - pixels.mean(1, keepdims=True)
    unit = (whole / whole.std(0)).reshape(charge.shape)
    follows = [(np.arange(n - lag), np.arange(lag, n)) for lag in (1, 2, 3)]
    follows = [(a[block[a] == block[b]], b[block[a] == block[b]]) for a, b in follows]
    centred = pixels - pixels.mean(0)
    lags = [(centred[a] * centred[b]).mean(0) / std**2 for a, b in follows]
    neighbours = {"x.kk": (unit[:, :, 1:] * unit[:, :, :-1]).mean()}
    neighbours["y.kk"] = (unit[:, 1:] * unit[:, :-1]).mean()
    zero = np.zeros((1, ny, nx), np.float32)
    lines = np.zeros((n, 1), np.float32)
    far = frames > truth.bias + (truth.quanta_exposure + 9 * np.sqrt(truth.quanta_exposure) + 6) / (
        truth.conversion_gain
    )
    where = np.argwhere(far)
    return TimeSeries(
        frames=numbers,
        n_run=n_run,
        block_frames=BLOCK,
        block_start=numbers[starts],
        frame_charge=pixels.sum(1) / truth.quanta_exposure.sum(),
        frame_readout=np.zeros(n),
        frame_gain=np.zeros(n),
        quadrant_charge=np.zeros((n, 4)),
        quadrant_readout=np.zeros((n, 4)),
        row_charge=lines,
        row_readout=lines,
        column_charge=lines,
        column_readout=lines,
        block_charge=np.array([charge[block == b].mean(0) for b in range(block[-1] + 1)], np.float32),
        block_readout=zero,
        lag_charge=np.array(lags, np.float32).reshape(3, ny, nx),
        lag_readout=zero,
        lag_readout_charge=zero[0],
        lag_charge_readout=zero[0],
        n_pairs=len(follows[0][0]),
        neighbours=neighbours,
        neighbour_pairs={"x.kk": n * ny * (nx - 1), "y.kk": n * (ny - 1) * nx},
        repeated=np.zeros(0, np.int64),
        repeated_rows=0,
        hits=np.column_stack([numbers[where[:, 0]], where[:, 1:], frames[far]]).astype(np.int64),
    )
