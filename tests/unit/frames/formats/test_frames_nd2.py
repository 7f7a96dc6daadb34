"""ND2, written by hand chunk by chunk."""

import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from helpers.camera_files import opened, refused
from helpers.nd2_files import nd2_bytes

STACK = np.random.default_rng(18).integers(0, 4096, (5, 11, 13)).astype("<u2")
WORDS = "Flash4.0, SN:VSC-01412&#13;&#10;Sample 1:&#13;&#10;  Exposure: 100 ms&#13;&#10;  Binning: 1x1"


@pytest.mark.parametrize("compressed", [False, True])
def test_nd2(tmp_path, compressed):
    pytest.importorskip("nd2")
    path = tmp_path / "a.nd2"
    path.write_bytes(nd2_bytes(STACK, words=WORDS, compressed=compressed))
    reader = opened(path)
    assert (reader.integration_time, reader.bit_depth) == (pytest.approx(0.1), 12)
    assert reader.camera.words() == "Flash4.0, serial number VSC-01412"
    assert not reader.report.notes
    for each in (reader, pickle.loads(pickle.dumps(reader))):
        np.testing.assert_array_equal(each.read(), STACK)
        np.testing.assert_array_equal(each.read(1, 4, 2, 9), STACK[1:4, 2:9])
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda t: reader.read(t % 5, t % 5 + 1)[0], range(40)))
    np.testing.assert_array_equal(found, STACK[np.arange(40) % 5])
    path.write_bytes(nd2_bytes(STACK[:, :1]))
    np.testing.assert_array_equal(opened(path).read(), STACK[:, :1])


def test_refusals(tmp_path):
    pytest.importorskip("nd2")
    path = tmp_path / "a.nd2"
    good = nd2_bytes(STACK)
    colours = np.stack([STACK, STACK], axis=-1)
    for data, words in (
        (nd2_bytes(colours, channels=2), "2 channels or colours; export one"),
        (nd2_bytes(STACK.astype("<f4"), bits=32), "floating-point samples"),
        (good[:-100], r"not a valid ND2 file, or truncated"),
        (good[:300], r"not a valid ND2 file, or truncated"),
        (b"\0\0\0\x0cjP  " + bytes(200), "old kind|not a valid ND2 file"),
    ):
        path.write_bytes(data)
        refused(words, path)
