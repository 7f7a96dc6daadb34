"""Byte order, left-justified samples and a last axis that is time are seen in some samples at ingest."""

import json

import h5py
import numpy as np
import pytest
import zarr
from helpers import layouts
from helpers.camera_files import not_opened, opened, read
from helpers.drawn_pixels import codes
from helpers.plain_camera import LAYOUTS, PlainCamera

from pchem_pipeline.frames.first_look import limits_in

#: hardly any pattern: 5 % in the light, a DN in the bias
SPREAD = (0.05, 0.005, 0.05, 1.0)


def notes_on(path, frames):
    codes = np.rint(frames).clip(0, 65535).astype(np.uint16)
    if path.suffix == ".npy":
        np.save(path, codes)
    else:
        path.unlink(missing_ok=True)
        layouts.hdf5(path, codes, chunks=(1, *codes.shape[1:]), compression="gzip")
    return [note for note in opened(path).report.notes if "last axis" in note]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_time_is_told_from_columns(tmp_path, layout):
    frames = PlainCamera(0.3, 2.0, 10.0, (40, 48), 500, SPREAD, layout).frames(3).astype(np.float64)
    rng = np.random.default_rng(5)
    wandering = np.linspace(0.0, 4.0, 500)[:, None, None] + rng.normal(0.0, 0.5, (500, 1, 1))
    of_rows = rng.normal(0.0, 2.0, (500, 40, 1))
    path = tmp_path / "stack.npy"
    for added in (0.0, wandering, of_rows):
        assert notes_on(path, frames + added) == []
    [note] = notes_on(path, np.moveaxis(frames, 0, -1))
    assert note == (
        "stack.npy: read as 40 frames of 48 x 500 pixels, but the last axis looks like time; "
        "if so, save numpy.moveaxis(array, -1, 0)"
    )


def test_it_is_said_of_hdf5_and_not_where_there_is_nothing_to_see(tmp_path):
    frames = PlainCamera(0.3, 2.0, 10.0, (40, 48), 500, SPREAD).frames(3).astype(np.float64)
    path = tmp_path / "stack.h5"
    assert notes_on(path, frames) == []
    assert len(notes_on(path, np.moveaxis(frames, 0, -1))) == 1
    flat = np.random.default_rng(1).normal(100.0, 3.0, (40, 48, 500))
    alternating = 6.0 * (np.arange(40) % 2)[:, None, None]
    assert notes_on(path, flat) == notes_on(path, flat + alternating) == []
    assert notes_on(path, frames[:4]) == []
    assert notes_on(path, np.full((40, 48, 500), 7.0)) == []
    frames[200:] = 0.0  # nothing came any more
    assert notes_on(path, frames) == []
    frames = np.rint(frames).astype(np.uint16)
    with h5py.File(path, "w") as file:
        file.create_dataset("data", shape=frames.shape, dtype="u2", chunks=(1, 20, 24))[:200] = frames[:200]
    notes = opened(path).report.notes
    assert notes == ["stack.h5: 1200 of 2000 chunks were not written; read as the fill value"]


def camera(bias, noise, step, *, frames=60):
    dn = codes(np.random.default_rng(8), (frames, 20, 24), 1.2, step, noise, bias)
    return dn.clip(0, 65535).astype(np.uint16)


CAMERAS = {
    "usual": camera(400, 0.28, 9.5),
    "low": camera(30, 0.3, 5.0),
    "skipper": camera(20_000, 0.17, 700.0),
    "noisy": camera(30_000, 3.0, 1000.0),
    "12 bits in 16": camera(100, 0.3, 10.0) << 4,
}


@pytest.mark.parametrize("name", CAMERAS)
def test_swapped_bytes_are_refused_with_their_cure_and_others_are_not(tmp_path, name):
    frames, path = CAMERAS[name], tmp_path / "a.raw"
    settings = {"shape": frames.shape[1:], "dtype": "uint16"}
    frames.astype("<u2").tofile(path)
    notes = opened(path, **settings).report.notes
    shifted = (
        "a.raw: the lowest 4 bits of the samples are 0 (left-justified samples); set input.bit_shift: 4 "
        "(--bit-shift 4), else all DN are 16 times too large"
    )
    assert notes == [shifted] * (name == "12 bits in 16")
    for order, right in (("little", "big"), ("big", "little")):
        frames.astype("<u2" if order == "big" else ">u2").tofile(path)
        path.with_name("a.raw.json").write_text(json.dumps({"byte_order": order}))
        not_opened(f"look byte-swapped: set input.byte_order: {right} ", path, **settings)
        np.testing.assert_array_equal(read(path, **settings, byte_order=right), frames)
    np.save(tmp_path / "a.npy", frames.byteswap())
    not_opened(r"write the file again with swapped bytes", tmp_path / "a.npy")


def test_codes_at_which_samples_pile_up_are_limits(tmp_path):
    frames = camera(180, 0.3, 30.0)
    for low, high in ((0, 250), (185, 65535), (185, 250), (0, 65535)):
        np.save(tmp_path / "a.npy", frames.clip(low, high))
        expected = (low or None, high if high == 250 else None)
        assert opened(tmp_path / "a.npy").seen_limits == expected
        pixels = frames.clip(low, high).reshape(len(frames), -1).T
        counts = np.stack([np.bincount(each, minlength=600) for each in pixels])
        assert limits_in(counts[:, 150:], np.full(len(counts), 150)) == expected
    # pixels that are stuck are no limit, nor is each peak on one code
    frames[:, :2, :3] = frames.max() + 1
    np.save(tmp_path / "a.npy", frames)
    assert opened(tmp_path / "a.npy").seen_limits == (None, None)
    np.save(tmp_path / "a.npy", camera(180, 0.0, 30.0))
    assert opened(tmp_path / "a.npy").seen_limits == (None, None)


def test_samples_in_the_high_byte_alone_are_one_of_two_things(tmp_path):
    np.save(tmp_path / "a.npy", camera(30, 0.3, 5.0) << 8)
    not_opened(r"byte-swapped: .*, or, if they are left-justified, input.bit_shift: 8", tmp_path / "a.npy")
    assert opened(tmp_path / "a.npy", bit_shift=8).report.notes == []


def test_what_was_never_written_is_counted_or_refused(tmp_path):
    for name, shards in (("a.zarr", None), ("b.zarr", (20, 20, 24))):
        array = zarr.create_array(
            tmp_path / name, shape=(60, 20, 24), chunks=(10, 20, 24), shards=shards, dtype="u2"
        )
        not_opened(r"none of its \d chunks was written", tmp_path / name)
        array[:30] = camera(100, 0.3, 5.0)[:30]
    for name, words in (("a.zarr", "3 of 6 chunks were"), ("b.zarr", "1 of 3 chunks was")):
        note = f"{name}: {words} not written; read as the fill value"
        assert opened(tmp_path / name).report.notes == [note]
    for chunks in (None, (1, 20, 24)):
        with h5py.File(tmp_path / "a.h5", "w") as file:
            file.create_dataset("data", shape=(60, 20, 24), dtype="u2", chunks=chunks)
        not_opened(r"none of its \d+ \w+ was written", tmp_path / "a.h5")
