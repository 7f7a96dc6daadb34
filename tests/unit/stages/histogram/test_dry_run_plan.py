"""Bands cover the sensor and keep to the memory allowed; the plan of a run says so before it starts."""

import json
import subprocess
import sys

import numpy as np
import pytest
from helpers import layouts
from helpers.drawn_pixels import codes
from hypothesis import given
from hypothesis import strategies as st

from pchem_pipeline.compute.memory import BASE_BYTES
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.model.histogram.summaries import ROW_GROUP
from pchem_pipeline.run.stage import allowed_bytes, band_bytes
from pchem_pipeline.stages.bands import plan_bands
from pchem_pipeline.stages.histogram.arrays import bytes_per_row, row_frames, single_pass_bytes
from pchem_pipeline.stages.histogram.dry_run import make_plan
from pchem_pipeline.store.tiles import tile_grid

#: counts a run in a process of its own, and prints the memory that it took
PROGRAM = """
import json, sys
from pchem_pipeline.compute.environment import peak_rss_bytes, prepare_environment
prepare_environment()
from pathlib import Path
from pchem_pipeline.run.stage import Command
from pchem_pipeline.runner.session import run_stages
from pchem_pipeline.run.target import find_run
target = find_run(Path(sys.argv[1]))
states = run_stages(target, ["ingest", "histogram"], Command(quiet=True))
print(json.dumps([peak_rss_bytes(), *[state.state for state in states]]))
"""


def camera(folder, n_frames, **compute):
    """Write a raw file of some frames of 256 x 256 pixels, repeated; return its YAML, and what that says."""
    block = codes(np.random.default_rng(5), (32, 256, 256), 1.5, 11, 0.3).astype(np.uint16)
    layouts.raw(folder / f"{n_frames}.raw", np.tile(block, (n_frames // len(block), 1, 1)))
    files = {"files": [f"{n_frames}.raw"], "mode": "reference"}
    content = {"run": {"store": f"{n_frames}.zarr"}, "input": files, "compute": compute}
    path = folder / f"{n_frames}.yaml"
    path.write_text(json.dumps(content))
    return path, RunConfig.model_validate(content)


@pytest.mark.parametrize(("limit", "lengths"), [(None, (256, 1024)), (320, (256,))])
def test_memory_is_what_was_said_whatever_the_number_of_frames(tmp_path, limit, lengths):
    peaks = []
    for n_frames in lengths:
        path, config = camera(tmp_path, n_frames, workers=2, max_memory=limit)
        plan = make_plan(config, tmp_path)
        assert plan.single_pass == (limit is None)
        said = single_pass_bytes(config, (n_frames, 256, 256), np.dtype(np.uint16), plan.bins)
        command = [sys.executable, "-c", PROGRAM, str(path)]
        outcome = subprocess.run(command, capture_output=True, text=True, timeout=300)
        assert outcome.returncode == 0, outcome.stderr
        peak, *states = json.loads(outcome.stdout)
        assert states == ["complete", "complete"]
        assert 0.5 * said < peak < 1.2 * (said if limit is None else limit << 20)
        assert peak < 1.2 * plan.held_bytes
        peaks.append(peak)
    # the longer file is 100 MB longer than the shorter one
    assert abs(peaks[-1] - peaks[0]) < 60e6


def test_the_plan_in_words(tmp_path):
    _, config = camera(tmp_path, 512, workers=3, max_memory=2000)
    plan = make_plan(config, tmp_path)
    assert plan.single_pass
    text = "\n".join(plan.lines)
    assert "plan: 512 frames of 256 x 256 pixels, 16 tiles of 64 x 64, " in text
    assert text.splitlines()[0].endswith(" bins, 3 workers")
    assert "plan: frames stay in their files (0.067 GB); the store will hold about 0.034 GB" in text
    assert "2000 MiB allowed" in text
    less = config.model_copy(update={"compute": config.compute.model_copy(update={"max_memory": 64})})
    copies = config.model_copy(update={"input": config.input.model_copy(update={"mode": "copy"})})
    assert "frames are copied from their files (0.067 GB); the store" in make_plan(copies, tmp_path).lines[1]
    assert "twice, in bands of rows" in make_plan(less, tmp_path).lines[1]


def test_the_limit_is_shared_by_the_workers():
    config = RunConfig.model_validate({"input": {"files": ["a"]}, "compute": {"max_memory": 1000}})
    assert allowed_bytes(config, 4) == 1000 << 20
    assert BASE_BYTES + 4 * band_bytes(config, 4) <= 1000 << 20
    free = RunConfig.model_validate({"input": {"files": ["a"]}})
    assert allowed_bytes(free, 4) >= BASE_BYTES + 4 * (640 << 20)
    # what a row needs does not depend on the number of frames, so neither do the plans
    few, many = (bytes_per_row(512, n_frames, 2, 64, free.histogram) for n_frames in (5000, 60_000))
    assert few == many


@pytest.mark.parametrize(
    ("limit", "allowed", "mebibytes"),
    [(None, None, 640), (8192, None, 640), (400, None, 140), (200, None, 16), (400, 440, 90), (300, 640, 40)],
)
def test_a_band_fits_into_the_memory_of_a_worker_and_of_the_run(limit, allowed, mebibytes):
    content = {"input": {"files": ["a.raw"]}, "compute": {"max_memory": allowed}}
    config = RunConfig.model_validate(content)
    assert band_bytes(config, 2, None if limit is None else limit << 20) == mebibytes << 20


@given(
    ny=st.integers(1, 1200),
    tile=st.sampled_from([8, 16, 32, 64, 128, 256]),
    most=st.integers(0, 1500),
    workers=st.integers(1, 9),
    together=st.sampled_from([1, 7, 64, 100, 128, 1200]),
    data=st.data(),
)
def test_bands_are_sound(ny, tile, most, workers, together, data):
    tiles = tile_grid((ny, 20), tile)
    pending = data.draw(st.sets(st.sampled_from([t.key for t in tiles])))
    bands = plan_bands(tiles, pending, most, workers, together)
    assert [bands[0].y0, *(b.y1 for b in bands)] == [*(b.y0 for b in bands), ny]
    assert [key for band in bands for key in band.keys] == [t.key for t in tiles]
    step = max(tile, ROW_GROUP)
    for band in bands:
        assert band.y0 < band.y1
        assert band.y0 % tile == 0
        assert band.y0 % ROW_GROUP == 0
        assert band.y1 - band.y0 <= max(most, min(ny, step))
        for t in tiles:
            assert (band.y0 <= t.y0 < t.y1 <= band.y1) == (t.key in band.keys)


@pytest.mark.parametrize(
    ("most", "workers", "rows_per_read", "n_bands"),
    [
        (10_000, 1, 1, 1),
        (10_000, 2, 1, 2),
        (130, 2, 1, 4),
        (1, 2, 1, 8),
        # rows that are decoded together stay together
        (10_000, 8, 128, 4),
        (10_000, 8, 512, 1),
        (10_000, 2, 500, 1),
        # odd strips: each worker keeps its band, at the price of a few strips decoded twice
        (10_000, 4, 27, 4),
        (10_000, 4, 96, 4),
        # unless memory forbids
        (64, 8, 512, 8),
    ],
)
def test_memory_workers_and_strips_decide_the_height(most, workers, rows_per_read, n_bands):
    tiles = tile_grid((512, 128), 64)
    everything = {tile.key for tile in tiles}
    assert len(plan_bands(tiles, everything, most, workers, rows_per_read=rows_per_read)) == n_bands


def test_only_pending_rows_are_joined():
    tiles = tile_grid((512, 128), 64)
    bands = plan_bands(tiles, {"2.0", "3.1", "4.0"}, 10_000, 1)
    assert [(band.y0, band.y1) for band in bands if "2.0" in band.keys] == [(128, 320)]
    assert len(bands) == 6


def test_row_sums_of_tall_sensors_are_read_in_smaller_pieces():
    assert row_frames(512) == 4096
    assert row_frames(10_000) * 10_000 * 16 < 2**28
    assert row_frames(200_000) > 0
