"""The histogram stage on a store: exact arrays, whatever the tiles, the memory and the workers."""

import numpy as np
import pytest
from helpers.commands import arrays_of
from helpers.commands import assert_equal_arrays as assert_equal
from helpers.drawn_pixels import codes
from helpers.pickled_tasks import PickledTasks
from helpers.stage_runs import completed, stage_context

from pchem_pipeline.base.errors import StoreError
from pchem_pipeline.compute.executor import make_executor
from pchem_pipeline.compute.settings import ComputeSettings
from pchem_pipeline.model.histogram.count import histogram_frames
from pchem_pipeline.model.histogram.summaries import SummaryAccumulator
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.stage import Command
from pchem_pipeline.runner.execute import execute
from pchem_pipeline.stages.bands import plan_bands
from pchem_pipeline.stages.histogram import arrays, histogram
from pchem_pipeline.store.records import StageRecord

FRAMES, NY, NX = 300, 150, 40


@pytest.fixture(scope="module")
def frames():
    rng = np.random.default_rng(30)
    bias = rng.normal(100, 6, (NY, NX))
    dn = codes(rng, (FRAMES, NY, NX), 1.5, 11, 0.3, bias).astype(np.uint16)
    dn[250, 3, 4] = 60000  # glitches
    dn[100, 140, 39] = 4000
    return dn


def ingest(store, info, frames):
    """What the ingest stage leaves behind."""
    info.write(store)
    if frames is not None:
        store.create_array("frames/dn", frames.shape, chunks=(64, 128, 128), dtype=frames.dtype)
        store.write("frames/dn", (slice(None),) * 3, frames)
    store.records.write(StageRecord("ingest", 1, "abc", {}, keys=1))
    store.records.mark("ingest", "abc", "all", {})


def make_context(folder, frames, *, mode="reference", executor=None, command=None, tile=64, **settings):
    folder.mkdir(exist_ok=True)
    if not (folder / "frames.npy").exists():
        np.save(folder / "frames.npy", frames)
    sections = {"run": {"tile": tile}, "input": {"files": ["frames.npy"], "mode": mode}}
    sections["histogram"] = {"block_frames": 128, "window_frames": 64, **settings}
    context = stage_context(folder, executor, command, **sections)
    if not context.store.records.read("ingest"):
        info = SensorInfo("frames", *frames.shape, str(frames.dtype), None, None, mode, {})
        ingest(context.store, info, frames if mode == "copy" else None)
    return context


def contents(context):
    return arrays_of(context.store.path, ("histogram", "summary"))


@pytest.fixture(scope="module")
def expected(tmp_path_factory, frames):
    found = contents(completed(make_context(tmp_path_factory.mktemp("expected"), frames), "histogram"))
    assert {"histogram/counts", "summary/frame_mean", f"summary/{arrays.COVARIANCES[0]}"} < found.keys()
    return found


def test_arrays_are_right(frames, expected):
    direct = histogram_frames(frames, bins=expected["histogram/counts"].shape[2], window_frames=64)
    for name, values in vars(direct).items():
        np.testing.assert_array_equal(expected[f"histogram/{name}"], values, err_msg=name)
    assert direct.over.sum() == 2
    exact = frames.astype(np.int64)
    starts = [0, 128, 256]
    for name, values in {
        "block_start": starts,
        "block_sum": np.add.reduceat(exact, starts),
        "block_sum_square": np.add.reduceat(exact**2, starts),
        "row_sum": exact.sum(axis=2),
        "row_sum_square": (exact**2).sum(axis=2),
        "column_sum": np.add.reduceat(exact, [0, 64, 128], axis=1),
    }.items():
        np.testing.assert_array_equal(expected[f"summary/{name}"], values, err_msg=name)
    np.testing.assert_allclose(expected["summary/frame_mean"], exact.mean(axis=(1, 2)), rtol=1e-14)
    np.testing.assert_allclose(expected["summary/frame_variance"], exact.var(axis=(1, 2)), rtol=1e-11)
    summaries = SummaryAccumulator((NY, NX), 128)
    summaries.add(frames)
    for name, values in summaries.finish()[1].items():
        np.testing.assert_array_equal(expected[f"summary/{name}"], values, err_msg=name)


THREADS = make_executor(ComputeSettings(backend="threads", workers=3))


@pytest.mark.parametrize(
    ("mode", "tile", "memory", "executor"),
    [
        ("copy", 64, 384, PickledTasks()),
        ("copy", 256, 16, None),
        ("reference", 8, 16, THREADS),
        ("reference", 64, 384, PickledTasks()),
    ],
)
def test_result_depends_on_neither_tile_nor_memory_nor_mode_nor_backend(
    tmp_path, frames, expected, mode, tile, memory, executor
):
    sections = {"mode": mode, "tile": tile, "band_memory": memory, "executor": executor}
    context = completed(make_context(tmp_path, frames, **sections), "histogram")
    assert_equal(contents(context), expected)
    # large tiles are one file each, and read in parts
    counts = context.store.array("histogram/counts")
    assert counts.shards == ((NY, NX, counts.shape[2]) if tile == 256 else None)
    assert counts.chunks[:2] == {256: (15, NX), 64: (64, NX)}.get(tile, (tile, tile))


def test_tiles_then_the_rest(tmp_path, frames, expected):
    part = make_context(tmp_path, frames, command=Command(roi=(64, 128, 0, 1)))
    state = execute("histogram", part)
    assert (state.state, state.done, state.total) == ("partial", 1, 3)
    assert not part.store.has("summary/frame_mean")
    np.testing.assert_array_equal(
        part.store.read("histogram/counts")[64:128], expected["histogram/counts"][64:128]
    )
    rest = completed(make_context(tmp_path, frames), "histogram")
    assert_equal(contents(rest), expected)
    # the memory of bands does not make it stale
    before = rest.store.records.read("histogram")
    execute("histogram", make_context(tmp_path, frames, band_memory=99))
    assert rest.store.records.read("histogram") == before


def test_a_failed_band_leaves_the_others_and_resumes(tmp_path, frames, expected, monkeypatch):
    context = make_context(tmp_path, frames, band_memory=16)
    real = histogram.FrameStream

    def breaks(source, rows, step, threads=1):
        if rows[0][0] == 64:
            raise ValueError("odd rows")
        return real(source, rows, step, threads=threads)

    monkeypatch.setattr(histogram, "FrameStream", breaks)
    single = plan_bands(context.tiles(), {t.key for t in context.tiles()}, 1, 1)
    monkeypatch.setattr(histogram, "plan_bands", lambda *a: single)
    state = execute("histogram", context)
    assert state.state == "failed"
    assert "odd rows" in state.why
    monkeypatch.undo()
    again = completed(make_context(tmp_path, frames), "histogram")
    assert_equal(contents(again), expected)
    assert any("2 pixels have samples outside" in note for note in again.notes)


def test_without_summaries(tmp_path, frames, expected):
    context = completed(make_context(tmp_path, frames, summaries=False), "histogram")
    np.testing.assert_array_equal(context.store.read("histogram/counts"), expected["histogram/counts"])
    assert not context.store.has("summary/row_sum")
    assert "summaries" in context.store.attributes("summary")["missing"]


def test_too_little_memory_is_said_and_incomplete_input_refused(tmp_path):
    wide = np.zeros((70, 3, 12000), np.uint8)
    context = completed(make_context(tmp_path, wide, tile=256, band_memory=16, window_frames=70), "histogram")
    assert any("more than histogram.band_memory" in note for note in context.notes)
    context.store.records.write(StageRecord("ingest", 1, "abc", {}, keys=2))
    context.store.records.forget("histogram")
    with pytest.raises(StoreError, match="not complete"):
        execute("histogram", context)


def test_ready_made_histograms_are_copied(tmp_path):
    (tmp_path / "a.csv").write_text("DN,count\n10,5\n11,0\n12,7\n")
    (tmp_path / "b.csv").write_text("DN,count\n-3,1\n5,70000\n")
    context = stage_context(tmp_path, input={"files": ["a.csv", "b.csv"], "format": "histogram"})
    store = context.store
    ingest(store, SensorInfo("histograms", 70001, 1, 2, "uint32", None, None, "copy", {}), None)
    completed(context, "histogram")
    counts = store.read("histogram/counts")
    assert counts.dtype == np.uint32
    assert counts.sum(axis=2).tolist() == [[12, 70001]]
    found = [store.read(f"histogram/{name}").tolist() for name in ("origin", "minimum", "maximum")]
    assert found == [[[10, -3]], [[10, -3]], [[12, 5]]]
    assert "order in time" in store.attributes("summary")["missing"]


def test_odd_frames_are_in_no_sums_and_empty_ones_in_no_histogram(tmp_path, frames):
    """Sums are those of the rest, whatever was odd; done twice they are the same."""
    odd = frames.copy()
    odd[:2] += 400
    odd[130:133] = 0
    odd[290, 3, 4:9] = 60_000  # the track of a particle is no odd frame
    context = make_context(tmp_path / "odd", odd)
    for _ in range(2):
        completed(context, "histogram")
        left_out = [0, 1, 130, 131, 132]
        assert context.store.attributes("summary")["left_out"] == left_out
        found = contents(context)
        total = sum(found[f"histogram/{name}"] for name in ("under", "over"))
        np.testing.assert_array_equal(found["histogram/counts"].sum(axis=2) + total, len(odd) - 3)
        np.testing.assert_array_equal(
            found["histogram/minimum"], np.delete(odd, slice(130, 133), 0).min(axis=0)
        )
        blocks = [np.delete(odd.astype(np.int64), left_out, 0)[part] for part in np.s_[:126, 126:251, 251:]]
        sums = np.stack([block.sum(axis=0) for block in blocks])
        np.testing.assert_array_equal(found["summary/block_sum"], sums)
        summed = dict.fromkeys(arrays.COVARIANCES, 0.0)
        for block in blocks:
            summaries = SummaryAccumulator((NY, NX), len(block))
            summaries.add(block.astype(np.uint16))
            for name, values in summaries.finish()[1].items():
                summed[name] = summed[name] + values * (len(block) - 1)
        for name, values in summed.items():
            right = values / (len(odd) - 5 - 3)
            np.testing.assert_allclose(found[f"summary/{name}"], right, rtol=1e-6, atol=1e-6)
        context.store.records.forget("histogram")
    assert any("frames 130 to 132 are empty" in note for note in context.notes)


def test_copies_are_in_no_histogram_and_odd_frames_in_no_spectrum(tmp_path, frames):
    doubled = np.repeat(frames[:100], 2, axis=0)
    doubled[40:44, NY // 2 :] = 0
    single = np.delete(doubled[::2], [20, 21], 0)
    found, expected = (
        make_context(tmp_path / str(len(each)), each, tile=32, window_frames=256)
        for each in (doubled, single)
    )
    for context in (found, expected):
        completed(context, "histogram")
    odd = found.store.attributes("summary")["odd_frames"]
    assert (odd["copied"], odd["far"]) == (list(range(1, 200, 2)), [40, 42])
    one, other = (context.store.attributes("summary")["spectrum"] for context in (found, expected))
    assert one == pytest.approx(other, rel=1e-4)
    counted = sum(found.store.read(f"histogram/{name}") for name in ("under", "over"))
    assert (found.store.read("histogram/counts").sum(axis=2) + counted == 100).all()
    np.testing.assert_array_equal(found.store.read("histogram/maximum"), doubled[::2].max(axis=0))


@pytest.mark.parametrize(
    "frames",
    [
        np.full((400, 16, 16), 7, np.uint16),  # all equal: no copies
        # four quiet pixels, all at 100 DN in a third of the frames, as their histograms say
        100 + (np.random.default_rng(4).random((400, 2, 2)) < 0.25).astype(np.uint16),
    ],
)
def test_frames_of_a_quiet_sensor_are_neither_copies_nor_empty(tmp_path, frames):
    store = completed(make_context(tmp_path, frames), "histogram").store
    assert store.attributes("summary")["left_out"] == []
    assert (store.read("histogram/counts").sum(axis=2) == 400).all()
