"""Overscan: its bias and noise, and the offsets of rows and frames that it tells."""

import numpy as np
import pytest

from pchem_pipeline.use.common_modes import CommonModes, Reference, estimate_offsets
from pchem_pipeline.use.overscan import Overscan

NY, NX, M, N = 40, 24, 8, 400
SIGMA = 1.5  # DN, before rounding
OWN = SIGMA**2 + 1 / 12


def region(across):
    """An overscan of the last M columns, or rows."""
    where = np.zeros((NY, NX), bool)
    where[np.s_[-M:] if across else np.s_[:, -M:]] = True
    return where


def taken(seed, row=0.0, frame=0.0, drift=0.0, n=N):
    """Frames, the bias, and the offsets that the rows have, (frame, y)."""
    rng = np.random.default_rng(seed)
    bias = np.random.default_rng(7).normal(200.0, 5.0, (NY, NX))
    offset = drift + frame * rng.standard_normal((n, 1)) + row * rng.standard_normal((n, NY))
    dn = np.rint(bias + offset[:, :, None] + SIGMA * rng.standard_normal((n, NY, NX)))
    return dn.astype(np.uint16), bias, offset


def shared_errors(row, frame, rows, pixels, n):
    """Standard errors of the variances of rows and frames: of sums of squares of normal numbers."""
    within = row**2 + OWN / pixels
    return within * np.sqrt(2 / (n * (rows - 1))), (frame**2 + within / rows) * np.sqrt(2 / n)


@pytest.mark.parametrize("across", [False, True])
@pytest.mark.parametrize(("row", "frame"), [(0.0, 0.0), (0.8, 0.0), (0.6, 1.2)])
def test_bias_noise_and_variances_are_right_within_their_errors(row, frame, across):
    (frames, bias, offset), where = taken(1, row, frame), region(across)
    found = Overscan.measured(frames[:, where].astype(float), where)
    assert (np.isfinite(found.bias) == where).all()
    assert found.n_frames == N
    own = bias + offset.mean(axis=0)[:, None]
    z = ((found.bias - own) / np.sqrt(OWN / N))[where]
    assert abs(z.mean()) < 5 / np.sqrt(z.size)
    assert abs(z.std() - 1) < 5 / np.sqrt(2 * z.size)
    rows, pixels = (M, NX) if across else (NY, M)
    of_row, of_frame = shared_errors(row, frame, rows, pixels, N)
    assert abs(found.row_variance - row**2) < 5 * of_row
    assert abs(found.frame_variance - frame**2) < 5 * of_frame
    error = np.sqrt(2 / (N * where.sum())) + (of_row + of_frame) / OWN
    assert abs(found.own_variance[where].mean() / OWN - 1) < 5 * error


def test_pixels_that_never_change_tell_nothing():
    (frames, _, _), where = taken(1, 0.8), region(across=False)
    frames[:, 3:9, -2] = 77  # padding
    found = Overscan.measured(frames[:, where].astype(float), where)
    assert np.isnan(found.bias[3:9, -2]).all()
    less = where & np.isfinite(found.bias)
    same = Overscan.measured(frames[:, less].astype(float), less)
    assert (found.row_variance, found.frame_variance) == (same.row_variance, same.frame_variance)
    nothing = Overscan.measured(np.full((9, where.sum()), 77.0), where)
    assert np.isnan(nothing.bias).all()
    assert nothing.shared_variance == 0.0


def corrected(row, frame=0.0, drift=0.0, across=False):
    """Offsets of the light-sensitive rows of other frames, before and after, and the variance that stays."""
    (frames, _, offset), where = taken(2, row, frame), region(across)
    overscan, usual = Overscan.measured(frames[:, where].astype(float), where), offset.mean(axis=0)
    frames, _, offset = taken(3, row, frame, drift, 300)
    modes = CommonModes.of_overscan(overscan, frames[:256, where].astype(float))
    found = estimate_offsets(frames, Reference.of_overscan(overscan), modes)
    light = np.s_[:, : NY - M if across else NY]
    before = (offset - usual)[light]  # the bias of the run includes the mean of its offsets
    return before, before - found.rows[:, 0][light], found.left.mean()


def expected(row, frame, across=False):
    """Variances that stay: of rows on their own, and with their frames (best linear prediction, by hand)."""
    rows, own = (M, OWN / NX) if across else (NY, OWN / M)
    of_frame = 1 / (1 / frame**2 + rows / (row**2 + own)) if frame else 0.0
    share = 0.0 if across else row**2 / (row**2 + own)  # no light-sensitive row has an overscan there
    return row**2 * (1 - share), of_frame * (1 - share) ** 2


@pytest.mark.parametrize(
    ("row", "frame", "drift", "across"),
    [
        (0.8, 0.0, 0.0, False),
        (0.3, 0.0, 0.0, False),
        (0.6, 1.5, 0.0, False),
        (0.6, 0.0, 30.0, False),
        (0.6, 1.5, 0.0, True),
    ],
)
def test_row_noise_falls_to_what_theory_says(row, frame, drift, across):
    before, after, left = corrected(row, frame, drift, across)
    of_row, of_frame = expected(row, frame or drift, across)
    # sums of squares; the frames' part is common to their rows
    error = of_row * np.sqrt(2 / after.size) + of_frame * np.sqrt(2 / len(after))
    # and a little of the bias and of the variances that were estimated
    assert abs((after**2).mean() - of_row - of_frame) < 5 * error + 0.02 * of_row
    # the variances are of 256 frames
    assert abs(left / (of_row + of_frame) - 1) < 5 * np.sqrt(2 / (256 * ((M if across else NY) - 1)))
    assert (after**2).mean() < (before**2).mean()


def test_frames_without_offsets_get_no_worse():
    """The variances are found as 0, or within 5 standard errors of it."""
    before, after, _ = corrected(0.0)
    assert (before**2).max() == 0.0
    most = (5 * np.sqrt(2 / (256 * (NY - 1)))) ** 2 + (5 * np.sqrt(2 / 256)) ** 2 / NY
    assert (after**2).mean() < most * OWN / M
    assert most * OWN / M < 0.002 * OWN
