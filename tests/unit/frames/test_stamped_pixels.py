"""Numbers of frames that cameras write into pixels: found in any format, and not where there are none."""

import time

import numpy as np
import pytest
from helpers.camera_files import opened
from helpers.layouts import write

from pchem_pipeline.frames.stamps import _FRAMES, _counts_frames, stamped_pixels

RNG = np.random.default_rng(9)
N, SHAPE = 20, (12, 300)


def noise(dtype="uint16", sigma=3.0):
    bias = RNG.normal(100, 8, SHAPE)
    return np.clip(np.rint(RNG.normal(bias, sigma, (N, *SHAPE))), 0, np.iinfo(dtype).max).astype(dtype)


def bcd(number, pixels):
    digits = f"{number:0{2 * pixels}d}"
    return [int(digits[i : i + 2], 16) for i in range(0, 2 * pixels, 2)]


def pco(stack, first=95, shift=0, text=False):
    """Write number, date and time of each frame as PCO cameras do, two decimal digits a pixel."""
    for t, frame in enumerate(stack):
        at = 8_250_013 * t // 777
        parts = [(first + t, 4), (2024, 2), (1031, 2), (12, 1), (at // 60_000_000 % 60, 1)]
        parts += [(at // 1_000_000 % 60, 1), (at % 1_000_000, 3)]
        stamp = [digit for part in parts for digit in bcd(*part)]
        frame[0, :14] = np.array(stamp) << shift
        if text:
            frame[:8, 16:271] = RNG.integers(0, 2, (8, 255)) * 255
            frame[1:8, :16] = 0
    return stack


def binary(stack, order, first=250, at=24):
    """Write the number of each frame as one of ten numbers of 4 bytes."""
    data = stack.reshape(N, -1).view("u1")
    data[:, :40] = RNG.integers(0, 256, 40)
    data[:, at : at + 4] = (first + np.arange(N)).astype(f"{order}u4")[:, None].view("u1")
    return stack


#: stamped frames, the pixels of a stamp, and layouts beside npy
STAMPED = {
    "16 bits": (lambda: pco(noise()), 20, ("tiff, zlib", "zarr", "dcimg")),
    "8 bits": (lambda: pco(noise("uint8")), 40, ()),
    "32 bits": (lambda: binary(noise("uint32"), ">"), 10, ("tiff, zlib", "zarr")),
    "from one": (lambda: pco(noise(), first=1), 20, ()),
    "left-justified": (lambda: pco(noise() << 2, shift=2), 20, ()),
    "little-endian": (lambda: binary(noise(), "<"), 20, ()),
    "big-endian": (lambda: binary(noise(), ">"), 20, ()),
    "8 bits, binary": (lambda: binary(noise("uint8"), ">"), 40, ("tiff, zlib", "zarr", "dcimg")),
}


@pytest.mark.parametrize(("make", "width", "layouts"), STAMPED.values(), ids=STAMPED)
def test_stamped_pixels_are_no_samples(tmp_path, make, width, layouts):
    stack, expected = make(), np.zeros(SHAPE, bool)
    expected[0, :width] = True
    for layout in ("npy", *layouts):
        frames = opened(write(tmp_path / layout, layout, stack))
        np.testing.assert_array_equal(frames.excluded, expected)
        assert f"{width} pixels from the first one on hold a stamp" in frames.report.message()
        found = frames.read()
        assert (np.ptp(found[:, expected], axis=0) == 0).all()
        np.testing.assert_array_equal(found[:, ~expected], stack[:, ~expected])


def test_a_region_is_left_with_its_own_part_of_the_stamp_and_a_text_beside_is_no_sample_either(tmp_path):
    path = write(tmp_path, "npy", pco(noise()))
    frames = opened(path, roi=(0, 5, 7, 60), frame_range=(3, 19))
    assert frames.excluded is not None
    np.testing.assert_array_equal(np.argwhere(frames.excluded), [[0, x] for x in range(13)])
    beside = opened(path, roi=(1, 12, 0, 60))
    assert beside.excluded is None
    assert "stamp" not in beside.report.message()
    frames = opened(write(tmp_path, "npy", pco(noise(), text=True)))
    expected = np.zeros(SHAPE, bool)
    expected[:8, :271] = True
    np.testing.assert_array_equal(frames.excluded, expected)


def test_stamps_of_single_files_and_a_mask_go_together(tmp_path):
    for t, frame in enumerate(pco(noise())):
        write(tmp_path / "in", "tiff", frame, f"f{t}")
    mask = np.zeros(SHAPE, np.uint8)
    mask[5, 6] = 1
    np.save(tmp_path / "mask.npy", mask)
    frames = opened(tmp_path / "in", mask=str(tmp_path / "mask.npy"))
    assert frames.excluded is not None
    assert np.count_nonzero(frames.excluded) == 21
    assert frames.excluded[5, 6]


def ordinary():
    yield "dead", np.where(RNG.random(SHAPE) < 0.4, RNG.integers(0, 4000, SHAPE), noise()).astype(np.uint16)
    yield "constant", np.full((N, *SHAPE), 300, np.uint16)
    yield "empty", np.zeros((N, *SHAPE), np.uint16)
    for dtype in ("uint8", "uint16", "uint32"):
        rising = np.arange(N)[:, None, None]
        yield "rising", (rising + np.zeros(SHAPE, int)).astype(dtype)
        yield "rising with noise", (rising + noise()).astype(dtype)
        yield "all numbers", np.arange(N * SHAPE[0] * SHAPE[1]).reshape(N, *SHAPE).astype(dtype)
        yield "random", RNG.integers(0, np.iinfo(dtype).max, (N, *SHAPE), dtype=dtype)
        for sigma in (0.0, 0.3, 1.0, 30.0):
            yield "noise", noise(dtype, sigma)
    yield "too few", pco(noise())[:15]
    yield "too narrow", pco(noise())[:, :, :19]
    yield "stamped in another row", np.roll(pco(noise()), 1, axis=1)
    repeated = pco(noise())
    repeated[4] = repeated[3]
    yield "not by one", repeated


def test_ordinary_frames_have_none(tmp_path):
    path = tmp_path / "a.npy"
    for name, stack in ordinary():
        np.save(path, stack)
        frames = opened(path, byte_order="little")
        assert stamped_pixels(frames) is None, name
        assert frames.excluded is None


def test_chance_makes_none():
    """The pixels of a thousand sensors, whose bytes rise by one more often than those of any other noise."""
    for sigma in (0.4, 0.8, 1.5):
        sensors = np.rint(RNG.normal(100, sigma, (1000, _FRAMES[-1], 40))).astype(np.uint8)
        assert not any(map(_counts_frames, sensors))


def test_looking_for_them_takes_little_time(tmp_path):
    path = write(tmp_path, "npy", np.tile(RNG.integers(0, 4000, (64, 1024, 16), dtype=np.uint16), 64))
    frames = opened(path)
    clock = time.process_time()
    assert stamped_pixels(frames) is None
    assert time.process_time() - clock < 0.05
