"""Places on the sensor and times in the run: what they hold, how they are written, what is refused."""

import json

import numpy as np
import pytest
from pydantic import ValidationError

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.effects.framework.pixel_sets import overlap
from pchem_pipeline.effects.framework.region import Region, Taps, When, parse_place

SHAPE = (12, 20)


TAPS_OF_ROWS = {"every": 2, "width": 3, "which": 1, "along": "rows", "first": 1}


@pytest.mark.parametrize(
    ("given", "part", "words"),
    [
        ({"columns": [12, 16]}, np.s_[:, 12:16], "columns 12 to 15"),
        ({"columns": 7}, np.s_[:, 7], "column 7"),
        ({"columns": "12:16"}, np.s_[:, 12:16], "columns 12 to 15"),
        ({"rows": [[0, 2], [5, 6]]}, np.s_[[0, 1, 5]], "rows 0 to 1 and 5"),
        ({"rows": [3, 10], "columns": [4, 8]}, np.s_[3:10, 4:8], "rows 3 to 9, columns 4 to 7"),
        ({"taps": {"every": 8, "which": 5}}, np.s_[:, 5::8], "every 8th column from 5"),
        (
            {"taps": {"width": 5, "which": [1, 3]}},
            np.s_[:, np.r_[5:10, 15:20]],
            "tap 1 and 3 (5 columns each)",
        ),
        ({"taps": TAPS_OF_ROWS}, np.s_[[0, 4, 5, 6, 10, 11]], "tap 1 of every 2 (3 rows each)"),
        ({"quadrant": "top right"}, np.s_[:6, 10:], "the top right quadrant"),
        (
            {"pixels": [[3, 4, 6], [4, 4, 5]]},
            np.s_[[3, 3, 4], [4, 5, 4]],
            "3 pixels of rows 3 to 4 and columns 4 to 5",
        ),
    ],
)
def test_region_holds_the_pixels_that_it_says(given, part, words):
    region, expected = Region.model_validate(given), np.zeros(SHAPE, bool)
    expected[part] = True
    np.testing.assert_array_equal(region.mask(SHAPE), expected)
    np.testing.assert_array_equal(region.mask(SHAPE, np.arange(2, 9)), expected[2:9])
    assert region.describe() == words
    assert Region.model_validate(json.loads(json.dumps(region.numbers()))) == region
    if not region.text().startswith("{"):
        assert Region.model_validate(region.text()) == region


@pytest.mark.parametrize(
    ("given", "expected", "words"),
    [
        ({"range": [2, 5]}, [2, 3, 4], "frames 2 to 4"),
        ({"every": 4, "phase": 1}, [1, 5, 9], "every 4th frame from 1"),
        ({"every": 4, "phase": 1, "length": 2}, [1, 2, 5, 6, 9], "2 of every 4 frames from 1"),
        ({"single": [3, 7]}, [3, 7], "frames 3 and 7"),
        ({"range": [2, 9], "every": 3}, [3, 6], "frames 2 to 8, every 3rd frame from 0"),
        ("frames=2:5", [2, 3, 4], "frames 2 to 4"),
        ("frames=3|7", [3, 7], "frames 3 and 7"),
        ("period=4/1", [1, 5, 9], "every 4th frame from 1"),
    ],
)
def test_when_holds_the_frames_that_it_says(given, expected, words):
    when = When.model_validate(given)
    numbers = np.arange(-3, 10)
    np.testing.assert_array_equal(numbers[when.frames(numbers)], expected)
    assert when.describe() == words
    assert When.model_validate(when.numbers()) == when
    assert when.share(np.arange(10)) == pytest.approx(len(expected) / 10)


def test_simplest_form_of_a_map():
    mask = np.zeros(SHAPE, np.bool_)
    mask[:, 12:16] = True
    assert Region.of_mask(mask) == Region(columns=((12, 16),))
    mask[:3] = False
    assert Region.of_mask(mask) == Region(rows=((3, 12),), columns=((12, 16),))
    mask[5, 13] = False
    blob = Region.of_mask(mask)
    assert blob.pixels
    np.testing.assert_array_equal(blob.mask(SHAPE), mask)
    every = Region.of_mask(np.ones(SHAPE, np.bool_))
    assert every.mask(SHAPE).all()
    with pytest.raises(ConfigError, match="without a pixel"):
        Region.of_mask(np.zeros(SHAPE, np.bool_))


def test_overlap_is_shared_over_either():
    one, other = Region(columns=((0, 10),)), Region(columns=((5, 15),))
    assert one.overlap(other, SHAPE) == pytest.approx(5 / 15)
    assert one.overlap(one, SHAPE) == 1.0
    assert When(range=((0, 10),)).overlap(When(range=((8, 12),)), 20) == pytest.approx(2 / 12)
    assert overlap(np.zeros(3, np.bool_), np.zeros(3, np.bool_)) == 0.0


def test_place_and_time_in_one_line():
    region, when = parse_place("columns=40:50, taps=5/8|9, frames=200:400, period=10/3")
    assert region == Region(columns=((40, 50),), taps=Taps(width=5, which=(8, 9)))
    assert when == When(range=((200, 400),), every=10, phase=3)
    assert parse_place("quadrant=top-left")[0] == Region(quadrant="top left")


@pytest.mark.parametrize(
    "text", ["columns", "columns=", "colums=3:5", "columns=a:b", "taps=3", "rows=1:2,rows=3:4", ""]
)
def test_a_wrong_line_says_the_grammar(text):
    with pytest.raises(ValueError, match=r"columns=A:B|given twice"):
        parse_place(text)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "no place is given"),
        ({"columns": [5, 5]}, "5:5 is no range"),
        ({"columns": [-1, 5]}, "-1:5 is no range"),
        ({"taps": {"every": 4, "which": 4}}, "there is no group"),
        ({"taps": {"which": 4}}, "give width, or every"),
        ({"quadrant": "middle"}, "top left"),
        ({"pixels": [[1, 5, 2]]}, r"last column \+ 1"),
        ({"mask": "nothing.npy"}, "cannot be read"),
        ("frames=2:3", "no place"),
    ],
)
def test_a_wrong_region_is_refused(given, message):
    with pytest.raises(ValidationError, match=message):
        Region.model_validate(given)


def test_a_region_beyond_the_sensor_is_refused():
    with pytest.raises(ConfigError, match=r"columns 12 to 29: the sensor has 20 columns"):
        Region(columns=((12, 30),)).mask(SHAPE)
    with pytest.raises(ConfigError, match=r"12 rows"):
        Region(pixels=((12, 0, 1),)).mask(SHAPE)


def test_a_mask_file_lies_beside_the_yaml_and_is_a_map_and_nothing_else(tmp_path):
    mask = np.random.default_rng(3).random(SHAPE) < 0.3
    np.save(tmp_path / "mask.npy", mask)
    np.savez(tmp_path / "mask.npz", mask)
    np.save(tmp_path / "number.npy", np.ones(SHAPE))
    np.save(tmp_path / "object.npy", np.array([{}]), allow_pickle=True)
    for name in ("mask.npy", "mask.npz"):
        region = Region.model_validate({"mask": name}, context={"folder": tmp_path})
        np.testing.assert_array_equal(region.mask(SHAPE), mask)
        assert "mask" not in region.numbers()
    for name, words in (("number.npy", "save a bool array"), ("object.npy", "cannot be read")):
        with pytest.raises(ValidationError, match=words):
            Region.model_validate({"mask": str(tmp_path / name)})
