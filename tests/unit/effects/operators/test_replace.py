"""Samples replaced by others: forward models, laws, and estimators."""

import numpy as np
import pytest
from helpers.small_sensors import context_of, drawn_truth, seen, taken

from pchem_pipeline.discrepancy.observe.misplaced import own_lines
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.effects.framework.neighbours import PREDICTORS, predicted
from pchem_pipeline.effects.operators.offsets import RowNoise
from pchem_pipeline.effects.operators.replace import (
    BitErrors,
    MisplacedLines,
    PixelCorrection,
    RepeatedFrames,
    RepeatedLines,
)
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.law.mass import sample_mass
from pchem_pipeline.model.law.sample_law import SampleLaw


def test_repeats_are_exact_copies_of_what_was_delivered():
    plain = np.random.default_rng(8).integers(90, 140, (14, 6, 5)).astype(np.uint16)
    listed = (1, 2, 5, 9, 10, 11)
    delivered = plain.copy()
    for t in listed:
        delivered[t] = delivered[t - 1]
    context = context_of((6, 5), 14)
    np.testing.assert_array_equal(RepeatedFrames(frames=listed).apply(plain, context), delivered)
    some = RepeatedFrames(frames=listed, rows=(2, 4)).apply(plain, context)
    np.testing.assert_array_equal(some[:, 2:4], delivered[:, 2:4])
    np.testing.assert_array_equal(np.delete(some, [2, 3], axis=1), np.delete(plain, [2, 3], axis=1))


def test_random_repeats_come_as_often_as_they_should():
    n_frames, p = 20_000, 0.1
    values = np.arange(n_frames, dtype=np.uint16).reshape(-1, 1, 1)
    out = RepeatedFrames(probability=p).apply(values, context_of((1, 1), n_frames)).ravel().astype(int)
    number = int((np.diff(out) == 0).sum())
    assert abs(number - p * n_frames) < 5 * np.sqrt(p * (1 - p) * n_frames)
    # a repeat of a repeat shows the frame that was last taken
    assert (np.arange(n_frames) - out).max() > 1
    assert out[0] == 0


def by_hand(code, bit, fault):
    """Return a code with a wrong bit, by its binary digits."""
    digits = list(f"{code:016b}")
    place = 15 - bit
    digits[place] = {"zero": "0", "one": "1", "flip": "10"[int(digits[place])]}[fault]
    return int("".join(digits), 2)


@pytest.mark.parametrize("fault", ["zero", "one", "flip"])
@pytest.mark.parametrize("bit", [0, 3, 5])
def test_a_stuck_bit_is_wrong_in_every_sample_and_another_in_its_share(bit, fault):
    frames = np.random.default_rng(1).integers(90, 140, (40, 50, 50)).astype(np.uint16)
    wrong = np.array([by_hand(code, bit, fault) for code in range(256)])[frames]
    every, some, lacking = (
        effect.apply(frames, context_of((50, 50), 40))
        for effect in (
            BitErrors(share=share, bit=n, fault=fault) for share, n in ((1, bit), (0.02, bit), (1, 14))
        )
    )
    np.testing.assert_array_equal(every, wrong)
    assert every.dtype == frames.dtype
    np.testing.assert_array_equal(lacking, frames)  # a bit that the converter lacks
    there = wrong != frames
    assert abs((some != frames).sum() - 0.02 * there.sum()) <= 5 * np.sqrt(0.02 * 0.98 * there.sum())
    np.testing.assert_array_equal(np.where(some != frames, wrong, frames), some)


def with_errors(plain, codes, effect):
    """Return masses (pixel, code) of which a share has a wrong bit; errors do not leave the codes."""
    exact = (1 - effect.share) * plain
    for place, code in enumerate(codes[:300]):
        exact[:, by_hand(int(code), effect.bit, effect.fault) - codes[0]] += effect.share * plain[:, place]
    return exact


@pytest.mark.parametrize("fault", ["zero", "one", "flip"])
def test_the_law_has_as_many_moved_samples_and_their_mean(fault):
    effect = BitErrors(share=0.01, bit=3, fault=fault)
    maps = PixelMaps(*np.array([[0.8, 2.5], [0.1, 0.07], [100.3, 97.0], [3.0, 3.4]]), np.ones(2, bool))
    codes = np.arange(40, 400)
    law = sample_mass(effect.sample_law(SampleLaw(), maps), maps, codes)
    np.testing.assert_allclose(law.sum(axis=1), 1.0, atol=1e-9)
    exact = with_errors(sample_mass(SampleLaw(), maps, codes), codes, effect)
    np.testing.assert_allclose(law @ codes, exact @ codes, atol=2e-4)


def test_the_law_takes_some_of_the_errors_out_of_the_read_noise():
    rng, n = np.random.default_rng(7), 24
    ranges = ((0.5, 3), (1 / 16, 1 / 8), (96, 112), (2.4, 4.2))
    maps = PixelMaps(*(rng.uniform(*each, n) for each in ranges), np.ones(n, bool))
    effect, codes = BitErrors(share=0.004, bit=3), np.arange(30, 500)
    mass = with_errors(sample_mass(SampleLaw(), maps, codes), codes, effect)
    counts, origin = np.rint(1e6 * mass).astype(np.uint32), np.full(n, 30)
    errors = []
    for law in (None, effect.sample_law(SampleLaw(), maps)):
        fit = fit_histograms(counts, origin, law=law, settings=FitSettings(tail_guard=0))
        errors.append(np.sqrt(np.nanmean(np.log(fit.read_noise_dn / maps.read_noise_dn) ** 2)))
    # from which codes the samples come, the law does not know, so it is not exact
    assert errors[1] < 0.7 * errors[0]
    assert errors[0] > 3e-3


BIT_CASES = [
    (BitErrors(share=0.004, bit=3), (40, 40), 2),
    (BitErrors(share=0.004, bit=3, fault="flip"), (32, 50), 3),
    (BitErrors(share=0.02, bit=1), (40, 40), 4),
    (BitErrors(share=0.002, bit=7), (40, 40), 5),
]


@pytest.mark.parametrize(("effect", "shape", "seed"), BIT_CASES)
def test_bit_fault_and_share_are_found(effect, shape, seed):
    truth = drawn_truth(shape, seed=seed)
    guesses = BitErrors.estimate(seen(taken(truth, effect, n_frames=2000, seed=seed)))
    assert {guess.bit for guess in guesses} == {effect.bit}
    found = next(guess for guess in guesses if guess.fault == effect.fault)
    # half of the pixels have no fit where a high bit is lost
    assert 0.4 < found.share / effect.share < 2.5


@pytest.mark.parametrize(("bit", "fault"), [(0, "zero"), (1, "one"), (3, "zero")])
def test_a_bit_that_never_changes_is_stuck(bit, fault):
    effect = BitErrors(share=1.0, bit=bit, fault=fault)
    truth = drawn_truth((16, 16))
    assert BitErrors.estimate(seen(taken(truth, effect, n_frames=800))) == (effect,)


def corrected_by_hand(frame, threshold, predictor):
    """Replace samples above what their neighbours predict, written down once more."""
    found = frame.copy()
    for y, x in np.ndindex(frame.shape[0] - 2, frame.shape[1] - 2):
        around = frame[y : y + 3, x : x + 3].astype(int).ravel()
        others = around[[3, 5]] if predictor == "row" else np.delete(around, 4)
        prediction = int(np.floor(np.median(others) if predictor == "median" else np.mean(others)))
        if around[4] - prediction > threshold:
            found[y + 1, x + 1] = prediction
    return found


@pytest.mark.parametrize("predictor", PREDICTORS)
def test_a_sample_above_the_threshold_becomes_what_its_neighbours_predict(predictor):
    shape = (7, 6)
    frames = np.random.default_rng(1).integers(90, 140, (5, *shape)).astype(np.uint16)
    effect = PixelCorrection(threshold_dn=12, predictor=predictor)
    found = effect.apply(frames, context_of(shape, 5))
    np.testing.assert_array_equal(found, [corrected_by_hand(f, 12, predictor) for f in frames])
    assert 5 < (found != frames).sum() < frames.size / 2


def test_the_share_replaces_some():
    shape = (40, 40)
    frames = np.random.default_rng(2).integers(90, 140, (30, *shape)).astype(np.uint16)
    context = context_of(shape, 30)
    every = PixelCorrection(threshold_dn=12).apply(frames, context) != frames
    some = PixelCorrection(threshold_dn=12, share=0.3).apply(frames, context) != frames
    assert not (some & ~every).any()
    n = int(every.sum())
    assert abs(some.sum() - 0.3 * n) < 5 * np.sqrt(0.21 * n)


def test_small_sensors_stay_as_they_are_and_small_dtypes_do_not_overflow():
    frames = np.array([[[100, 5000]]], np.uint16)  # no pixel has neighbours
    found = PixelCorrection(threshold_dn=1).apply(frames, context_of((1, 2), 1))
    np.testing.assert_array_equal(found, frames)
    bright = np.full((1, 3, 3), 250, np.uint8)
    assert [int(predicted(bright, kind)[0, 0, 0]) for kind in PREDICTORS] == [250, 250, 250]


CORRECTIONS = [
    (PixelCorrection(threshold_dn=40), (24, 24), 1600, 1),
    (PixelCorrection(threshold_dn=30, share=0.3), (24, 24), 1600, 2),
    (PixelCorrection(threshold_dn=50, predictor="mean"), (20, 40), 1200, 3),
    (PixelCorrection(threshold_dn=35, share=0.6, predictor="row"), (30, 16), 1200, 4),
]


@pytest.mark.parametrize(("effect", "shape", "n_frames", "seed"), CORRECTIONS)
def test_threshold_and_share_are_found(effect, shape, n_frames, seed):
    truth = drawn_truth(shape, seed=seed + 20)
    evidence = seen(taken(truth, effect, n_frames=n_frames, seed=seed))
    found, *_ = PixelCorrection.estimate(evidence)
    assert found.predictor == effect.predictor
    # thresholds are looked at every second DN here
    assert abs(found.threshold_dn - effect.threshold_dn) <= 2
    # a hundredth by chance; replaced neighbours lower the predictions of some of the samples beside
    assert found.share == pytest.approx(effect.share, rel=0.1)
    assert evidence.z["space.predicted.equal"] > 20.0


def test_a_rule_without_a_threshold_is_none_that_an_effect_can_have():
    truth = drawn_truth((24, 24), seed=25)
    frames = taken(truth, n_frames=1600, seed=5)
    inner, prediction = frames[:, 1:-1, 1:-1], predicted(frames, "row")
    some = np.random.default_rng(6).random(inner.shape) < 0.3
    inner[some] = np.minimum(inner, prediction)[some]
    assert all(found.threshold_dn > 0 for found in PixelCorrection.estimate(seen(frames)))


LINES_SHAPE, N_LINE_FRAMES = (9, 11), 300
MOVES = ("swapped", "early", "late", "sample_lost", "sample_twice", "line_lost", "line_twice")


def steps_of(effect):
    """Return from how many lines, and samples along them, further on each (frame, line, sample) comes."""
    places = np.arange(np.prod(LINES_SHAPE), dtype=np.uint16).reshape(LINES_SHAPE)
    frames = np.tile(places, (N_LINE_FRAMES, 1, 1))  # values tell where in the frame they come from
    found = effect.apply(frames, context_of(LINES_SHAPE, N_LINE_FRAMES)).astype(int)
    y, x = np.stack(np.divmod(found, LINES_SHAPE[1])) - np.indices(LINES_SHAPE)[:, None]
    return (y, x) if effect.lines == "rows" else (x.swapaxes(1, 2), y.swapaxes(1, 2))


@pytest.mark.parametrize("lines", ["rows", "columns"])
@pytest.mark.parametrize("move", MOVES)
def test_every_sample_comes_from_where_the_move_says(move, lines):
    share = 0.1
    across, along = steps_of(MisplacedLines(share=share, move=move, lines=lines))
    n, m = across.shape[1:]
    if move in ("swapped", "line_lost", "line_twice"):
        assert not along.any()
        assert not np.ptp(across, axis=2).any()
        off = across[:, :, 0]
    else:
        assert not across.any()
        off = along
    if move == "swapped":
        np.testing.assert_array_equal(off[:, :-1] == 1, off[:, 1:] == -1)
        assert set(np.unique(off)) == {-1, 0, 1}
        hits = (off == 1).sum()
    else:
        # from some place on; at the end of a line the last sample is repeated
        step = 1 if move in ("early", "sample_lost", "line_lost") else -1
        inner, end = (off[..., :-1], off[..., -1]) if step == 1 else (off[..., 1:], off[..., 0])
        assert not end.any()
        assert set(np.unique(inner)) == {0, step}
        assert (np.diff(abs(inner), axis=-1) >= 0).all()
        assert move not in ("early", "late") or not np.ptp(inner, axis=-1).any()
        hits = inner.any(axis=-1).sum()
    # of a line lost at the end, or a sample twice at the end, nothing is seen
    trials = N_LINE_FRAMES * (1 if move.startswith("line") else n)
    shown = {"swapped": 1 - 1 / n - share, "line_lost": 1 - 1 / n, "sample_lost": 1 - 1 / m}.get(move, 1.0)
    expected = trials * share * shown
    assert abs(hits - expected) < 5 * np.sqrt(expected)


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
    moved, replaced = (
        each.any(axis=2 if lines == "rows" else 1) for each in (frames != plain, found != frames)
    )
    # where a line is cut, few of its samples may have moved
    assert replaced[moved].mean() > (0.5 if "sample" in move else 0.8)
    assert replaced[~moved].mean() < 0.01
    assert own_lines(frames, np.ones(shape, np.bool_), [RowNoise(row_noise_dn=1.0)]) is frames


def test_a_line_in_two_places_is_misplaced_too_and_its_equality_tells():
    evidence = seen(taken(drawn_truth((18, 26)), RepeatedLines(share=0.05), n_frames=1200, seed=4))
    assert evidence.z["space.repeated.rows"] > evidence.z["space.misplaced.rows"] > 8


@pytest.mark.parametrize("lines", ["rows", "columns"])
def test_a_line_is_its_own_or_the_one_before(lines):
    across, along = steps_of(RepeatedLines(share=0.1, lines=lines))
    assert not along.any()
    assert not np.ptp(across, axis=2).any()
    assert set(np.unique(across)) == {-1, 0}
    repeats = across[:, 1:, 0]
    assert abs((repeats == -1).sum() - 0.1 * repeats.size) < 5 * np.sqrt(0.09 * repeats.size)
    assert not across[:, 0].any()


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
