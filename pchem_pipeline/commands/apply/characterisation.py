"""What a run says of its pixels, read from its store."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pchem_pipeline.base.errors import StoreError, quoted
from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.model.law.parameters import FloatArray
from pchem_pipeline.stages.fit.fitted_model import fitted_law, fitted_satellites
from pchem_pipeline.use.calibration import Calibration, covariance_of

if TYPE_CHECKING:
    from pchem_pipeline.store.run_store import RunStore

__all__ = ["check_run", "read_calibration"]


def check_run(store: RunStore) -> str:
    """Return the digest of the fit of a run.

    Raises:
        StoreError: the run is not finished as far as its fit.
    """
    record = store.records.read("fit")
    if (
        record is None
        or not record.finished
        or len(store.records.done("fit", record.fingerprint)) < record.keys
    ):
        raise StoreError(f"{store.path} has no complete fit; run: pchem run {quoted(store.path)}")
    return record.fingerprint


def read_calibration(
    store: RunStore,
    rows: slice = slice(None),
    *,
    removed: Sequence[str] = (),
    extra_variance: FloatArray | None = None,
    top: int | None = None,
) -> Calibration:
    """Return the calibration of some rows.

    Args:
        store: the run.
        rows: of the sensor.
        removed: tags of effects that the frames no longer have.
        extra_variance: of what took them away, DN^2, of these rows (y, x); None: none.
        top: largest code of the ADC, DN: codes there and at 0 are limits; None: not known.
    """
    region = (rows, slice(None))
    maps = [store.read(f"fit/{name}", region) for name in PARAMETERS]
    stderr = np.stack([store.read(f"fit/{name}_stderr", region) for name in PARAMETERS])
    covariance = covariance_of(stderr, store.read("fit/correlation", region))
    law = fitted_law(store, maps, region, without=removed)
    if extra_variance is not None:
        law = law.with_variance(dn2=extra_variance.ravel())
    if top is not None:
        law = law.with_clip(0, top)
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
