"""``pchem discrepancy``: search for what is missing, then bring the rest of the run up to the model found."""

from __future__ import annotations

from dataclasses import replace

from pchem_pipeline.base.errors import StoreError
from pchem_pipeline.base.wording import measured, symbol
from pchem_pipeline.commands.model import adopt_verdict
from pchem_pipeline.discrepancy.verdict import VERDICT_FILE, read_verdict
from pchem_pipeline.report.pages.summary import KEY_MAPS
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.stage import Command
from pchem_pipeline.run.target import Target
from pchem_pipeline.runner.session import run_stages, run_status
from pchem_pipeline.stages.discrepancy.summary_text import verdict_text


def find_and_add(target: Target, command: Command, *, refit: bool, effort: float | None = None) -> str:
    """Search for effects, add those named to the model, and fit with it; return the verdict as text.

    With ``refit`` the verdict's model becomes a version, unless ``discrepancy.add`` is off, and fit, maps,
    ensemble and report are brought up to date where they were done before; else model and YAML stay.
    ``effort`` replaces ``discrepancy.effort`` of the configuration.

    Raises:
        PchEmError: a stage cannot be done.
    """
    if effort is not None:
        target = target.changed("discrepancy", effort=effort)
    add = refit and target.config.discrepancy.add
    missing = {state.stage for state in run_status(target) if state.state != "complete"}
    if "ingest" in missing:
        run_stages(target, ["ingest"], command)
    counted = ["histogram"] if "histogram" in missing and _of_histograms(target) else []
    run_stages(target, [*counted, "discrepancy"], command)
    if command.dry_run:
        return ""
    words, before = "", _medians(target)
    if add:
        target, words = adopt_verdict(target)
        if words:
            command.reporter().info(words)
    if refit:
        done = {s.stage for s in run_status(target) if s.state != "missing"}
        stages = [name for name in ("fit", "maps", "ensemble", "report") if name in done]
        if stages:
            # --force and --roi were meant for the search alone
            run_stages(target, stages, replace(command, force=False, roi=None))
    found = read_verdict(target.store)
    if found is None:
        raise StoreError(f"{target.store / VERDICT_FILE} is missing; run pchem discrepancy again")
    changed = _changed_medians(before, _medians(target)) if words else []
    return "\n".join([verdict_text(found), *changed, "", str(target.store / VERDICT_FILE)])


def _medians(target: Target) -> dict[str, tuple[float, float]]:
    """Return median and standard error of the maps of a run; none where it has no maps."""
    summary = target.stored().attributes("maps").get("summary", {})
    found = {
        name: (summary[name]["median"], summary[name]["median_stderr"])
        for name in KEY_MAPS
        if name in summary
    }
    return {name: pair for name, pair in found.items() if None not in pair}


def _changed_medians(
    before: dict[str, tuple[float, float]], after: dict[str, tuple[float, float]]
) -> list[str]:
    """Say what the medians were and are, a line each."""
    both = [(symbol(name)[1:], before[name], after[name]) for name in before if name in after]
    wide = max((len(words) for (words, _), *_ in both), default=0)
    lines = [
        f"  median {words:<{wide}}  {measured(*old)} → {measured(*new, unit)}"
        for (words, unit), old, new in both
    ]
    return ["", "fitted with the new model:", *lines] if lines else []


def _of_histograms(target: Target) -> bool:
    """Return whether the search looks at histograms, not at frames: ready-made ones, or several samples'."""
    if not target.store.exists():
        return False
    store = target.stored()
    return store.has("frames") and SensorInfo.read(store).kind != "frames"
