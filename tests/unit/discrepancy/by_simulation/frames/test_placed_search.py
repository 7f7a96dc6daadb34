"""Effects with a place: found where they are in frames that plain numpy made, and told on the sensor."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.small_sensors import seen

from pchem_pipeline.discrepancy.by_simulation.explainer import find_discrepancies
from pchem_pipeline.discrepancy.by_simulation.frames.frame_stack import FrameStack
from pchem_pipeline.discrepancy.by_simulation.frames.observed import ObservedFrames
from pchem_pipeline.discrepancy.by_simulation.frames.suspects import suspected_parts
from pchem_pipeline.discrepancy.by_simulation.sensor.replicate import Acquisition, simulate_frames
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.observe.places import Part, SensorWindow, part_evidence, part_statistics
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.discrepancy.splits import block_length, split_frames
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.effects.framework.region import Region, When
from pchem_pipeline.effects.framework.registry import effect_classes
from pchem_pipeline.effects.operators.couple import EmpiricalResponse, ResponseTerm
from pchem_pipeline.effects.operators.offsets import RowNoise

SHAPE, FRAMES = (24, 24), 1500


def camera(seed, add, shape=SHAPE, n_frames=FRAMES, noise=0.28):
    """Return frames of a sensor, Poisson electrons and Gaussian read noise, and ``add(rng, shape)`` DN."""
    rng = np.random.default_rng(seed)
    exposure = np.clip(1.5 * np.exp(0.4 * rng.standard_normal(shape)), 0.3, 5.0)
    step, bias = rng.normal(11.0, 0.8, shape), rng.normal(100.0, 4.0, shape)
    noise = noise * np.exp(0.12 * rng.standard_normal(shape))
    charge = rng.poisson(exposure, (n_frames, *shape))
    x = bias + step * (charge + noise * rng.standard_normal(charge.shape))
    return np.rint(np.clip(x + add(rng, charge.shape), 0, 4095)).astype(np.uint16)


def placed(part, size, *common):
    """Return what adds normal noise, DN, that samples of a part share along some axes."""

    def add(rng, shape):
        offsets = np.zeros(shape)
        lengths = [1 if axis in common else n for axis, n in enumerate(offsets[part].shape)]
        offsets[part] = rng.normal(0.0, size, lengths)
        return offsets

    return add


rows_of_columns = placed(np.s_[:, :, 17:22], 1.2, 2)
frames_of_quadrant = placed(np.s_[:, 12:, :12], 0.6, 1, 2)
rows_of_frames = placed(np.s_[600:760], 0.7, 2)
late_flicker = placed(np.s_[1176:1336], 4.0, 1, 2)


def every_eighth(rng, shape):
    offsets = np.zeros(shape)
    offsets[:, :, 3::8] = 0.4 * (1 - 2 * (np.arange(shape[0]) % 2))[:, None, None]
    return offsets


def tails(part):
    """Return what adds noise four times as wide, DN, to a few of the samples of a part."""

    def add(rng, shape):
        inside = np.zeros(shape, bool)
        inside[part] = True
        return np.where(inside & (rng.random(shape) < 0.008), rng.normal(0.0, 12.0, shape), 0.0)

    return add


def everywhere(rng, shape):
    return rng.normal(0.0, 0.6, (*shape[:2], 1)) + 0.3 * np.linspace(-1, 1, shape[0])[:, None, None]


def nothing(rng, shape):
    return 0.0


def parts_of(frames):
    return suspected_parts(seen(frames), frames)


@pytest.mark.parametrize(
    ("seed", "add", "place", "least"),
    [
        (1, rows_of_columns, Region(columns=((17, 22),)), 0.8),
        (1, frames_of_quadrant, Region(rows=((12, 24),), columns=((0, 12),)), 0.8),
        (1, every_eighth, Region.model_validate("every=8/3"), 0.8),
        (3, rows_of_frames, When(range=((600, 760),)), 0.8),
        # what no map and no series of means shows
        (1, tails(np.s_[:, :, 14:18]), Region(columns=((14, 18),)), 0.7),
        (1, tails(np.s_[640:800]), When(range=((640, 800),)), 0.6),
    ],
)
def test_a_part_of_sensor_or_run_that_differs_is_suspected(seed, add, place, least):
    [part] = parts_of(camera(seed, add))
    found, other = (part.region, part.when) if isinstance(place, Region) else (part.when, part.region)
    assert other is None
    assert found.overlap(place, SHAPE if isinstance(place, Region) else FRAMES) >= least


@pytest.mark.parametrize("add", [nothing, everywhere, tails(np.s_[:])])
def test_no_part_is_suspected_where_none_differs(add):
    assert parts_of(camera(4, add)) == ()


def test_a_part_is_suspected_by_what_several_shapes_show_together():
    """As of telegraph noise in three rows: no map has the place by itself, and chance has none."""
    frames = camera(7, nothing)
    clean = seen(frames)
    rng, rows = np.random.default_rng(11), slice(5, 8)

    def parts(shift, names):
        scores = {name: rng.standard_normal(clean.maps.usable.shape) for name in clean.scores}
        for name in names:
            scores[name][rows] += shift
        return suspected_parts(replace(clean, scores=scores), frames)

    names, found = list(clean.scores), Region(rows=((5, 8),))
    shift = 5.0 / np.sqrt(3.0 * SHAPE[1])
    assert all(parts(0.0, names) == () for _ in range(2))
    # in a map by itself, of thousands of places in two dozen maps, five standard errors are nothing
    assert sum(len(parts(shift, names[:1])) for _ in range(2)) <= 1
    overlaps = [part.region.overlap(found, SHAPE) for _ in range(3) for part in parts(shift, names[:5])]
    assert len(overlaps) >= 2
    assert np.median(overlaps) >= 0.8


def test_statistics_of_a_part_are_those_of_a_sensor_of_its_own():
    frames = camera(7, rows_of_columns)
    maps = seen(frames).maps
    part = Part(Region(columns=((17, 22),)))
    found = part_statistics(frames, np.arange(FRAMES), maps, [part], block_frames=50)
    alone = seen(np.ascontiguousarray(frames[:, :, 17:22]))
    name = "space.x.rr@columns=17:22"
    assert found[name] == pytest.approx(alone.z["space.x.rr"], rel=0.01)
    assert found[name] > 15.0
    assert STATISTICS[name].family == "space"
    assert "in columns 17 to 21" in STATISTICS[name].sentence
    boxes = '{"pixels":[[1,2,4]]},frames=3:9'  # what the grammar has no words for
    assert "frames 3 to 8" in STATISTICS[f"space.x.rr@{boxes}"].sentence
    with pytest.raises(KeyError):
        STATISTICS["nothing@columns=17:22"]


def test_effects_are_told_on_the_sensor_and_act_in_the_window():
    window = SensorWindow((8, 24), (4, 20), (40, 32))
    places = "columns=10:14", "columns=24:30", "rows=0:30"
    effects = [RowNoise(row_noise_dn=4.0, region=place) for place in places]
    inside = window.effects(effects)
    assert [e.region for e in inside] == [Region(columns=((6, 10),)), None]
    assert window.on_sensor(Region(columns=((6, 10),))) == Region(columns=((10, 14),))
    assert window.on_sensor(Region.model_validate("every=8/3")) == Region.model_validate("every=8/7")
    assert window.on_sensor(None) is None
    maps = PixelMaps(*(np.full((16, 16), v) for v in (1.5, 0.1, 100.0, 3.0)), np.ones((16, 16), bool))
    taken = Acquisition(np.arange(60), 60, 10, 12, window=window)
    moved = simulate_frames(maps, (effects[0],), 3, taken) != simulate_frames(maps, (), 3, taken)
    np.testing.assert_array_equal(np.flatnonzero(moved.any(axis=(0, 1))), [6, 7, 8, 9])


def test_a_region_that_ends_with_the_window_ends_where_the_whole_sensor_shows_it():
    tap, block = Region(columns=((12, 30),)), Region(rows=((4, 30),), columns=((6, 12),))
    window = SensorWindow((8, 24), (4, 20), (40, 32), (block, tap))
    # the window shows columns 8 to 15 of the tap; its own end is told by the window, the other by the sensor
    assert window.on_sensor(Region(columns=((8, 16),))) == tap
    assert window.on_sensor(Region(columns=((9, 16),))) == Region(columns=((13, 30),))
    assert window.on_sensor(Region(columns=((2, 8),))) == block
    # what is elsewhere, or smaller, is not that
    assert window.on_sensor(Region(columns=((12, 16),))) == Region(columns=((16, 20),))
    assert window.on_sensor(Region(rows=((0, 4),))) == Region(rows=((8, 12),))
    assert window.effects([RowNoise(row_noise_dn=1.0, region=tap)])[0].region == Region(columns=((8, 16),))


def test_an_effect_in_a_tap_of_a_window_is_named_with_its_place():
    window = SensorWindow((100, 116), (40, 64), (512, 512))
    frames = camera(8, rows_of_columns, (16, 24), 1000)
    settings = DiscrepancySettings(candidates=("row_noise",), replicates=20, extended_replicates=12)
    found = find_discrepancies(frames, settings=settings, window=window)
    assert found.verdict.verdict == "named"
    assert found.verdict.effects == ("row_noise",)
    [effect] = found.model
    assert effect.region.overlap(Region(columns=((57, 62),)), (512, 512)) >= 0.8
    [step] = found.verdict.steps
    assert abs(effect.row_noise_dn - 1.2) < 4.0 * step.parameters["row_noise_dn"].stderr + 0.06
    assert "in columns 57 to 61" in found.verdict.sentence
    told = [place for place in found.verdict.where if "@" in place.statistic]
    assert told[0].region == {"columns": [[57, 62]]}
    assert told[0].shifted((512, 512), window.rows, window.columns) == told[0]
    assert step.place == "columns 57 to 61"


@pytest.mark.parametrize("window", [None, SensorWindow((7, 31), (4, 28), (64, 64))])
def test_what_is_guessed_in_a_part_has_its_phase_on_the_sensor(window):
    """A part is a sensor of its own: its first row is row 0, which is another one of the whole."""
    top = 0 if window is None else window.rows[0]
    per_row, per_frame, phase, rows = 0.23, 0.31, 0.7, slice(5, 18)

    def pickup(rng, shape):
        turns = per_row * (np.arange(shape[1]) + top) + per_frame * np.arange(shape[0])[:, None]
        wave = np.zeros(shape)
        wave[:, rows] = 2.0 * np.sin(2 * np.pi * turns + phase)[:, rows, None]
        return wave

    frames, numbers = camera(21, pickup, (24, 24), 1200), np.arange(1200)
    maps = seen(frames).maps
    part = Part(Region(rows=((rows.start + top, rows.stop + top),)))
    own = part_evidence(frames, numbers, maps, part, n_run=1200, block_frames=50, window=window)
    guess = effect_classes()["periodic_pickup"].estimate(own)[0]
    found = (window or SensorWindow.whole((24, 24))).found(guess, part)
    assert found.region == part.region
    assert found.amplitude_dn == pytest.approx(2.0, rel=0.2)
    assert found.cycles_per_row == pytest.approx(per_row, abs=0.002)
    assert abs(np.angle(np.exp(1j * (found.phase - phase)))) < 0.15


def test_what_is_a_spot_by_itself_is_not_cut_off_by_the_part_that_showed_it():
    part = Part(Region(rows=((5, 18),)), When(range=((100, 300),)))
    guess = effect_classes()["glow"](peak_e=2.0, centre_y=0.5, radius=0.3)
    found = SensorWindow.whole((26, 24)).found(guess, part)
    assert found.region is None
    assert found.when == part.when
    assert found.centre_y == pytest.approx((5 + 0.5 * 13) / 26, abs=0.03)
    image = effect_classes()["persistence"](peak_e=2.0, decay_frames=90.0, image=((0.0, 1.0),))
    assert SensorWindow.whole((26, 24)).found(image, part).region == part.region


def test_the_ends_of_a_range_are_told_beyond_the_blocks_that_were_not_seen():
    numbers, splits = np.arange(1400), split_frames(np.arange(1400), block_length(1400))
    stack = FrameStack(camera(11, late_flicker, (16, 24), 1400), numbers, splits, 1400, 12, 1.0)
    frames = ObservedFrames.of(stack).frames
    [part] = frames.parts
    assert part.region is None
    assert part.when.overlap(When(range=((1176, 1336),)), 1400) >= 0.9
    # none of the frames of the last word is looked at
    assert np.intersect1d(frames.splits.final, frames.seen).size == 0


def test_a_range_of_few_frames_of_poor_pixels_has_statistics():
    frames = camera(13, lambda rng, shape: 3.0 * rows_of_frames(rng, shape), (16, 24), noise=0.42)
    numbers, maps = np.arange(FRAMES), seen(frames).maps
    some = np.flatnonzero(numbers // 20 % 3 == 0)
    part = Part(when=When(range=((600, 760),)))
    quiet = Part(when=When(range=((900, 1060),)))
    found = part_statistics(frames[some], numbers[some], maps, [part, quiet], block_frames=20)
    assert found["space.row.readout.variance@frames=600:760"] > 5.0
    assert abs(found["space.row.readout.variance@frames=900:1060"]) < 4.0


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("tag", "rows"), [("row_noise", 16), ("frame_noise", 1)])
def test_estimators_look_at_frames_of_a_period_that_have_no_next_one(tag, rows):
    every_tenth = placed(np.s_[7::10], 1.5, *((2,) if rows > 1 else (1, 2)))
    frames, numbers = camera(14, every_tenth, (16, 24)), np.arange(FRAMES)
    evidence = seen(frames)
    [part] = suspected_parts(evidence, frames)
    assert part == Part(when=When(every=10, phase=7))
    own = part_evidence(frames, numbers, evidence.maps, part, n_run=FRAMES, block_frames=50)
    guesses = {name: cls.estimate(own) for name, cls in effect_classes().items()}
    [found] = guesses[tag]
    # a guess: the fit of 150 frames takes a part of it
    assert 0.7 < getattr(found, found.strength) / 1.5 < 1.2


def stack_of(window):
    """Return frames of zeros of a window of 8 rows of 6 columns."""
    rows, columns = ((0, 8), (0, 6)) if window is None else (window.rows, window.columns)
    zeros = np.zeros((400, rows[1] - rows[0], columns[1] - columns[0]), np.uint16)
    taken = {"n_run": None, "bit_depth": 12, "integration_time": 1.0, "window": window}
    return FrameStack.of(zeros, np.arange(400), None, **taken)


@pytest.mark.parametrize(
    ("rows", "columns", "whole"),
    [
        ((0, 8), (0, 6), {"row", "column"}),
        ((2, 6), (0, 6), {"row"}),
        ((0, 8), (1, 6), {"column"}),
        ((0, 7), (0, 5), set()),
    ],
)
def test_the_shape_of_a_line_is_known_where_the_window_has_it_from_end_to_end(rows, columns, whole):
    assert stack_of(SensorWindow(rows, columns, (8, 6))).whole_lines == whole


def test_what_is_measured_in_a_window_is_told_on_the_sensor():
    measured = EmpiricalResponse(response=0.1, terms=(ResponseTerm(place=(0, 0, -1), columns=(0, 2)),))
    of_window = stack_of(SensorWindow((2, 6), (1, 6), (8, 6)))
    found = of_window.on_sensor(measured)
    assert found.terms[0].columns == (1, 3)
    assert of_window.effects([found]) == (measured,)
    assert stack_of(None).on_sensor(measured) == measured
