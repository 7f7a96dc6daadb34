"""Misplaced lines: the forward model, in pieces too, the likelihood ratios, and what is made of them."""

import numpy as np
import pytest
from helpers.small_sensors import context_of, drawn_truth, seen, taken

from pchem_pipeline.discrepancy.observe.digital.misplaced import misplaced_lines, own_lines
from pchem_pipeline.effects.operators.offsets import RowNoise
from pchem_pipeline.effects.operators.replace import MisplacedLines, RepeatedLines
from pchem_pipeline.model.histogram.count import histogram_frames

SHAPE, FRAMES = (9, 11), 300
MOVES = ("swapped", "early", "late", "sample_lost", "sample_twice", "line_lost", "line_twice")


def origins(shape, frames):
    """Return frames whose values tell where in the frame they come from."""
    return np.broadcast_to(
        np.arange(shape[0] * shape[1], dtype=np.uint16).reshape(shape), (frames, *shape)
    ).copy()


def turned(frames, lines):
    """Return frames (frame, line, sample)."""
    return frames if lines == "rows" else frames.swapaxes(1, 2)


@pytest.mark.parametrize("lines", ["rows", "columns"])
@pytest.mark.parametrize("move", MOVES)
def test_every_sample_comes_from_where_the_move_says(move, lines):
    frames, share = origins(SHAPE, FRAMES), 0.1
    found = MisplacedLines(share=share, move=move, lines=lines).apply(frames, context_of(SHAPE, FRAMES))
    found, plain = turned(found, lines), turned(frames, lines)[0]
    n, m = plain.shape
    hits = 0
    for one in found:
        if move.startswith("line"):
            moved = np.flatnonzero((one != plain).any(axis=1))
            if moved.size:
                hits += 1
                come = np.clip(np.arange(n) + (1 if move == "line_lost" else -1), 0, n - 1)
                np.testing.assert_array_equal(one[moved[0] :], plain[come][moved[0] :])
            continue
        y = 0
        while y < n:
            at = np.flatnonzero(one[y] != plain[y])
            if at.size and move == "swapped":
                np.testing.assert_array_equal(one[[y, y + 1]], plain[[y + 1, y]])
                y += 1
            elif at.size:
                step = 1 if move in ("early", "sample_lost") else -1
                come = np.clip(np.arange(m) + step, 0, m - 1)
                np.testing.assert_array_equal(one[y, at[0] :], plain[y, come][at[0] :])
                assert move not in ("early", "late") or at[0] == (0 if step == 1 else 1)
            hits += at.size > 0
            y += 1
    # of a line lost at the end, or a sample twice at the end, nothing is seen
    trials = FRAMES * (1 if move.startswith("line") else n)
    shown = {"swapped": 1 - 1 / n - share, "line_lost": 1 - 1 / n, "sample_lost": 1 - 1 / m}.get(move, 1.0)
    expected = trials * share * shown
    assert abs(hits - expected) < 5 * np.sqrt(expected)


def test_the_ratios_are_those_of_the_likelihoods():
    """A plain transcription: sums of logarithms of the histograms' shares, less those at the own place."""
    frames = np.random.default_rng(2).integers(95, 105, (64, 3, 4)).astype(np.uint16)
    frames[:, 1] += 4
    histograms = histogram_frames(frames)
    counts = histograms.counts.reshape(12, -1)
    z, _ = misplaced_lines(frames, counts, histograms.origin.ravel().astype(np.int64), np.ones((3, 4), bool))
    codes = np.arange(94, 111)
    share = np.array(
        [[(frames[:, y, x, None] == codes).sum(axis=0) + 0.5 for x in range(4)] for y in range(3)]
    )
    # every histogram is as wide as the widest, and one code more on either side
    width = np.flatnonzero((counts > 0).any(axis=0))
    log = np.log(share / (64 + 0.5 * (width[-1] - width[0] + 3)))

    def at(y, x, code):
        low = histograms.origin[y, x] + width[0] - 1
        return log[y, x, np.clip(code, low, low + width[-1] - width[0] + 2) - 94]

    def gain(mixed):
        total = []
        for y in range(3):
            for t in range(64):
                row = [int(frames[(t + mixed * x) % 64, y, x]) for x in range(4)]
                own = np.array([at(y, x, row[x]) for x in range(4)])
                ratios = [
                    sum(at(y + dy, x, row[x]) for x in range(4)) - own.sum() if 0 <= y + dy < 3 else 0.0
                    for dy in (1, -1)
                ]
                for dx in (1, -1):
                    moved = np.array(
                        [at(y, x + dx, row[x]) - own[x] if 0 <= x + dx < 4 else 0 for x in range(4)]
                    )
                    from_there = moved[::-1].cumsum()
                    ratios += [moved.sum(), max(0.0, from_there.max()) - np.log(4)]
                total.append(np.log(1 - 1e-3 + 1e-3 * np.exp(ratios).mean()))
        return np.array(total)

    seen_gain, chance = gain(0), gain(64 // 4)
    wanted = (seen_gain.sum() - chance.sum()) / np.sqrt(2 * (chance**2).sum() + 4.0)
    assert z["space.misplaced.rows"] == pytest.approx(wanted, rel=1e-4)


@pytest.mark.parametrize("lines", ["rows", "columns"])
@pytest.mark.parametrize("move", MOVES)
def test_the_move_is_found(move, lines):
    shape, share = ((24, 20) if lines == "rows" else (20, 24)), 0.06
    effect = MisplacedLines(share=share, move=move, lines=lines)
    evidence = seen(taken(drawn_truth(shape), effect, n_frames=1200, seed=3))
    assert evidence.z[f"space.misplaced.{lines}"] > 8
    first, *_ = MisplacedLines.estimate(evidence)
    assert (first.move, first.lines) == (move, lines)
    # the pixels' histograms hold a share of their neighbours', so that the ratios are too small
    assert 0.4 < first.share / share < 1.3


@pytest.mark.parametrize("lines", ["rows", "columns"])
@pytest.mark.parametrize("move", MOVES)
def test_pixels_are_fitted_without_the_lines_that_were_moved(move, lines):
    shape, n_frames = ((16, 40) if lines == "rows" else (40, 16)), 600
    truth, effect = drawn_truth(shape), MisplacedLines(share=0.1, move=move, lines=lines)
    frames, plain = taken(truth, effect, n_frames=n_frames, seed=5), taken(truth, n_frames=n_frames, seed=5)
    found = own_lines(frames, np.ones(shape, np.bool_), [effect])
    moved = turned(frames != plain, lines).any(axis=2)
    replaced = turned(found != frames, lines).any(axis=2)
    # where a line is cut, few of its samples may have moved
    assert replaced[moved].mean() > (0.5 if "sample" in move else 0.8)
    assert replaced[~moved].mean() < 0.01
    assert own_lines(frames, np.ones(shape, np.bool_), [RowNoise(row_noise_dn=1.0)]) is frames


def test_a_line_in_two_places_is_misplaced_too_and_its_equality_tells():
    evidence = seen(taken(drawn_truth((18, 26)), RepeatedLines(share=0.05), n_frames=1200, seed=4))
    assert evidence.z["space.repeated.rows"] > evidence.z["space.misplaced.rows"] > 8
