"""Frames that are unlike the others, and waves across them."""

import numpy as np
import pytest

from pchem_pipeline.model.histogram.odd_frames import copied_frames, far_frames, left_out, odd_words
from pchem_pipeline.model.histogram.spectrum import FrameSpectrum

N, PIXELS, SD = 900, 576, 10.0
VARIANCE = np.full(N, SD**2)


def means(seed=1):
    return 100.0 + SD / PIXELS**0.5 * np.random.default_rng(seed).standard_normal(N)


def test_far_frames_are_found_and_chance_makes_none():
    for seed in range(50):
        assert far_frames(means(seed), VARIANCE, PIXELS).size == 0
    odd = means()
    odd[:5] += 30.0
    odd[600] -= 60.0
    far = far_frames(odd, VARIANCE, PIXELS)
    assert far.tolist() == [0, 1, 2, 3, 4, 600]
    nothing = np.zeros(0, np.int64)
    words = odd_words({"empty": nothing, "copied": nothing, "far": far}, odd)
    assert words == "frames 0 to 4 are 30 DN above the others; frame 600 is 60 DN below the others"


def test_what_many_frames_do_or_a_drift_is_not_odd():
    t = np.arange(N)
    for moved in (20.0 * (t >= 300), 0.2 * t, 20.0 * (t % 10 == 0), 5.0 * np.sin(t / 3.0)):
        assert far_frames(means() + moved, VARIANCE, PIXELS).size == 0


def test_copies_of_any_earlier_frame_are_found():
    frames = np.random.default_rng(2).integers(0, 9, (60, 8, 8))
    frames[50], frames[31] = frames[7], frames[30]
    frames[40] = frames[12].T  # the same mean and variance, and another frame
    mean, variance = frames.mean(axis=(1, 2)), frames.var(axis=(1, 2))
    copied = copied_frames(mean, variance, lambda at: [frames[t].tobytes() for t in at])
    assert copied.tolist() == [31, 50]
    odd = {"empty": np.array([1]), "copied": copied, "far": np.array([4])}
    assert left_out(odd, 60).tolist() == [1, 4, 31, 50]
    assert left_out(odd, 30).tolist() == [1, 4]  # so many copies are a property of the camera


@pytest.mark.parametrize("size", [0.0, 0.15])
def test_a_wave_is_found_with_its_size_and_chance_makes_none(size):
    """A wave of a new phase in every frame; without one the largest ratio is that of means of 400 powers."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:24, :32]
    ratios = []
    for _ in range(1 if size else 20):
        phase = rng.uniform(0.0, 2.0 * np.pi, (400, 1, 1))
        wave = size * 2.0**0.5 * np.sin(2.0 * np.pi * (-5 * y / 24 + 7 * x / 32) + phase)
        frames = np.rint(500.0 + 20.0 * (rng.standard_normal((400, 24, 32)) + wave)).astype(np.uint16)
        spectrum = FrameSpectrum((24, 32))
        for part in np.array_split(frames, 3):
            spectrum.add(part)
        line = spectrum.line()
        ratios.append(line["ratio"])
    limit = 1.0 + (np.sqrt(2.0 * np.log(20 * line["cells"])) + 1.5) / np.sqrt(line["frames"])
    if not size:
        assert max(ratios) < limit
        return
    assert ratios[0] > limit
    assert line["size"] == pytest.approx(20.0 * size, rel=0.1)
    assert (line["cycles_per_row"], line["cycles_per_column"]) == pytest.approx((-5 / 24, 7 / 32))
