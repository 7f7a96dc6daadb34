"""The last step of stage ``fit``: what all pixels of the sensor together say about the fit of each."""

from __future__ import annotations

import numpy as np

from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.model.checks.shrinkage import Judged, NoisePool, noise_of
from pchem_pipeline.model.errors.expected_information import CORRELATION_PAIRS
from pchem_pipeline.model.fit.status import FitStatus, moves_gain
from pchem_pipeline.run.stage import StageContext
from pchem_pipeline.store.run_store import RunStore
from pchem_pipeline.store.tiles import equal_rows

_LARGEST_POOL = 2**19  # pixels: every so many-th of a larger sensor
_LARGEST_KEPT = 2**22  # pixels, 24 bytes each


def judge_sensor(context: StageContext) -> int:
    """Set ``WEAKLY_IDENTIFIED`` or ``BIAS_UNSURE`` where a pixel is clear by chance; return the number.

    The latter where a bias that is an electron off leaves the gain as it is. The words depend on the sensor
    as a whole, not on its tiles, and may be given again and again.

    Raises:
        StoreError: the store refuses.
    """
    store, shape = context.store, context.sensor.shape
    bands = [(slice(*rows), slice(0, shape[1])) for rows in equal_rows(shape[0], context.tile[0])]
    every = -(-shape[0] * shape[1] // _LARGEST_POOL)
    kept: dict[int, Judged] = {}  # of a sensor that is not large: nothing is read twice
    chosen = []
    for band in bands:
        pixels = _judged(store, band)
        some = pixels.of(slice(-band[0].start * shape[1] % every, None, every))
        chosen.append(Judged.join([some]))  # a copy: a view would keep the whole band
        if shape[0] * shape[1] <= _LARGEST_KEPT:
            kept[band[0].start] = pixels
    pool = NoisePool.of(Judged.join(chosen))
    weakly, unsure = (np.uint16(int(bit)) for bit in (FitStatus.WEAKLY_IDENTIFIED, FitStatus.BIAS_UNSURE))
    found = 0
    for band in bands:
        words = store.read("fit/fit_status", band)
        new = words & ~(weakly | unsure)
        if pool is not None:
            pixels = kept[band[0].start] if kept else _judged(store, band)
            weak, ambiguous = pool.reasons(pixels, context.config.fit)
            exposure = store.read("fit/quanta_exposure", band).ravel()
            of_gain = bool(context.sensor.samples) | moves_gain(exposure, pixels.noise)
            weak |= ambiguous & of_gain
            new[weak.reshape(words.shape)] |= weakly
            new[(ambiguous & ~of_gain).reshape(words.shape)] |= unsure
            found += int(np.count_nonzero(weak | ambiguous))
        if not np.array_equal(new, words):
            store.write("fit/fit_status", band, new)
    return found


def _judged(store: RunStore, band: tuple[slice, slice]) -> Judged:
    """Return the pixels of a band, in order; NaN where they are not fitted."""
    names = ("conversion_gain", "read_noise_dn")
    fit = store.at(band, "fit")
    pair = CORRELATION_PAIRS.index(tuple(map(PARAMETERS.index, names)))
    gain, sigma = (fit[name].ravel() for name in names)
    of_gain, of_sigma = (fit[f"{name}_stderr"].ravel() for name in names)
    together = store.read("fit/correlation", (*band, slice(pair, pair + 1))).ravel()
    return Judged(*noise_of(gain, sigma, of_gain, of_sigma, together), fit["likelihood_gap"].ravel())
