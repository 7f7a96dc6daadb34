"""Pixel correction: its forward model, what it shows, and what its estimator makes of that."""

import numpy as np
import pytest
from helpers.small_sensors import context_of, drawn_truth, seen, taken

from pchem_pipeline.effects.framework.neighbours import PREDICTORS, predicted
from pchem_pipeline.effects.operators.replace import PixelCorrection


def predicted_by_hand(frame, y, x, predictor):
    """Return what the neighbours of one sample predict, written down once more."""
    around = [int(frame[y + b, x + a]) for b in (-1, 0, 1) for a in (-1, 0, 1) if a or b]
    if predictor == "row":
        around = [int(frame[y, x - 1]), int(frame[y, x + 1])]
    return int(np.floor(np.median(around) if predictor == "median" else np.mean(around)))


def corrected_by_hand(frame, threshold, predictor):
    found = frame.copy()
    for y in range(1, frame.shape[0] - 1):
        for x in range(1, frame.shape[1] - 1):
            prediction = predicted_by_hand(frame, y, x, predictor)
            if int(frame[y, x]) - prediction > threshold:
                found[y, x] = prediction
    return found


@pytest.mark.parametrize("predictor", PREDICTORS)
def test_a_sample_above_the_threshold_becomes_what_its_neighbours_predict(predictor):
    shape = (7, 6)
    frames = np.random.default_rng(1).integers(90, 140, (5, *shape)).astype(np.uint16)
    effect = PixelCorrection(threshold_dn=12, predictor=predictor)
    found = effect.apply(frames, context_of(shape, 5))
    np.testing.assert_array_equal(found, [corrected_by_hand(f, 12, predictor) for f in frames])
    assert 5 < (found != frames).sum() < frames.size / 2


def test_the_share_replaces_some_and_zero_none():
    shape = (40, 40)
    frames = np.random.default_rng(2).integers(90, 140, (30, *shape)).astype(np.uint16)
    context = context_of(shape, 30)
    every = PixelCorrection(threshold_dn=12).apply(frames, context) != frames
    some = PixelCorrection(threshold_dn=12, share=0.3).apply(frames, context) != frames
    assert not (some & ~every).any()
    n = int(every.sum())
    assert abs(some.sum() - 0.3 * n) < 5 * np.sqrt(0.21 * n)
    np.testing.assert_array_equal(PixelCorrection(threshold_dn=12, share=0).apply(frames, context), frames)


def test_a_sensor_too_small_to_have_neighbours_stays_as_it_is():
    frames = np.array([[[100, 5000]]], np.uint16)
    np.testing.assert_array_equal(
        PixelCorrection(threshold_dn=1).apply(frames, context_of((1, 2), 1)), frames
    )


def test_predictions_of_odd_dtypes_do_not_overflow():
    frames = np.full((1, 3, 3), 250, np.uint8)
    assert [int(predicted(frames, kind)[0, 0, 0]) for kind in PREDICTORS] == [250, 250, 250]


CASES = [
    (PixelCorrection(threshold_dn=40), (24, 24), 1600, 1),
    (PixelCorrection(threshold_dn=30, share=0.3), (24, 24), 1600, 2),
    (PixelCorrection(threshold_dn=50, predictor="mean"), (20, 40), 1200, 3),
    (PixelCorrection(threshold_dn=35, share=0.6, predictor="row"), (30, 16), 1200, 4),
]


@pytest.mark.parametrize(("effect", "shape", "n_frames", "seed"), CASES)
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


def test_the_rule_says_what_comes_out_in_the_stead_of_a_sample():
    frames = np.random.default_rng(4).integers(90, 140, (5, 7, 6)).astype(np.uint16)
    effect = PixelCorrection(threshold_dn=12)
    rule = effect.replacement(frames)
    changed = effect.apply(frames, context_of((7, 6), 5)) != frames
    assert changed.any()
    assert not changed[:, ~rule.inside].any()
    np.testing.assert_array_equal(
        changed, (frames.astype(int) - rule.value > rule.excess) & rule.inside & (frames != rule.value)
    )
    assert not PixelCorrection(threshold_dn=1).replacement(frames[:, :2]).inside.any()
