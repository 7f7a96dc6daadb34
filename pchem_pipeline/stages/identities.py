"""What stages add to their fingerprints beside settings and upstream stages; light, for ``pchem status``."""

from __future__ import annotations

import math
from typing import Any

from pydantic_core import to_jsonable_python

from pchem_pipeline.base.errors import ConfigError, StoreError
from pchem_pipeline.frames.identity import digest_of
from pchem_pipeline.methods.settings import MethodsSettings
from pchem_pipeline.run.input import known_identity
from pchem_pipeline.run.model_versions import model_versions, with_digest
from pchem_pipeline.run.stage import StageContext
from pchem_pipeline.run.target import find_run
from pchem_pipeline.stages.samples import exposure_axis, sample_facts
from pchem_pipeline.store.run_store import RunStore


def input_content(context: StageContext) -> dict[str, Any]:
    """Return what the content of the input is, see `known_identity`, or what the samples' histograms are.

    Where the files are gone, the last known content counts: what was made of them stays valid.

    Raises:
        InputError: files are missing or bad, and nothing is known of them from before.
    """
    if not context.config.input.samples:
        return {"content": digest_of([file["xxh3_128"] for file in known_identity(context)["files"]])}
    try:
        return sample_facts(context.config, context.base_dir)
    except (ConfigError, StoreError):  # the runs of the samples are gone
        record = context.store.records.known("ingest")
        if record is None or not record.content.get("input"):
            raise
        known: dict[str, Any] = record.content["input"]
        return known


def adc_limits(context: StageContext) -> dict[str, Any]:
    """Return what the files may say and the settings of the fit do not: the limits of the ADC."""
    limits = context.sensor.adc_limits
    return {"adc_limits": None if limits is None else list(limits)}


def fit_inputs(context: StageContext) -> dict[str, Any]:
    """Return what the files say to the fit, and the model."""
    return {**adc_limits(context), "model": context.model.digest}


def integration_time(context: StageContext) -> dict[str, Any]:
    """Return what the files may say and the settings of the maps do not: time, or the samples' exposures."""
    if not context.config.input.samples:
        return {"integration_time": context.sensor.integration_time, "rate": context.charge_rate}
    settings = context.config.input
    x = exposure_axis(settings, context.sensor.samples)
    known = None if x is None else [None if math.isnan(each) else each for each in x.tolist()]
    return {"against": settings.against, "exposures": known, "rate": context.charge_rate}


def verdict(context: StageContext) -> dict[str, str] | None:
    """Return what the report depends on beside its upstream stages: a verdict, a comparison of methods."""
    state, records = discrepancy_state(context.store), context.store.records
    found = {} if state is None else {"discrepancy": state}
    compared = records.known("methods")
    if compared is not None and compared.finished:
        found["methods"] = f"{compared.fingerprint[:8]}, {compared.started}"
    return found or None


def discrepancy_state(store: RunStore) -> str | None:
    """Return which verdict a run has, in words that change when it is redone; None without a readable one."""
    from pchem_pipeline.discrepancy.verdict import read_verdict

    try:
        found = read_verdict(store.path)
    except StoreError:  # the stage that wrote it is stale
        return None
    if found is None:
        return None
    record = store.records.known("discrepancy")
    when = f" ({record.fingerprint[:8]}, {record.started})" if record is not None else ""
    return f"{found.verdict}{when}"


def methods_settings(context: StageContext) -> MethodsSettings:
    """Return the settings of a comparison of methods, those of the command line in place of the section's."""
    section = context.config.methods
    return type(section).model_validate({**section.model_dump(), **_chosen(context)})


def _chosen(context: StageContext) -> dict[str, Any]:
    """Return what the command line chooses, as JSON data; unasked, what it chose for the last result.

    The result of a command with ``--pixels`` is thereby up to date until another one is asked for, whatever
    the YAML says.
    """
    if context.command.settings is not None:
        return dict(to_jsonable_python(dict(context.command.settings)))
    record = context.store.records.known("methods")
    kept = {} if record is None else record.content.get("input") or {}
    return dict(kept.get("chosen", {}))


def other_samples(context: StageContext) -> dict[str, Any]:
    """Return which histograms of other runs join a comparison of methods, and what the command line chose."""
    found: dict[str, Any] = {}
    for name in methods_settings(context).with_runs:
        try:
            record = RunStore.open(find_run(context.base_dir / name).store).records.read("histogram")
        except (ConfigError, StoreError):
            record = None
        found[name] = None if record is None else record.fingerprint
    given = _chosen(context)
    return {**adc_limits(context), "with_runs": found, **({"chosen": given} if given else {})}


def search_start(context: StageContext) -> dict[str, Any]:
    """Return the model that a search starts from, and its region; what it adds itself makes it no staler.

    Where the model in force came from a search that started as the one in the store did, it is the model
    before. The region of a search stays that of the next one, unless this is to be done by force.
    """
    record, model = context.store.records.known("discrepancy"), context.model
    kept = {} if record is None else record.content["input"]
    before = with_digest(model_versions(context.store), kept.get("model"))
    start = model
    if before is not None and (model.source, model.parent) == ("verdict", before.number):
        start = before
    roi = context.command.roi or (() if context.command.force else kept.get("roi", ()))
    return {"model": start.digest, "roi": list(roi)}
