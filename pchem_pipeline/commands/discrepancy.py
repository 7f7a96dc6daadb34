"""``pchem discrepancy``: search for what is missing, then bring the rest of the run up to the model found."""

from __future__ import annotations

from dataclasses import replace

from pchem_pipeline.base.errors import StoreError
from pchem_pipeline.commands.model import adopt_verdict, yaml_of
from pchem_pipeline.config.edit import check_writable
from pchem_pipeline.discrepancy.verdict import VERDICT_FILE, read_verdict
from pchem_pipeline.run.progress import Reporter
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.target import Target
from pchem_pipeline.runner.session import Command, run_stages, run_status
from pchem_pipeline.stages.discrepancy.summary_text import verdict_text

_BEFORE = ("ingest", "histogram")
_AFTERWARDS = ("fit", "maps", "ensemble", "report")


def find_and_add(target: Target, command: Command, *, refit: bool, effort: float | None = None) -> str:
    """Search for effects, add those named to the model, and fit with it; return the verdict as text.

    Args:
        target: the run.
        command: from the command line.
        refit: make the verdict's model a version, unless ``discrepancy.add`` is off, and bring fit, maps,
            ensemble and report up to date where they were done before; else model and YAML stay.
        effort: in place of the configuration's ``discrepancy.effort``; None: as that has it.

    Raises:
        PchEmError: a stage cannot be done.
    """
    if effort is not None:
        target = target.changed("discrepancy", effort=effort)
    add = refit and target.config.discrepancy.add
    path = yaml_of(target) if add else None
    if path is not None:
        check_writable(path)
    missing = [s.stage for s in run_status(target) if s.stage in _BEFORE and s.state != "complete"]
    if "ingest" in missing:
        run_stages(target, ["ingest"], command)
    counted = ["histogram"] if "histogram" in missing and _of_histograms(target) else []
    run_stages(target, [*counted, "discrepancy"], command)
    if command.options.dry_run:
        return ""
    if add:
        target, words = adopt_verdict(target)
        if words:
            written = "" if path is None else f" (added to {path})"
            Reporter(command.progress, quiet=command.quiet, log=command.log_json).info(words + written)
    if refit:
        done = {s.stage for s in run_status(target) if s.state != "missing"}
        stages = [name for name in _AFTERWARDS if name in done]
        if stages:
            run_stages(target, stages, without_choice(command))
    found = read_verdict(target.store)
    if found is None:
        raise StoreError(f"{target.store / VERDICT_FILE} is missing; run pchem discrepancy again")
    return f"{verdict_text(found)}\n\n{target.store / VERDICT_FILE}"


def _of_histograms(target: Target) -> bool:
    """Tell whether the search looks at histograms, not at frames: ready-made ones, or several samples'."""
    if not target.store.exists():
        return False
    store = target.stored()
    return store.has("frames") and SensorInfo.read(store).kind != "frames"


def without_choice(command: Command) -> Command:
    """Return the command without --force and --roi, which were meant for the search alone."""
    return replace(command, options=replace(command.options, force=False, roi=None))
