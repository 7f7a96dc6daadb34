"""SIF, written by hand line by line."""

import numpy as np
import pytest
from helpers.camera_files import opened, refused
from helpers.sif_files import sif_bytes

STACK = np.random.default_rng(17).integers(0, 65536, (5, 11, 13)).astype(np.uint32)


def test_sif(tmp_path):
    pytest.importorskip("sif_parser")
    path = tmp_path / "a.sif"
    path.write_bytes(sif_bytes(STACK))
    reader = opened(path)
    np.testing.assert_array_equal(reader.read(), STACK)
    np.testing.assert_array_equal(reader.read(1, 4, 2, 9), STACK[1:4, 2:9])
    assert reader.integration_time == 0.25
    assert reader.camera.words() == "DU-897_BV, sensor at -80 °C, binning 1 x 1, gain 300"
    np.testing.assert_allclose(reader.timestamps, 1.7e9 + 0.5 * np.arange(5))
    assert not reader.report.notes
    path.write_bytes(sif_bytes(STACK, sums=3, step=0))
    reader = opened(path)
    assert reader.timestamps is None
    assert "each frame is the sum of 3 exposures" in reader.report.notes[0]


def test_refusals(tmp_path):
    pytest.importorskip("sif_parser")
    path = tmp_path / "a.sif"
    good = sif_bytes(STACK)
    path.write_bytes(sif_bytes(STACK, tracks=2))
    refused("2 tracks or areas", path)
    for kept in (40, 100, 200, 300, len(good) - STACK.size * 4 - 8, len(good) - 1):
        path.write_bytes(good[:kept])
        refused(r"a\.sif: .*(not a valid SIF file, or )?truncated", path)
    path.write_bytes(sif_bytes(STACK - 0.5))
    refused("samples such as .*, raw whole numbers are needed", path)
