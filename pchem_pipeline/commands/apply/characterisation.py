"""What a run says of its pixels, read from its store."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pchem_pipeline.base.arrays import BoolArray, FloatArray
from pchem_pipeline.base.errors import ConfigError, StoreError, quoted
from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.commands.apply.settings import Job, Piece
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.status import moves_gain
from pchem_pipeline.model.maps.maps import electron_shifts
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.stages.fit.fitted_model import FittedModel, fitted_satellites
from pchem_pipeline.store.run_store import RunStore
from pchem_pipeline.use.calibration import Calibration, covariance_of

#: Gap below which a rival counts, nats; read noise and standard error of the bias from which on, e-, the
#: curvature of the likelihood at its maximum does not give its width: where either is less, or the
#: gap larger, errors by the curvature are less than 5 % too small, at 0.45 e- and 4,000 frames 20 % and more.
_NEAR_RIVAL, _NOISY_E, _LOOSE_E = 10.0, 0.33, 0.02
#: Pixels whose likelihood is walked at once.
_BATCH = 1024


def check_run(store: RunStore) -> str:
    """Return the digest of the fit of a run.

    Raises:
        StoreError: the run is not finished as far as its fit.
        ConfigError: it has no frames.
    """
    record = store.records.read("fit")
    if record is None or not (record.finished and store.records.has_all(record)):
        raise StoreError(f"{store.path} has no complete fit; run: pchem run {quoted(store.path)}")
    if SensorInfo.read(store).kind == "histograms":
        raise ConfigError(f"{store.path} was made from ready-made histograms; a run of frames is needed")
    return record.fingerprint


def read_calibration(
    store: RunStore,
    rows: slice = slice(None),
    *,
    removed: Sequence[str] = (),
    extra_variance: FloatArray | None = None,
    limits: tuple[int | None, int | None] = (None, None),
) -> Calibration:
    """Return the calibration of some rows of a run, for samples between ``limits``, DN (None: not known).

    The offsets of the effects with the tags ``removed`` are subtracted from the frames; ``extra_variance``
    (y, x) is that of their estimates, DN^2.
    """
    region = (rows, slice(None))
    maps = [store.read(f"fit/{name}", region) for name in PARAMETERS]
    stderr = np.stack([store.read(f"fit/{name}_stderr", region) for name in PARAMETERS])
    covariance = covariance_of(stderr, store.read("fit/correlation", region))
    law = FittedModel.read(store, region).law(maps, without=removed).with_clip(*limits)
    if extra_variance is not None:
        law = law.with_variance(dn2=extra_variance.ravel())
    satellites = fitted_satellites(store, region)
    exposure, gain, bias, sigma = maps
    words = store.read("fit/fit_status", region)
    return Calibration(
        exposure,
        gain,
        bias,
        sigma,
        covariance,
        words,
        law,
        None if satellites is None else np.stack(satellites, axis=1),
    )


def doubtful_pixels(
    store: RunStore, calibration: Calibration, region: tuple[slice, slice] = (slice(None), slice(None))
) -> BoolArray:
    """Return the pixels whose errors the curvature of the likelihood does not give, shape (y, x).

    None of a run of several exposures, which settle the bias, or of one that keeps no histograms.
    """
    if SensorInfo.read(store).samples or not store.has("histogram/counts"):
        return np.zeros(calibration.shape, np.bool_)
    gain = calibration.conversion_gain
    with np.errstate(invalid="ignore"):
        loose = store.read("fit/bias_stderr", region) * gain > _LOOSE_E
        loose &= calibration.read_noise_dn * gain > _NOISY_E
        loose |= store.read("fit/likelihood_gap", region) < _NEAR_RIVAL
    return np.asarray(loose & calibration.usable)


def moments_piece(piece: Piece, output: RunStore, *, job: Job, settings: FitSettings) -> None:
    """Write the errors of g, mu and sigma of some rows, of doubtful pixels by their likelihood.

    Where peaks are apart its maxima are narrow, an electron from each other, and of one gain and read noise:
    what is probable is how many electrons the bias is off. Elsewhere the likelihood is walked.
    """
    from pchem_pipeline.model.fit.api import likelihood_moments  # the fit is much to load

    run, rows = RunStore.open(job.run), slice(piece.y0, piece.y1)
    region, sensor = (rows, slice(None)), SensorInfo.read(run)
    calibration = read_calibration(run, rows)
    names = [*PARAMETERS, "likelihood_gap", "outlier_share"]
    maps = np.stack([run.read(f"fit/{name}", region).ravel() for name in names], axis=-1)
    counts, origin = (run.read(f"histogram/{name}", region) for name in ("counts", "origin"))
    chosen = np.flatnonzero(doubtful_pixels(run, calibration, region))
    covariance = calibration.covariance.reshape(-1, 3, 3).copy()
    rivals = np.zeros((len(maps), 2, 4))
    apart = chosen[~moves_gain(maps[chosen, 0], maps[chosen, 1] * maps[chosen, 3])]
    m, share = electron_shifts(maps[apart, 0], maps[apart, 4], sensor.n_frames)
    off = 1.0 - share[:, m == 0]
    shift = np.sqrt(share @ m[:, None] ** 2 / np.maximum(off, 1e-300)) / maps[apart, 1:2]
    rivals[apart, :, 0] = 0.5 * off
    rivals[apart, :, 1:] = maps[apart, None, 1:4]
    rivals[apart, :, 2] += shift * np.array([-1.0, 1.0])
    chosen = np.setdiff1d(chosen, apart)
    for start in range(0, chosen.size, _BATCH):
        some = chosen[start : start + _BATCH]
        found = likelihood_moments(
            counts.reshape(len(maps), -1)[some],
            origin.ravel()[some],
            maps[some, :-1],
            maps[some, -1],
            law=None if calibration.law.neutral else calibration.law.of(some),
            satellites=calibration.own_satellites[some],
            settings=settings,
            adc_limits=sensor.adc_limits,
        )
        known = np.isfinite(found.covariance).all(axis=(1, 2))
        covariance[some[known]] = found.covariance[known, 1:, 1:]
        rivals[some[known], :, 0] = found.rival_weight[known]
        rivals[some[known], :, 1:] = found.rivals[known, :, 1:]
    ny, nx = calibration.shape
    whole = (*region, slice(None), slice(None))
    output.write("applied_parts/covariance", whole, covariance.reshape(ny, nx, 3, 3))
    output.write("applied_parts/rivals", whole, rivals.reshape(ny, nx, 2, 4))


def with_moments(calibration: Calibration, output: RunStore, rows: slice = slice(None)) -> Calibration:
    """Return a calibration of some rows with the errors that `moments_piece` wrote."""
    region = (rows, *[slice(None)] * 3)
    return replace(
        calibration,
        covariance=output.read("applied_parts/covariance", region),
        rivals=output.read("applied_parts/rivals", region),
    )
