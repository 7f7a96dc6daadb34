"""From camera files to the report, through the installed command."""

import json
import shutil
from pathlib import Path

import pytest
from helpers.commands import RUN, assert_same_results

from pchem_pipeline.store.run_store import RunStore

STAGES = ["ingest", "histogram", "fit", "maps", "ensemble", "report"]


def record(store, stage):
    return json.loads((Path(store) / ".pchem" / "stages" / f"{stage}.json").read_text())


def begun(shell):
    """Name the stages that ``log.jsonl`` tells of."""
    events = [json.loads(line) for line in (shell.folder / "log.jsonl").read_text().splitlines()]
    return [event["stage"] for event in events if event["event"] == "start"]


def test_a_folder_of_tiffs_becomes_a_report(shell, frames):
    result = shell.ok(
        "run", *sorted(frames.glob("*.tif")), "--store", "runs/dark.zarr", "--integration-time", "4.87",
        "--log-json", "log.jsonl",
    )  # fmt: skip
    report = shell.folder / "runs" / "dark.zarr" / "report.html"
    assert result.stdout == f"{report}\n"
    assert report.stat().st_size > 100_000
    assert (shell.folder / "runs" / "dark.yaml").exists()
    assert 'id="figure-ensemble"' in report.read_text()
    assert not (report.parent / "figures").exists()  # `pchem figures` draws them for papers
    summary = json.loads((report.parent / "report.json").read_text())
    assert 0.2 < summary["summary"]["read_noise_e"]["median"] < 0.45
    names = "epcd_exact epcd_dependent epcd_independent nuced_dependent nuced_independent noise_floor"
    assert set(names.split()) <= summary["ensemble"]["rmse"].keys()
    assert "fit_status" in summary
    # without a terminal there is no progress bar, only a line per stage
    assert "\r" not in result.stderr
    assert [line.split(":")[0] for line in result.stderr.splitlines() if " s CPU, peak " in line] == STAGES
    assert begun(shell) == STAGES
    again = shell.ok("run", "runs/dark.yaml")
    said = again.stderr.splitlines()
    assert said[:6] == [f"{stage}: up to date" for stage in STAGES]
    assert any(line.startswith("Are these results reliable? ") for line in said)
    assert said[-1].startswith("  pchem ")


def test_a_changed_setting_redoes_just_the_stages_that_read_it(shell, frames, finished):
    shutil.copytree(finished, shell.folder / "run.zarr")
    (shell.folder / "run.yaml").write_text(RUN.replace("4.87", "5"))
    rows = shell.states("run.yaml")
    assert rows["maps"] == "stale - input.integration_time 4.87 → 5.0  (with model 1)"
    assert rows["ensemble"] == "complete  (with model 1)"  # it reads no maps
    assert rows["report"] == "stale - maps is stale  (with model 1)"
    export = shell.ok("export", "run.yaml", "--format", "csv")
    assert export.last.startswith("warning: maps: stale - input.integration_time")
    (shell.folder / "run.yaml").write_text(RUN + "fit: {gap_threshold: 6}\n")
    before = {stage: record(shell.folder / "run.zarr", stage) for stage in STAGES}
    rows = shell.states("run.yaml")
    assert rows["histogram"] == "complete"
    assert rows["fit"] == "stale - fit.gap_threshold 5.0 → 6.0  (with model 1)"
    assert rows["report"].startswith("stale")
    dry = shell.ok("run", "run.yaml", "--dry-run")
    assert "fit: would run (stale - fit.gap_threshold 5.0 → 6.0)" in dry.stderr
    shell.ok("run", "run.yaml", "--until", "ensemble")
    after = {stage: record(shell.folder / "run.zarr", stage) for stage in STAGES}
    same = [stage for stage in STAGES if before[stage] == after[stage]]
    assert same == ["ingest", "histogram", "report"]
    rows = shell.states("run.yaml")
    assert rows["ensemble"] == "complete  (with model 1)"
    assert rows["report"].startswith("stale")


@pytest.mark.parametrize(
    ("tile", "backend", "workers", "mode"), [(64, "processes", 1, "copy"), (8, "distributed", 2, "reference")]
)
def test_neither_tiling_nor_backend_nor_mode_changes_the_answer(
    shell, frames, finished, tile, backend, workers, mode
):
    text = RUN.replace("tile: 8", f"tile: {tile}").replace("bit_depth", f"mode: {mode}, bit_depth")
    (shell.folder / "run.yaml").write_text(text)
    shell.ok("run", "run.yaml", "--until", "ensemble", "--backend", backend, "--workers", workers)
    assert_same_results(finished, shell.folder / "run.zarr", rtol=1e-12)


def test_without_home_and_it_stops_where_it_was_told_to(shell, frames):
    # nowhere to keep compiled kernels: those of one stage will do
    homeless = shell.alone(HOME="/dev/null", XDG_CACHE_HOME="/dev/null")
    del homeless.environment["NUMBA_CACHE_DIR"]
    homeless.ok("run", "frames", "--roi", "0:8,0:8", "--until", "histogram", "--quiet")
    rows = shell.states("run.yaml")
    assert [stage for stage in STAGES if rows[stage] == "complete"] == ["ingest", "histogram"]
    wrong = shell.refused(2, "run", "run.yaml", "--until", "simulate")
    assert wrong == f"pchem: --until simulate: the stages of this run are {', '.join(STAGES)}"
    assert RunStore.open(shell.folder / "run.zarr").read("histogram/counts").sum() == 1200 * 8 * 8
