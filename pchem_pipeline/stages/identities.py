"""What stages add to their fingerprints beside settings and upstream stages; light, for ``pchem status``."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from pchem_pipeline.run.input_identity import known_identity

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pchem_pipeline.run.stage import StageContext
    from pchem_pipeline.store.run_store import RunStore

__all__ = [
    "adc_limits",
    "fit_inputs",
    "input_content",
    "integration_time",
    "known_added_exposure",
    "other_samples",
    "search_start",
    "verdict",
]


def input_content(context: StageContext) -> dict[str, Any]:
    """Return what the content of the input is.

    The files are hashed once; afterwards names, sizes and times of change are compared first, and they are
    hashed again only where these differ. Where the files are gone, the last known content counts: what was
    made of them stays valid.

    Raises:
        InputError: files are missing or bad, and nothing is known of them from before.
    """
    if context.config.input.samples:
        return _sample_content(context)
    from pchem_pipeline.frames.identity import digest_of

    identity = known_identity(context)
    return {"content": digest_of([file["xxh3_128"] for file in identity["files"]])}


def _sample_content(context: StageContext) -> dict[str, Any]:
    """Return what the histograms of the samples are; as last known where their runs are gone."""
    from pchem_pipeline.base.errors import ConfigError, StoreError
    from pchem_pipeline.stages.samples import sample_facts

    try:
        return sample_facts(context.config, context.base_dir)
    except (ConfigError, StoreError):
        record = context.store.records.read("ingest")
        if record is None or not record.content.get("input"):
            raise
        known: dict[str, Any] = record.content["input"]
        return known


def adc_limits(context: StageContext) -> dict[str, Any]:
    """Return what the files may say and the settings of the fit do not: the limits of the ADC."""
    limits = context.adc_limits
    return {"adc_limits": None if limits is None else list(limits)}


def fit_inputs(context: StageContext) -> dict[str, Any]:
    """Return what the files say to the fit, and which exposure the effects of the model add to pixels."""
    effects = [effect.model_dump(mode="json") for effect in context.config.model.effects]
    digest = known_added_exposure(context.store, effects)
    return {**adc_limits(context), **({} if digest is None else {"added_exposure": digest})}


def known_added_exposure(store: RunStore, effects: Sequence[dict[str, Any]]) -> str | None:
    """Return the digest of the exposure that effects add to pixels; None where none is known of them.

    Args:
        store: the run.
        effects: of a model, as JSON data.
    """
    attributes = store.attributes("discrepancy/added_exposure")
    if not attributes or any(effect not in effects for effect in attributes["effects"]):
        return None
    return str(attributes["digest"])


def integration_time(context: StageContext) -> dict[str, Any]:
    """Return what the files may say and the settings of the maps do not: time, or the samples' exposures."""
    if not context.config.input.samples:
        return {"integration_time": context.integration_time}
    from pchem_pipeline.stages.samples import exposure_axis

    settings = context.config.input
    x = exposure_axis(settings, context.sensor.samples)
    known = None if x is None else [None if math.isnan(each) else each for each in x.tolist()]
    return {"against": settings.against, "exposures": known}


def verdict(context: StageContext) -> dict[str, str] | None:
    """Return what the report depends on beside its upstream stages: a verdict, a comparison of methods."""
    from pchem_pipeline.stages.discrepancy.result import discrepancy_state

    state = discrepancy_state(context.store)
    found = {} if state is None else {"discrepancy": state}
    compared = context.store.records.read("methods")
    if compared is not None and compared.finished:
        found["methods"] = f"{compared.fingerprint[:8]}, {compared.started}"
    return found or None


def other_samples(context: StageContext) -> dict[str, Any]:
    """Return which other runs join a comparison of methods, and their state."""
    from pchem_pipeline.stages.methods import other_runs

    return {**adc_limits(context), "with_runs": other_runs.other_samples(context)}


def search_start(context: StageContext) -> dict[str, Any]:
    """Return the model that a search starts from: what it adds itself makes it no staler."""
    name = "discrepancy"
    present = [effect.model_dump(mode="json") for effect in context.config.model.effects]
    kept = context.store.attributes(name) if context.store.has(name) else {}
    if kept.get("model_after") == present:
        present = kept["model_before"]
    return {"model": present, "roi": list(context.options.roi or kept.get("roi") or ())}
