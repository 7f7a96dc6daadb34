"""Files joined to one stack: order, range, region, bit shift, threads, identity, and what is refused."""

import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import xxhash
import zarr
from astropy.io import fits
from helpers.camera_files import check_reads, not_opened, opened, write_fits, write_hdf5
from numpy.typing import NDArray
from pydantic import ValidationError

from pchem_pipeline.base.errors import ConfigError, InputError
from pchem_pipeline.frames.identity import content_identity, hash_file, quick_identity
from pchem_pipeline.frames.inspect import _gaps
from pchem_pipeline.frames.open import open_frames
from pchem_pipeline.frames.resolve import natural_key, resolve_files
from pchem_pipeline.frames.settings import InputSettings

STACK = np.random.default_rng(15).integers(0, 4096, (12, 17, 19)).astype(np.uint16)


def test_natural_order():
    wanted = ["9", "10", "a9b9", "a9b10", "Frame1", "frame2", "frame10", "frame"]
    paths = [Path(f"{name}.tif") for name in wanted]
    assert sorted([*paths[4::-1], *paths[:4:-1]], key=natural_key) == paths


def test_resolve(tmp_path):
    for name in ("d2/f1.npy", "d10/f1.npy", "d2/f10.npy", "d2/f9.npy", "d2/notes.txt", "d2/.hidden.npy"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        np.save(path, STACK[0]) if path.suffix == ".npy" else path.write_text("x")

    def names(*files):
        found = resolve_files(InputSettings(files=files), tmp_path)
        return [path.relative_to(tmp_path).as_posix() for path in found]

    assert names("d2") == ["d2/f1.npy", "d2/f9.npy", "d2/f10.npy"]
    assert names("d10", "d2/f9.npy") == ["d2/f9.npy", "d10/f1.npy"]
    assert names("d*/*.npy") == ["d2/f1.npy", "d2/f9.npy", "d2/f10.npy", "d10/f1.npy"]
    assert names("**/f1.npy") == ["d2/f1.npy", "d10/f1.npy"]
    assert names(str(tmp_path / "d10" / "f1.npy")) == ["d10/f1.npy"]
    np.save(tmp_path / "odd[1].npy", STACK)
    assert names("odd[1].npy") == ["odd[1].npy"]
    folder = tmp_path / "run [1]"
    folder.mkdir()
    np.save(folder / "f.npy", STACK)
    assert resolve_files(InputSettings(files=("*.npy",)), folder) == [folder / "f.npy"]


def test_files_that_are_missing_empty_or_of_one_frame(tmp_path):
    with pytest.raises(ConfigError, match=r"input\.files is empty"):
        open_frames(InputSettings(), tmp_path)
    not_opened(r"none\.tif: no such file or folder", tmp_path / "none.tif")
    not_opened(r"\*\.tif: matches no file", tmp_path / "*.tif")
    (tmp_path / "empty").mkdir()
    not_opened("has no camera files", tmp_path / "empty")
    for name, content, words in (
        ("a.tif", b"", "the file is empty"),
        ("b.xyz", b"what is this", "unknown camera format"),
        ("c.tif", b"II*\0nonsense", "not a valid tiff"),
        ("d.fits", b"hello", "does not begin as fits files do"),
    ):
        (tmp_path / name).write_bytes(content)
        not_opened(f"{name}: {words}", tmp_path / name)
    with pytest.raises(ConfigError, match=r"unknown input\.format 'jpeg'; choose one of: auto, npy"):
        opened(tmp_path / "b.xyz", format="jpeg")
    np.save(tmp_path / "one.npy", STACK[0])
    not_opened(r"one\.npy: 1 frame of \d+ x \d+ pixels in total; at least 2 needed", tmp_path / "one.npy")
    np.save(tmp_path / "zero.npy", STACK[:0])
    not_opened(r"zero\.npy: has no frames", tmp_path / "zero.npy")
    fits.PrimaryHDU().writeto(tmp_path / "zero.fits")
    not_opened("no image", tmp_path / "zero.fits")
    write_hdf5(tmp_path / "zero.h5", a=STACK[:0])
    not_opened("no frames", tmp_path / "zero.h5")


def test_formats_are_told_by_content_and_may_be_mixed(tmp_path):
    np.save(tmp_path / "a.npy", STACK)
    tifffile.imwrite(tmp_path / "a.tif", STACK + 1, photometric="minisblack")
    not_opened(r"several formats \(npy, tiff\); set input.format", tmp_path / ".")
    reader = open_frames(InputSettings(files=(".",), format="tiff"), tmp_path)
    np.testing.assert_array_equal(reader.read(), STACK + 1)
    tifffile.imwrite(tmp_path / "really_tiff.fits", STACK, photometric="minisblack")
    np.testing.assert_array_equal(opened(tmp_path / "*.fits").read(), STACK)
    tifffile.imwrite(tmp_path / "p1.tif", STACK[:5], photometric="minisblack", compression="zlib")
    fits.PrimaryHDU(STACK[5]).writeto(tmp_path / "p2.fits")
    write_hdf5(tmp_path / "p3.h5", x=STACK[6:8])
    write_hdf5(tmp_path / "p9.h5", x=STACK[8])
    np.save(tmp_path / "p10.npy", STACK[9:])
    check_reads(opened(tmp_path / "p*"), STACK)


def test_ranges_and_regions(tmp_path, monkeypatch):
    np.save(tmp_path / "a.npy", STACK)
    beyond = r"input\.roi \[0, 18, 0, 5\] exceeds .* \(--roi 0:18,0:5; all pixels: 0:\d+,0:\d+\)"
    not_opened(beyond, tmp_path / "a.npy", roi=(0, 18, 0, 5))
    not_opened(r"does not select at least 2 of the 12", tmp_path / "a.npy", frame_range=(0, 13))
    not_opened("at least 2 of the 12 frames", tmp_path / "a.npy", frame_range=(11, None))
    bad: list[tuple[str, Any]] = [("roi", (5, 5, 0, 3)), ("frame_range", (4, 4)), ("shape", (0, 4))]
    bad += [("integration_time", 0.0), ("integration_time", float("nan"))]
    for name, value in [*bad, ("shape", (4,)), ("bit_depth", 0), ("unknown", 1)]:
        with pytest.raises(ValidationError):
            InputSettings(files=("a.npy",), **{name: value})
    # a region is read through a small buffer, too
    monkeypatch.setattr("pchem_pipeline.frames.sequence.SCRATCH_BYTES", 3 * 17 * 19 * 2)
    reader = opened(tmp_path / "a.npy", roi=(0, 17, 5, 6))
    np.testing.assert_array_equal(reader.read(), STACK[:, :, 5:6])


def test_bit_shift_and_bit_depth(tmp_path):
    np.save(tmp_path / "a.npy", STACK << 4)
    reader = opened(tmp_path / "a.npy", bit_shift=4)
    np.testing.assert_array_equal(reader.read(), STACK)
    assert reader.bit_depth == 12
    dirty = STACK << 4
    dirty[7, 8, 9] |= 2
    np.save(tmp_path / "a.npy", dirty)
    reader = opened(tmp_path / "a.npy", bit_shift=4)
    np.testing.assert_array_equal(reader.read(0, 7), STACK[:7])
    with pytest.raises(InputError, match=r"a\.npy: the lowest 4 bits are not all zero.*input\.bit_shift"):
        reader.read()
    not_opened("removes all bits of uint16", tmp_path / "a.npy", bit_shift=16)
    not_opened("bit depth of 14 does not fit", tmp_path / "a.npy", bit_shift=4, bit_depth=14)
    np.save(tmp_path / "a.npy", STACK)
    np.testing.assert_array_equal(opened(tmp_path / "a.npy", bit_depth=12).read(), STACK)
    with pytest.raises(InputError, match=r"a\.npy: values exceed the bit depth of 11; correct"):
        opened(tmp_path / "a.npy", bit_depth=11).read()
    np.save(tmp_path / "a.npy", STACK << 4)  # 12 bits in 16
    words = r"lowest 4 bits are all zero.*; set input\.bit_shift: 4 \(--bit-shift\)$"
    for shift in (0, 2):
        with pytest.raises(InputError, match=words):
            opened(tmp_path / "a.npy", bit_depth=12, bit_shift=shift).read()


def test_files_that_contradict_each_other(tmp_path):
    for i, time in enumerate((1.5, 1.5, 2.0)):
        write_fits(tmp_path / f"f{i}.fits", STACK[i], EXPTIME=time)
    words = r"different integration_time: 1\.5 in f0\.fits and f1\.fits, 2\.0 in f2\.fits"
    not_opened(words, tmp_path / "*.fits")
    assert opened(tmp_path / "*.fits", integration_time=3.0).integration_time == 3.0
    fits.PrimaryHDU(STACK[2]).writeto(tmp_path / "f2.fits", overwrite=True)
    assert opened(tmp_path / "*.fits").integration_time is None


def make_bad_folder(folder):
    """Write good files f0..f4, and one of each kind of bad file."""
    for i in range(5):
        tifffile.imwrite(folder / f"f{i}.tif", STACK[i], photometric="minisblack")
    data = (folder / "f0.tif").read_bytes()
    (folder / "f5.tif").write_bytes(data[:-50])
    shutil.copy(folder / "f1.tif", folder / "f6.tif")
    tifffile.imwrite(folder / "f7.tif", STACK[0, :9], photometric="minisblack")
    tifffile.imwrite(folder / "f8.tif", STACK[0].astype(np.uint8), photometric="minisblack")
    tifffile.imwrite(folder / "f9.tif", STACK[0].astype(np.float32), photometric="minisblack")
    tifffile.imwrite(folder / "f10.tif", np.zeros((17, 19, 3), np.uint16), photometric="rgb")
    (folder / "f11.tif").write_bytes(b"")


def test_one_message_lists_all_bad_files(tmp_path):
    make_bad_folder(tmp_path)
    settings = InputSettings(files=("*.tif", str(tmp_path / "f2.tif")))
    with pytest.raises(InputError) as caught:
        open_frames(settings, tmp_path)
    message = str(caught.value)
    assert message.startswith("8 of 13 input files cannot be used: ")
    assert message.endswith("; repair or remove them, or set input.on_bad_file: skip")
    for words in (
        "f2.tif: is listed twice in input.files",
        "f5.tif: truncated",
        "f6.tif: has the same content as f1.tif",
        "f7.tif: has 9 x 19 uint16 frames, the others 17 x 19 uint16",
        "f8.tif: has 17 x 19 uint8 frames, the others 17 x 19 uint16",
        "f9.tif: floating-point samples",
        "f10.tif: colour",
        "f11.tif: the file is empty",
    ):
        assert words in message
    assert "\n" not in message
    reader = open_frames(settings.model_copy(update={"on_bad_file": "skip"}), tmp_path)
    np.testing.assert_array_equal(reader.read(), STACK[:5])
    assert "skipped (input.on_bad_file: skip)" in reader.report.message()
    assert [file.path.name for file in reader.report.good] == [f"f{i}.tif" for i in range(5)]
    assert len(reader.report.bad) == 8
    tifffile.imwrite(tmp_path / "f90.tif", STACK[0].astype(np.float32), photometric="minisblack")
    found = r"2 of 2 input files cannot be used: \S+f9.tif and 1 more: floating-point samples [^;]*; [^;]*$"
    not_opened(found, tmp_path / "f9*.tif")
    not_opened("2 of 2 input files cannot be used", tmp_path / "f1[01].tif", on_bad_file="skip")


def test_duplicate_by_link_and_by_content(tmp_path):
    np.save(tmp_path / "a.npy", STACK)
    (tmp_path / "b.npy").symlink_to(tmp_path / "a.npy")
    not_opened(r"b\.npy: is listed twice", tmp_path / "*.npy")
    (tmp_path / "b.npy").unlink()
    shutil.copy(tmp_path / "a.npy", tmp_path / "b.npy")
    not_opened(r"b\.npy: has the same content as a\.npy", tmp_path / "*.npy")
    other = np.load(tmp_path / "b.npy")
    other[6, 8, 9] ^= 1
    np.save(tmp_path / "b.npy", other)
    assert opened(tmp_path / "*.npy").shape[0] == 24
    big = np.zeros((8, 200, 200), np.uint16)  # equal beginning, middle and end is not equal content
    np.save(tmp_path / "a.npy", big)
    big[2, 100, 100] = 1
    np.save(tmp_path / "b.npy", big)
    assert opened(tmp_path / "*.npy").shape[0] == 16


def test_gaps_in_the_numbers(tmp_path):
    for i in (1, 2, 3, 6, 7):
        np.save(tmp_path / f"frame_{i:04d}.npy", STACK[i])
    message = open_frames(InputSettings(files=(".",)), tmp_path).report.message()
    assert message == "2 of the numbered files frame_#.npy are missing between the first and the last"


def test_read_into_checks_its_arguments(tmp_path):
    np.save(tmp_path / "a.npy", STACK)
    reader = opened(tmp_path / "a.npy")
    good: NDArray[np.uint16] = np.empty((2, 17, 19), np.uint16)
    reader.read_into(good, 3, 5)
    np.testing.assert_array_equal(good, STACK[3:5])
    for buffer in (good[:1], good.astype(np.uint32), np.asfortranarray(good), good[:, ::2]):
        with pytest.raises(ValueError, match="does not fit"):
            reader.read_into(buffer, 3, 5)
    for window in [(-1, 1), (11, 13), (5, 4)]:
        with pytest.raises(ValueError, match="outside the stack"):
            reader.read_into(good, *window)
    with pytest.raises(ValueError, match="outside the stack"):
        reader.read_into(good, 3, 5, 0, 18)


def test_identity(tmp_path):
    data = np.random.default_rng(1).bytes((1 << 22) + 12345)
    (tmp_path / "a").write_bytes(data)
    assert hash_file(tmp_path / "a") == xxhash.xxh3_128(data).hexdigest()
    first, second = tmp_path / "one", tmp_path / "two"
    for folder in (first, second):
        folder.mkdir()
        for i in range(3):
            np.save(folder / f"a_{i + 1:05d}.npy", STACK[4 * i : 4 * i + 4])
    settings = InputSettings(files=("*.npy",))
    here, there = open_frames(settings, first), open_frames(settings, second)
    identity = content_identity(here.paths)
    assert identity == content_identity(there.paths)
    assert [file["name"] for file in identity["files"]] == ["a_00001.npy", "a_00002.npy", "a_00003.npy"]
    assert identity["files"][0]["xxh3_128"] == hash_file(first / "a_00001.npy")
    assert str(tmp_path) not in str(identity)
    before = quick_identity(there.paths)
    changed = np.load(second / "a_00002.npy")
    changed[0, 0, 0] ^= 1
    np.save(second / "a_00002.npy", changed)
    os.utime(second / "a_00002.npy", ns=(1, 1))
    assert content_identity(there.paths)["digest"] != identity["digest"]
    assert quick_identity(there.paths) != before
    assert [file["size"] for file in before["files"]] == [file["size"] for file in identity["files"]]
    (second / "a_00003.npy").unlink()
    with pytest.raises(InputError, match="cannot be read"):
        quick_identity(there.paths)


def test_unreadable_file(tmp_path, monkeypatch):
    """Without permission, whoever runs the tests."""
    np.save(tmp_path / "a.npy", STACK)
    real = Path.open

    def deny(path, *args, **rest):
        if path.name == "a.npy":
            raise PermissionError(13, "Permission denied", str(path))
        return real(path, *args, **rest)

    monkeypatch.setattr(Path, "open", deny)
    for format in ("auto", "npy"):
        not_opened(r"a\.npy: cannot be read \(Permission denied\)", tmp_path / "a.npy", format=format)


BIAS = {"BIASSEC": "[7:8,1:6]"}


@pytest.mark.parametrize(
    ("cards", "settings", "active", "overscan"),
    [
        ({"DATASEC": "[3:8,1:5]"}, {}, (0, 5, 2, 8), None),
        ({"DATASEC": "[1:8,1:6]", "TRIMSEC": "[3:8,2:6]"}, {}, (1, 6, 2, 8), None),
        ({"DATASEC": "[3:8,1:5]"}, {"roi": (1, 6, 1, 8)}, (0, 4, 1, 7), None),
        ({"DATASEC": "[1:8,1:6]"}, {}, None, None),  # all
        ({"DATASEC": "[3:8,1:6]"}, {"roi": (0, 6, 0, 2)}, None, None),  # overscan alone is what is wanted
        ({"DATASEC": "[3:9,1:6]"}, {}, None, None),  # not of this image
        ({"DATASEC": "whole"}, {}, None, None),
        # between both a column of neither
        ({"TRIMSEC": "[1:5,1:6]", "BIASSEC": "[7:8,1:6]"}, {}, (0, 6, 0, 5), np.s_[:, 6:]),
        (BIAS, {}, (0, 6, 0, 6), np.s_[:, 6:]),
        (BIAS, {"overscan": [(0, 2, 0, 8)], "roi": (1, 6, 0, 8)}, (1, 5, 0, 8), np.s_[:1]),
        ({"TRIMSEC": "[1:5,1:6]"}, {"overscan": []}, (0, 6, 0, 5), np.s_[:0]),
    ],
)
def test_overscan_is_excluded(tmp_path, cards, settings, active, overscan):
    """``overscan``: None is all outside of the light-sensitive area."""
    stack = np.arange(4 * 6 * 8, dtype=np.uint16).reshape(4, 6, 8)
    write_fits(tmp_path / "a.fits", stack, **cards)
    frames = opened(tmp_path / "a.fits", **settings)
    if active is None:
        assert frames.excluded is None
        assert not frames.overscan_pixels.any()
        return
    y0, y1, x0, x1 = active
    inside, dark = np.zeros((2, *frames.shape[1:]), bool)
    inside[y0:y1, x0:x1] = True
    dark[np.s_[:] if overscan is None else overscan] = True
    np.testing.assert_array_equal(frames.excluded, ~inside)
    assert frames.exclusions == ("overscan",)
    np.testing.assert_array_equal(frames.overscan_pixels, dark & ~inside)
    top, _, left, _ = settings.get("roi", (0, 0, 0, 0))
    whole = stack[:, top : top + frames.shape[1], left : left + frames.shape[2]]
    shown = inside | frames.overscan_pixels
    np.testing.assert_array_equal(frames.with_overscan().read()[:, shown], whole[:, shown])
    assert (np.ptp(frames.read()[:, ~inside], axis=0) == 0).all()


def test_overscan_outside_of_the_frames_and_two_light_sensitive_areas_are_refused(tmp_path):
    np.save(tmp_path / "a.npy", STACK)
    not_opened(r"input\.overscan \[0, 5, 0, 900\] exceeds", tmp_path / "a.npy", overscan=[(0, 5, 0, 900)])
    for i, columns in enumerate(("3:8", "1:8")):
        write_fits(tmp_path / f"{i}.fits", np.full((4, 6, 8), i, np.uint16), DATASEC=f"[{columns},1:6]")
    not_opened("different light-sensitive areas", tmp_path / "*.fits")


def test_pixels_of_a_mask_and_those_with_the_marker_are_excluded(tmp_path):
    stack = np.random.default_rng(4).integers(100, 4096, (9, 6, 8)).astype(np.uint32)
    stack[:, 2, 3] = stack[4, 5, 5] = 2**32 - 1
    np.save(tmp_path / "a.npy", stack)
    mask = np.zeros((6, 8))
    mask[4, 1:3] = 1.0, np.nan
    np.save(tmp_path / "mask.npy", mask)
    for roi, mask_too in ((None, False), (None, True), ((1, 6, 1, 7), True)):
        name = "mask.npy" if mask_too else None
        y0, y1, x0, x1 = roi or (0, 6, 0, 8)
        excluded = ((stack[0] == 2**32 - 1) | (mask_too * (mask != 0)))[y0:y1, x0:x1]
        frames = opened(tmp_path / "a.npy", mask=name, roi=roi)
        np.testing.assert_array_equal(frames.excluded, excluded)
        assert frames.exclusions == ("marker 2^32-1", "mask")[: 1 + mask_too]
        wanted = stack[:, y0:y1, x0:x1]
        middle = np.quantile(wanted[0][~excluded], 0.5, method="lower")
        np.testing.assert_array_equal(frames.read(), np.where(excluded, middle, wanted))
        np.testing.assert_array_equal(frames.read(2, 5, 1, 4), np.where(excluded, middle, wanted)[2:5, 1:4])
    no_image = np.array([{"no": "image"}])
    for values, words in (
        (mask[1:], r"mask of shape \(5, 8\)"),
        (np.ones((6, 8)), "every pixel is excluded"),
        (no_image, r"mask.npy: cannot be read as an image \(Object arrays.*write it again"),
    ):
        np.save(tmp_path / "mask.npy", values)
        not_opened(words, tmp_path / "a.npy", mask="mask.npy")


def test_files_with_names_that_are_special_and_files_that_are_none(tmp_path):
    for name in ("~root.npy", "~x.npy"):
        np.save(tmp_path / name, STACK)
        assert opened(tmp_path / name).paths == (tmp_path / name,)
    os.mkfifo(tmp_path / "a.npy")
    not_opened(r"a\.npy: not a regular file", tmp_path / "a.npy")
    not_opened(r"a\.npy: not a regular file", tmp_path / "~x.npy", mask="a.npy")
    zarr.create_array(tmp_path / "a.zarr", data=STACK, chunks=(6, 17, 19))
    (tmp_path / "a.zarr/c/1/0/0").unlink()
    os.mkfifo(tmp_path / "a.zarr/c/1/0/0")
    not_opened(r"c/1/0/0 is not a regular file", tmp_path / "a.zarr")
    latin = os.fsdecode(b"caf\xe9.npy")
    np.save(tmp_path / latin, STACK)
    not_opened(r"caf.*\.npy: its name is not UTF-8; rename it", tmp_path / latin)


@pytest.mark.parametrize(
    ("names", "missing"),
    [
        ([f"a_{i:06d}.npy" for i in range(50, 75)], 0),
        ([f"a_{i:06d}.npy" for i in range(50, 75) if i not in (52, 70)], 2),
        ([f"a_{i:06d}.npy" for i in range(10, 40) if i != 20], 1),
        ([f"n7_{i}.npy" for i in (2, 4, 6, 10, 12)], 1),
        ([f"20260131_12{i // 60:02d}{i % 60:02d}.npy" for i in range(0, 200, 5)], 0),
        ([f"cam 2026-01-31T12:00:{i:02d}.npy" for i in (1, 2, 3, 7, 8, 9)], 0),
        ([f"f{1_706_700_000_123 + i}.npy" for i in (0, 97, 199, 295, 400, 602)], 0),
    ],
)
def test_numbers_that_are_missing_and_clocks(names, missing):
    notes = _gaps([Path(name) for name in names])
    assert [note.split(" ")[0] for note in notes] == [str(missing)] * (missing > 0)
