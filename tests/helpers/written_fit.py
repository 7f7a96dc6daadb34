"""What the stage fit leaves behind, written with the truth as its estimate."""

from collections.abc import Sequence

import numpy as np

from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.run.stage import StageContext
from pchem_pipeline.store.records import StageRecord


def write_fit(
    context: StageContext, status: np.ndarray, lost: np.ndarray, tiles: Sequence[str] | None = None
) -> None:
    """Write the group fit, and its record with the markers of its tiles.

    Args:
        context: of a simulated run.
        status: words of the pixels, shape (y, x).
        lost: pixels without a value, shape (y, x).
        tiles: keys of those that are fitted; None: all.
    """
    store, chosen = context.store, [t for t in context.tiles() if tiles is None or t.key in tiles]
    missing = np.ones(lost.shape, dtype=bool)
    for tile in chosen:
        missing[tile.region] = lost[tile.region]
    y0, _, x0, _ = context.config.input.roi or (0, 0, 0, 0)
    region = (slice(y0, y0 + lost.shape[0]), slice(x0, x0 + lost.shape[1]))
    for name in PARAMETERS:
        values = np.where(missing, np.nan, store.read(f"truth/{name}", region))
        store.write_array(f"fit/{name}", values)
        store.write_array(f"fit/{name}_stderr", 0.01 * np.abs(values))
    store.write_array("fit/correlation", np.zeros((*lost.shape, 6)))
    known = {"goodness_chi2": 50.0, "goodness_dof": 50.0, "goodness_p": 0.5, "likelihood_gap": 100.0}
    for name, value in known.items():
        store.write_array(f"fit/{name}", np.where(missing, np.nan, value))
    store.write_array("fit/outlier_share", np.zeros(lost.shape))
    store.write_array("fit/fit_status", status)
    store.records.write(StageRecord("fit", 1, "truth", {}, keys=len(context.tiles())))
    for tile in chosen:
        store.records.mark("fit", "truth", tile.key, {})
