"""The overscan of a stack of files, in the YAML's words."""

import numpy as np

from pchem_pipeline.frames.open import open_frames
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.stages.overscan import overscan_samples
from pchem_pipeline.use.overscan import Overscan


def test_samples_are_those_of_the_files_without_odd_frames(tmp_path):
    """Dark reference rows of an npy file; two frames are empty, one is far."""
    rng = np.random.default_rng(3)
    stack = np.rint(rng.normal(300.0, 2.0, (80, 12, 10))).astype(np.uint16)
    stack[[4, 50]] = 0
    stack[9] += 400
    np.save(tmp_path / "a.npy", stack)
    mask = np.zeros((12, 10))
    mask[1, 3] = 1
    np.save(tmp_path / "mask.npy", mask)
    settings = InputSettings(files=("a.npy",), overscan=((0, 2, 0, 10),), mask="mask.npy")
    frames = open_frames(settings, tmp_path)
    where = frames.overscan_pixels
    assert (np.flatnonzero(where) == np.setdiff1d(np.arange(20), 13)).all()
    kept = np.setdiff1d(np.arange(80), [4, 9, 50])
    np.testing.assert_array_equal(list(overscan_samples(frames, where)), stack[kept][:, where])
    assert len(list(overscan_samples(frames, where, 8))) <= 8
    found = Overscan.measured(overscan_samples(frames, where), where)
    assert abs(np.nanmedian(found.read_noise_dn) - 2.0) < 5 * 2.0 / np.sqrt(2 * 77 * 19) * 1.25
    assert found.shared_variance < 5 * (2.0**2 / 19 + 1 / 228) * np.sqrt(2 / 76)
