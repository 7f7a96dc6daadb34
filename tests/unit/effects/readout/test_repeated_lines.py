"""Repeated lines: the forward model, in pieces too, and the count of equal lines."""

import numpy as np
import pytest
from helpers.small_sensors import context_of, drawn_truth, seen, taken

from pchem_pipeline.effects.operators.replace import RepeatedLines

SHAPE, FRAMES = (9, 11), 300


@pytest.mark.parametrize("lines", ["rows", "columns"])
def test_a_line_is_its_own_or_the_one_before(lines):
    frames = np.random.default_rng(1).integers(90, 140, (FRAMES, *SHAPE)).astype(np.uint16)
    found = RepeatedLines(share=0.1, lines=lines).apply(frames, context_of(SHAPE, FRAMES))
    repeats = 0
    for one, plain in zip(found, frames, strict=True):
        one, plain = (one, plain) if lines == "rows" else (one.T, plain.T)
        np.testing.assert_array_equal(one[0], plain[0])
        for y in range(1, len(one)):
            if not np.array_equal(one[y], plain[y]):
                np.testing.assert_array_equal(one[y], plain[y - 1])
                repeats += 1
    n = FRAMES * (SHAPE[0 if lines == "rows" else 1] - 1)
    assert abs(repeats - 0.1 * n) < 5 * np.sqrt(0.09 * n)
    none = RepeatedLines(share=0.0, lines=lines).apply(frames, context_of(SHAPE, FRAMES))
    np.testing.assert_array_equal(none, frames)


@pytest.mark.parametrize("lines", ["rows", "columns"])
@pytest.mark.parametrize("share", [5e-4, 2e-2])
def test_the_share_is_found(lines, share):
    n_frames, shape = 1200, (18, 26)
    effect = RepeatedLines(share=share, lines=lines)
    evidence = seen(taken(drawn_truth(shape), effect, n_frames=n_frames, seed=3))
    found, *_ = RepeatedLines.estimate(evidence)
    n = n_frames * (shape[0 if lines == "rows" else 1] - 1)
    assert found.lines == lines
    assert abs(found.share - share) < 3.5 * np.sqrt(share / n)
    assert evidence.z[f"space.repeated.{lines}"] == 10.0 * round(found.share * n)


def test_lines_so_short_that_chance_repeats_them_say_nothing():
    evidence = seen(taken(drawn_truth((40, 3)), n_frames=1200, seed=4))
    assert "space.repeated.rows" not in evidence.z
    assert "space.repeated.columns" in evidence.z
    assert list(RepeatedLines.estimate(evidence)) == []


def test_rare_repeats_are_shown_more_often_than_they_are():
    frames = np.arange(1000)
    shown, factor = RepeatedLines(share=1e-5).representative(frames)
    assert shown.share * 1000 == pytest.approx(8.0)
    assert shown.share * factor == pytest.approx(1e-5)
    often = RepeatedLines(share=0.1)
    assert often.representative(frames) == (often, 1.0)
