"""The arrays of the group ``fit``."""

from __future__ import annotations

from collections.abc import Collection

from pchem_pipeline.base.variables import variables_of
from pchem_pipeline.model.fit.status import MEANINGS
from pchem_pipeline.run.stage import StageContext

__all__ = ["create_fit_maps"]


def create_fit_maps(context: StageContext, left_out: Collection[str] = ()) -> None:
    """Make the maps of the fit, but for those that it does not have; its words are explained with them."""
    skipped = {"fit_status", *left_out}
    context.create_maps([v.path for v in variables_of("fit") if v.name not in skipped])
    context.create_maps(
        ["fit/fit_status"],
        flag_masks=[int(bit) for bit in MEANINGS],
        flag_meanings=" ".join(str(bit.name).lower() for bit in MEANINGS),
        flag_sentences={str(bit.name).lower(): sentence for bit, sentence in MEANINGS.items()},
    )
