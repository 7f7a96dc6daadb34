"""The arrays of the group ``fit``."""

from __future__ import annotations

from pchem_pipeline.base.variables import FREE_SATELLITES, INTERVALS, interval_names, variables_of
from pchem_pipeline.model.fit.status import MEANINGS
from pchem_pipeline.run.stage import StageContext


def create_fit_maps(context: StageContext) -> None:
    """Make the maps that the fit will have; the words of its status are explained with them."""
    left_out = {"fit_status", *(() if context.model.effects else FREE_SATELLITES)}
    if context.config.fit.intervals == "normal":
        left_out |= {path for name in INTERVALS for path in interval_names(name)}
    context.create_maps([v.path for v in variables_of("fit") if v.name not in left_out])
    context.create_maps(
        ["fit/fit_status"],
        flag_masks=[int(bit) for bit in MEANINGS],
        flag_meanings=" ".join(str(bit.name).lower() for bit in MEANINGS),
        flag_sentences={str(bit.name).lower(): sentence for bit, sentence in MEANINGS.items()},
    )
