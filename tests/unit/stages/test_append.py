"""Frames appended to a finished run: what all frames together give, without reading the old ones."""

from unittest.mock import patch

import numpy as np
import pytest
from helpers.commands import arrays_of, assert_equal_arrays, assert_same_results
from helpers.small_stacks import small_stack

from pchem_pipeline.base.errors import InputError, StoreError
from pchem_pipeline.commands.append import append_frames
from pchem_pipeline.compute import memory
from pchem_pipeline.config.load import dump_config
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.frames.sequence import FrameSequence
from pchem_pipeline.run.stage import Command
from pchem_pipeline.run.target import find_run
from pchem_pipeline.runner.session import run_stages, run_status
from pchem_pipeline.stages.fit.fit import kept_fit
from pchem_pipeline.store.run_store import RunStore

QUIET = Command(quiet=True)
GROUPS = ("frames", "histogram", "summary")


@pytest.fixture(scope="module")
def frames():
    stack = small_stack((70, 12), 700, 3)
    stack[650, 5, 6] = 30_000  # a glitch among the new frames
    return stack


def begun(folder, frames, cut, stages=("ingest", "histogram"), **sections):
    """Return a run of the first frames, to whose folder the others have come since."""
    np.save(folder / "f0.npy", frames[:cut])
    run = target(folder, "run.zarr", **sections)
    run_stages(run, stages, QUIET)
    np.save(folder / "f1.npy", frames[cut:])
    return run


def target(folder, store, files=("f*.npy",), **sections):
    content = {"run": {"store": store, "tile": 32}, "input": {"files": list(files), "mode": "reference"}}
    content |= {"histogram": {"window_frames": 64, "block_frames": 96}, "compute": {"workers": 2}}
    for name, values in sections.items():
        content[name] = {**content.get(name, {}), **values}
    path = folder / f"{store}.yaml"
    path.write_text(dump_config(RunConfig.model_validate(content)))
    return find_run(path)


@pytest.mark.parametrize(
    ("cuts", "mode", "summaries"),
    [((301, 650), "reference", True), ((192, 480), "copy", True), ((90,), "copy", False)],
)
def test_the_result_is_that_of_all_frames(tmp_path, monkeypatch, frames, cuts, mode, summaries):
    monkeypatch.setattr("pchem_pipeline.stages.ingest._CHUNK", (32, 16, 16))
    sections = {"input": {"mode": mode}, "histogram": {"summaries": summaries}}
    np.save(tmp_path / "f0.npy", frames[: cuts[0]])
    extended = target(tmp_path, "run.zarr", **sections)
    run_stages(extended, ["ingest", "histogram"], QUIET)
    for number, part in enumerate(np.split(frames, cuts)[1:], 1):
        np.save(tmp_path / f"f{number}.npy", part)
        assert [state.state for state in append_frames(extended, QUIET)] == ["complete", "complete"]
    assert append_frames(extended, QUIET) == []
    whole = target(tmp_path, "whole.zarr", **sections)
    run_stages(whole, ["ingest", "histogram"], QUIET)
    assert_same_results(tmp_path / "run.zarr", tmp_path / "whole.zarr", groups=GROUPS)
    one, other = (RunStore.open(tmp_path / name) for name in ("whole.zarr", "run.zarr"))
    assert one.attributes("frames") == other.attributes("frames")
    for stage in ("ingest", "histogram"):
        assert one.records.read(stage).fingerprint == other.records.read(stage).fingerprint


def test_odd_frames_among_old_and_new_ones_are_in_no_sum(tmp_path, frames):
    """The window of a pixel may be another one, as the empty frames do not keep it where it was."""
    odd = frames.copy()
    odd[[40, 41, 610]] = 0
    odd[[250, 500]] += 300
    append_frames(begun(tmp_path, odd, 301), QUIET)
    run_stages(target(tmp_path, "whole.zarr"), ["ingest", "histogram"], QUIET)
    assert_same_results(tmp_path / "run.zarr", tmp_path / "whole.zarr", groups=("summary",))
    for name in ("whole.zarr", "run.zarr"):
        store = RunStore.open(tmp_path / name)
        assert store.attributes("summary")["left_out"] == [40, 41, 250, 500, 610]
        counts = store.read("histogram/counts").sum(axis=2)
        counts += store.read("histogram/under") + store.read("histogram/over")
        assert (counts == 697).all()


def test_moved_frames_are_found_among_old_and_new_ones(tmp_path, frames):
    moved, at = frames.copy(), [30, 290, 500, 699]
    moved[at] = np.roll(moved[at], 1, axis=2)
    append_frames(begun(tmp_path, moved, 301), QUIET)
    assert RunStore.open(tmp_path / "run.zarr").attributes("summary")["odd_frames"]["moved_x"] == at


def test_old_frames_are_not_read(tmp_path, frames, monkeypatch):
    run = begun(tmp_path, frames, 600)
    assert [state.state for state in run_status(run)][:2] == ["stale", "stale"]  # a look changes nothing
    append_frames(run, Command(dry_run=True, quiet=True))
    seen, real = [], FrameSequence.pieces
    monkeypatch.setattr(
        FrameSequence, "pieces", lambda self, t0, t1: seen.append((t0, t1)) or real(self, t0, t1)
    )
    append_frames(run, QUIET)
    assert sum(min(t1, 600) - t0 for t0, t1 in seen if t0 < 600) <= 48  # the first look
    assert max(t1 for _, t1 in seen) == 700


def test_the_fit_starts_from_the_old_answer_and_ends_at_the_same_maximum(tmp_path, frames):
    run = begun(tmp_path, frames, 400, ("ingest", "histogram", "fit"))
    old = arrays_of(tmp_path / "run.zarr", ("fit",))
    append_frames(run, QUIET)
    start = kept_fit(tmp_path / "run.zarr", (slice(None), slice(None)))
    good = old["fit/fit_status"] == 0
    np.testing.assert_array_equal(np.isfinite(start).all(axis=2), good)
    np.testing.assert_array_equal(start[good][:, 2], old["fit/bias"][good])
    run_stages(run, ["fit"], QUIET)
    assert kept_fit(tmp_path / "run.zarr", (slice(None), slice(None))) is None
    whole = target(tmp_path, "whole.zarr")
    run_stages(whole, ["ingest", "histogram", "fit"], QUIET)
    warm, cold = (arrays_of(tmp_path / name, ("fit",)) for name in ("run.zarr", "whole.zarr"))
    both = good & (cold["fit/fit_status"] == 0)
    assert both.mean() > 0.5
    for name in ("quanta_exposure", "conversion_gain", "bias", "read_noise_dn"):
        sigma = cold[f"fit/{name}_stderr"][both]
        # the stop rule leaves a rise of 1e-8 nats: 1.4e-4 standard errors
        assert np.nanmax(np.abs(warm[f"fit/{name}"] - cold[f"fit/{name}"])[both] / sigma) < 1e-3
        # the answer moved by the new frames, so it is no copy of the old one
        assert np.nanmedian(np.abs(old[f"fit/{name}"] - cold[f"fit/{name}"])[both] / sigma) > 0.05
    assert warm["fit/n_iterations"][both].sum() < 0.6 * cold["fit/n_iterations"][both].sum()


def test_what_cannot_be_appended_is_said(tmp_path, frames, monkeypatch):
    np.save(tmp_path / "f0.npy", frames[:300])
    run = target(tmp_path, "run.zarr")
    with pytest.raises(StoreError, match="ingest is not complete"):
        append_frames(run, QUIET)
    run_stages(run, ["ingest", "histogram"], QUIET)
    np.save(tmp_path / "f1.npy", frames[300:, :, :10])
    with pytest.raises(InputError, match=r"f1\.npy"):
        append_frames(run, QUIET)
    np.save(tmp_path / "f1.npy", frames[300:])
    other = target(tmp_path, "run.zarr", histogram={"block_frames": 64})
    with pytest.raises(StoreError, match="other settings"):
        append_frames(other, QUIET)
    monkeypatch.setattr(memory, "LEAST_BYTES", memory.BASE_BYTES)  # so that a few frames are too many
    short = target(tmp_path, "run.zarr", compute={"max_memory": 261})
    with pytest.raises(StoreError, match="appending needs"):
        append_frames(short, QUIET)
    np.save(tmp_path / "a.npy", frames[:10])
    earlier = target(tmp_path, "run.zarr", files=("a.npy", "f*.npy"))
    with pytest.raises(InputError, match="follow them"):
        append_frames(earlier, QUIET)
    # nothing of that harmed the run; files that were only touched are the same
    (tmp_path / "f0.npy").touch()
    assert [state.state for state in append_frames(target(tmp_path, "run.zarr"), QUIET)] == ["complete"] * 2


def test_more_frames_than_sixteen_bits_can_count(tmp_path):
    frames = np.random.default_rng(1).integers(100, 110, (70_000, 2, 3)).astype(np.uint16)
    run = begun(tmp_path, frames, 60_000, histogram={"window_frames": 4096, "block_frames": 8192})
    assert RunStore.open(tmp_path / "run.zarr").array("histogram/counts").dtype == np.uint16
    append_frames(run, QUIET)
    counts = RunStore.open(tmp_path / "run.zarr").read("histogram/counts")
    assert counts.dtype == np.uint32
    assert (counts.sum(axis=2) == 70_000).all()


@pytest.fixture(scope="module")
def of_all_frames(tmp_path_factory, frames):
    """The arrays of a run that had all frames from the start."""
    folder = tmp_path_factory.mktemp("whole")
    for number, part in enumerate(np.split(frames, [600])):
        np.save(folder / f"f{number}.npy", part)
    run_stages(target(folder, "whole.zarr"), ["ingest", "histogram"], QUIET)
    return arrays_of(folder / "whole.zarr", GROUPS)


@pytest.mark.parametrize(
    "places",
    [
        pytest.param(["commands.append.extend_arrays"], id="before the arrays grow"),
        pytest.param(["commands.append.StackCounter.count"], id="while frames are counted"),
        pytest.param(["commands.append.execute"], id="while tiles are marked"),
        pytest.param(
            ["commands.append.StackCounter.count", "run.sensor.SensorInfo.write"],
            id="and again, when the old frames are gone and all are to be taken",
        ),
    ],
)
def test_a_stopped_one_goes_on_by_the_same_command(tmp_path, frames, of_all_frames, places):
    run = begun(tmp_path, frames, 600, ("ingest", "histogram", "fit"))
    for place in places:
        killed = patch(f"pchem_pipeline.{place}", side_effect=KeyboardInterrupt)
        with killed, pytest.raises(KeyboardInterrupt):
            append_frames(run, QUIET)
    if len(places) > 1:
        assert [state.why for state in run_status(run) if state.stage == "fit"] == ["the run has no input"]
    assert [state.state for state in append_frames(run, QUIET)] == ["complete", "complete"]
    assert append_frames(run, QUIET) == []
    assert_equal_arrays(arrays_of(tmp_path / "run.zarr", GROUPS), of_all_frames)
    assert kept_fit(tmp_path / "run.zarr", (slice(None), slice(None))) is not None
