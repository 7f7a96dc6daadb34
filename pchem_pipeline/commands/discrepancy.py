"""``pchem discrepancy``: search for what is missing, then bring the rest of the run up to the grown model."""

from __future__ import annotations

from dataclasses import replace

from pchem_pipeline.discrepancy.verdict import VERDICT_FILE, read_verdict
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.session import Command, run_stages, run_status
from pchem_pipeline.run.target import Target, find_run
from pchem_pipeline.stages.discrepancy.summary_text import verdict_text
from pchem_pipeline.store.run_store import RunStore

__all__ = ["find_and_grow"]

_BEFORE = ("ingest", "histogram")
_AFTERWARDS = ("fit", "maps", "ensemble", "report")


def find_and_grow(target: Target, command: Command, *, refit: bool) -> str:
    """Run the stage, and the stages that the grown model makes stale; return the verdict in words.

    Args:
        target: the run.
        command: from the command line.
        refit: bring fit, maps, ensemble and report up to date where they were done before.

    Raises:
        PchEmError: a stage cannot be done.
    """
    missing = [s.stage for s in run_status(target) if s.stage in _BEFORE and s.state != "complete"]
    if "ingest" in missing:
        run_stages(target, ["ingest"], command)
    counted = ["histogram"] if "histogram" in missing and _of_histograms(target) else []
    run_stages(target, [*counted, "discrepancy"], command)
    if command.options.dry_run:
        return ""
    grown = find_run(target.config_path or target.store)
    if refit:
        done = {s.stage for s in run_status(grown) if s.state != "missing"}
        stages = [name for name in _AFTERWARDS if name in done]
        if stages:
            run_stages(grown, stages, without_choice(command))
    found = read_verdict(grown.store)
    assert found is not None
    return f"{verdict_text(found)}\n\n{grown.store / VERDICT_FILE}"


def _of_histograms(target: Target) -> bool:
    """Tell whether a run was made from ready-made histograms: the search looks at them, not at frames."""
    if not (target.store / "zarr.json").exists():
        return False
    store = RunStore.open(target.store)
    return store.has("frames") and SensorInfo.read(store).kind == "histograms"


def without_choice(command: Command) -> Command:
    """Return the command without --force and --roi, which were meant for the search alone."""
    return replace(command, options=replace(command.options, force=False, roi=None))
