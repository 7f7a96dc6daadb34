"""Frames that are unlike the others, and waves across them."""

import numpy as np
import pytest

from pchem_pipeline.model.histogram.odd_frames import left_out, odd_frames, odd_words
from pchem_pipeline.model.histogram.spectrum import FrameSpectrum

N, PIXELS, SD = 900, 576, 10.0
VARIANCE = np.full(N, SD**2)


def means(seed=1):
    return 100.0 + SD / PIXELS**0.5 * np.random.default_rng(seed).standard_normal(N)


def odd(level, variance=VARIANCE, digest=None, pixels=PIXELS):
    return odd_frames(level, variance, np.arange(len(level)) if digest is None else digest, pixels)


def test_odd_frames_are_found_and_chance_makes_none():
    for seed in range(50):
        assert not any(frames.size for frames in odd(means(seed)).values())
    level, variance, digest = means(), VARIANCE.copy(), np.arange(N)
    level[:5] += 30.0
    level[600] -= 60.0
    level[700:850], variance[700:850], digest[700:850] = 0.0, 0.0, -1
    digest[300] = 17
    found = odd(level, variance, digest)
    expected = {"empty": [*range(700, 850)], "copied": [300], "far": [0, 1, 2, 3, 4, 600]}
    expected |= {"moved_x": [], "moved_y": []}
    assert {kind: frames.tolist() for kind, frames in found.items()} == expected
    assert odd_words(found, level, variance) == (
        "frames 700 to 849 are empty; frame 300 is equal to an earlier frame; "
        "frames 0 to 4 are 30 DN above the others; frame 600 is 60 DN below the others"
    )
    assert left_out(found, N).size == 157
    assert left_out({**found, "copied": np.arange(100, 200)}, N).size == 256
    assert left_out({**found, "moved_x": np.arange(100, 200)}, N).size == 157  # the sensor has moved


def test_what_many_frames_do_or_a_drift_or_few_pixels_is_not_odd():
    t = np.arange(N)
    for moved in (20.0 * (t >= 300), 0.2 * t, 20.0 * (t % 10 == 0), 5.0 * np.sin(t / 3.0)):
        assert odd(means() + moved)["far"].size == 0
    quiet = np.where(t % 3 == 0, 101.0, 100.0)
    assert not any(frames.size for frames in odd(quiet, np.zeros(N), quiet.astype(int), pixels=4).values())


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
