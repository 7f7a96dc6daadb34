"""The rise that a candidate promises in one step, from information and score of each pixel."""

import numpy as np
import pytest

from pchem_pipeline.discrepancy.by_likelihood.sets import _one_step


def test_a_pixel_none_of_whose_samples_count_says_nothing():
    rng = np.random.default_rng(1)
    root = rng.standard_normal((3, 5, 9))
    information, score = root @ root.transpose(0, 2, 1), rng.standard_normal((3, 5))
    rise, length = _one_step(information, score, 4)
    # Schur complement of the pixels' own parameters
    left = sum(1.0 / np.linalg.inv(each)[-1, -1] for each in information)
    assert rise == pytest.approx(0.5 * length**2 * left, rel=1e-6)
    information, score = (
        np.concatenate([each, np.zeros((1, *each.shape[1:]))]) for each in (information, score)
    )
    assert _one_step(information, score, 4) == pytest.approx((rise, length))
    assert _one_step(np.zeros((2, 5, 5)), np.zeros((2, 5)), 4) == (0.0, 0.0)
