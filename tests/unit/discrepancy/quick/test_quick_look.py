"""The quick look: nothing on clean stacks whatever their pixels are, and each disturbance with its size."""

import re
import zlib
from dataclasses import replace
from typing import ClassVar, Literal

import numpy as np
import pytest
from helpers.quick_stacks import EXPOSURE, GAIN, READ_NOISE, Array, added, codes_of, maps_of, stack, sums_of

from pchem_pipeline import fit_counts
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.quick import sums as module
from pchem_pipeline.discrepancy.quick.checks import KINDS, Check, QuickLook
from pchem_pipeline.discrepancy.quick.codes import code_checks
from pchem_pipeline.discrepancy.quick.frames import levels_check
from pchem_pipeline.discrepancy.quick.quick_look import quick_look
from pchem_pipeline.effects.framework.context import EffectContext
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.effects.operators.offsets import ColumnNoise, RowNoise
from pchem_pipeline.model.arithmetic.significance import SIGNIFICANCE
from pchem_pipeline.model.arithmetic.statistics import look_elsewhere
from pchem_pipeline.model.histogram.count import histogram_frames
from pchem_pipeline.model.histogram.settings import HistogramSettings
from pchem_pipeline.model.histogram.spectrum import SEEN_MIDWAY, FrameSpectrum

SHAPE = (800, 24, 24)
SIGMA = READ_NOISE / GAIN  # DN
VARIANCE = EXPOSURE / GAIN**2 + SIGMA**2 + 1 / 12


class OfAnotherPackage(Effect):
    """An effect that nobody here knows, with the signature of row noise."""

    tag: Literal["other"] = "other"
    signature: ClassVar[tuple[str, ...]] = ("space.row.readout.variance",)

    def apply(self, values: Array, context: EffectContext) -> Array:
        return values


def looked(frames: Array, model: tuple[Effect, ...] = (), limits: tuple[int, int] | None = None) -> QuickLook:
    codes = replace(codes_of(frames), limits=limits)
    return quick_look(sums_of(frames), maps_of(frames.shape[1:]), codes, model)


def without_codes(frames: Array) -> QuickLook:
    return quick_look(sums_of(frames), maps_of(frames.shape[1:]))


def by_name(look: QuickLook) -> dict[str, Check]:
    return {check.name: check for check in look.checks}


@pytest.mark.parametrize("rows", [1, 5, 32])
def test_maps_of_the_sensor_are_the_same_in_bands(monkeypatch: pytest.MonkeyPatch, rows: int) -> None:
    sums = sums_of(stack(np.random.default_rng(6), (200, 32, 24)))
    monkeypatch.setattr(module, "_AT_ONCE", rows * 24)
    cells = module.sensor_cells(sums)
    v, root = sums.variance, np.sqrt(sums.freedom_of_all)
    right = sums.next_x[:, :-1] / np.sqrt(v[:, :-1] * v[:, 1:]) * root
    down = sums.next_y[:-1] / np.sqrt(v[:-1] * v[1:]) * root
    for name, values in (("next_x", right), ("next_y", down), ("lag", sums.lag / v * root)):
        whole = np.full(v.shape, np.nan)
        whole[: values.shape[0], : values.shape[1]] = values
        expected = module.CellMap.empty(sums.shape)
        expected.add(whole)
        np.testing.assert_array_equal(cells[name].sums, expected.sums)
        np.testing.assert_array_equal(cells[name].counts, expected.counts)


def test_a_clean_stack_passes_all_checks_whose_probabilities_count_all() -> None:
    clean = looked(stack(np.random.default_rng(1), SHAPE))
    assert clean.found == ()
    assert {check.level for check in clean.checks} == {"good"}
    assert len(clean.checks) == 20
    assert clean.samples == np.prod(SHAPE)
    for check in clean.checks:
        assert check.p_global == pytest.approx(1.0 - (1.0 - check.p) ** len(clean.checks), abs=1e-9)
        assert check.found == (check.p_global < SIGNIFICANCE)


@pytest.mark.parametrize(
    ("exposure", "read_noise", "shape"),
    [(0.05, 0.15, (300, 16, 16)), (15.0, 0.8, (400, 12, 16)), (0.3, 0.5, (1200, 70, 17))],
)
def test_clean_stacks_of_other_sensors_pass(
    exposure: float, read_noise: float, shape: tuple[int, int, int]
) -> None:
    frames = stack(np.random.default_rng(0), shape, exposure=exposure, read_noise=read_noise)
    codes = codes_of(frames, exposure, read_noise)
    look = quick_look(sums_of(frames), maps_of(shape[1:], exposure, read_noise), codes)
    assert look.found == ()


def test_the_covariance_of_pairs_has_the_error_that_theory_gives_it() -> None:
    """Rows of 12 pixels of very different variance: their z are N(0, 1)."""
    rng = np.random.default_rng(4)
    exposure = np.exp(rng.normal(0.0, 1.5, (60, 12)))
    z = []
    for _ in range(8):
        value, error = sums_of(stack(rng, (300, 60, 12), exposure=exposure)).rows.covariance
        z.append(value / error)
    z_all = np.concatenate(z)
    assert abs(z_all.mean()) < 5.0 / np.sqrt(z_all.size)
    # sums of squares of some 300 degrees of freedom, a little skewed: kurtosis below 4
    assert abs(z_all.var() - 1.0) < 5.0 * np.sqrt(3.0 / z_all.size)


def test_hot_and_blinking_pixels_and_tracks_of_particles_are_no_noise_of_rows_or_frames() -> None:
    rng = np.random.default_rng(7)
    exposure = np.full(SHAPE[1:], EXPOSURE)
    exposure[rng.random(SHAPE[1:]) < 0.01] = 80.0
    frames = stack(rng, SHAPE, exposure=exposure)
    frames[300:450, 5, 7] += 40
    for _ in range(6):
        t, y, x = rng.integers(0, 800), rng.integers(0, 23), rng.integers(0, 20)
        frames[t, y, x : x + 3] += 300
    found = {check.name for check in looked(frames).found}
    assert found <= {"wandering_pixels"}


@pytest.mark.parametrize(
    ("name", "axes", "size"),
    [("row_noise", (2,), SIGMA / 5), ("column_noise", (1,), SIGMA / 4), ("frame_noise", (1, 2), SIGMA / 10)],
)
def test_what_pixels_share_is_found_alone_and_its_size_is_right(
    name: str, axes: tuple[int, ...], size: float
) -> None:
    rng, shape = np.random.default_rng(11), [1 if axis in axes else n for axis, n in enumerate(SHAPE)]
    look = looked(stack(rng, SHAPE, lambda dn: dn + size * rng.standard_normal(shape)))
    check = by_name(look)[name]
    assert [each.name for each in look.found] == [name]
    assert check.level == ("note" if size < 0.1 * SIGMA * 1.01 else "caution")
    # standard error of the variance: that by chance, and that of a noise of so many independent values
    error = (check.limit**2 / 5.4) + size**2 * np.sqrt(2.0 / np.prod(shape))
    assert abs(check.size**2 - size**2) < 5.0 * error
    assert size**2 > 5.0 * check.limit**2 / 5.4
    assert check.share == pytest.approx(check.size / np.hypot(SIGMA, 12**-0.5))
    assert check.size_e == pytest.approx(check.size * GAIN)


def test_a_single_noisy_row_is_told_and_row_noise_of_a_tap_is_found_there_with_its_size_there() -> None:
    noise = SIGMA * np.random.default_rng(4).standard_normal((*SHAPE[:2], 1))
    one = stack(np.random.default_rng(3), SHAPE, added(np.s_[:, 21], noise[:, 21]))
    check = by_name(looked(one))["row_noise"]
    assert check.found
    assert check.where == "mainly in row 21"
    tap = stack(np.random.default_rng(21), SHAPE, added(np.s_[:, :, 18:], 0.8 * noise))
    checks = by_name(looked(tap))
    check = checks["row_noise"]
    assert check.found
    assert check.region == {"columns": [[18, 24]]}
    assert checks["neighbours_x"].advice == "explained by the noise common to their line"
    assert check.where == "columns 18 to 23"
    assert check.size == pytest.approx(0.8 * SIGMA, rel=0.1)
    assert check.level == "serious"


def test_a_drift_of_all_or_of_a_corner_is_found_there_with_its_rms() -> None:
    ramp = np.linspace(-0.5, 0.5, SHAPE[0])[:, None, None]
    look = looked(stack(np.random.default_rng(5), SHAPE, lambda dn: dn + 0.6 * SIGMA * ramp))
    assert look.found[0].name == "drift"
    limit = 20 * np.sqrt(VARIANCE / np.prod(SHAPE))
    assert look.found[0].size == pytest.approx(0.6 * SIGMA / np.sqrt(12), abs=limit)
    look = looked(stack(np.random.default_rng(22), SHAPE, added(np.s_[:, :8, 12:], 3.0 * ramp)))
    check = by_name(look)["local_drift"]
    assert check.found
    true = Region(rows=((0, 8),), columns=((12, 24),))
    assert Region.model_validate(check.region).overlap(true, SHAPE[1:]) > 0.9
    # of the means over four blocks, the last one short, less the drift of all
    assert check.size == pytest.approx(3.0 / np.sqrt(12), rel=0.25)


@pytest.mark.parametrize("order", ["one after the other", "mixed"])
def test_frames_of_two_exposures_are_told_and_nothing_else(order: str) -> None:
    rng = np.random.default_rng(31)
    light = np.arange(SHAPE[0]) >= 300
    if order == "mixed":
        rng.shuffle(light)
    look = looked(stack(rng, SHAPE, exposure=np.where(light, 2.5, 0.15)[:, None, None]))
    assert [check.name for check in look.checks] == ["levels"]
    (check,) = look.found
    assert check.level == "serious"
    # means over half the frames of 576 pixels each: far below 1 % of the difference
    assert check.size == pytest.approx(2.35 / GAIN, rel=0.01)
    first = "frames 0 to 299 at 201" if order != "mixed" else "300 frames from "
    assert check.where.startswith(first)
    assert "all else" in look.missing


def test_three_exposures_are_three_levels() -> None:
    exposure = np.repeat([0.2, 0.8, 3.0], 200)[:, None, None]
    (check,) = without_codes(stack(np.random.default_rng(32), (600, 24, 24), exposure=exposure)).found
    assert check.where.count("frames ") == 3
    assert check.size == pytest.approx(2.8 / GAIN, rel=0.01)


def test_offsets_that_jump_or_alternate_and_lamps_that_drift_are_no_two_exposures() -> None:
    """The variance does not grow with an offset; a lamp leaves no gap. The gap alone would be found."""
    rng = np.random.default_rng(33)
    t = np.arange(SHAPE[0])[:, None, None]
    jumped = without_codes(stack(rng, SHAPE, lambda dn: dn + 10.0 * (t >= 300)))
    assert not by_name(jumped)["levels"].found
    assert by_name(jumped)["drift"].found
    mean, variance = (np.where(np.arange(800) < 300, *values) for values in ((200.0, 210.0), (60.0, 140.0)))
    assert levels_check(mean, variance, GAIN).p < SIGNIFICANCE
    assert levels_check(mean, np.full(800, 60.0), GAIN).p == 1.0
    # the frames of one of both levels are known to be empty
    assert levels_check(mean, variance, GAIN, np.flatnonzero(mean < mean.mean())).p == 1.0
    alternating = without_codes(stack(rng, SHAPE, lambda dn: dn + 5.0 * (-1.0) ** t))
    assert not by_name(alternating)["levels"].found
    lamp = without_codes(stack(rng, SHAPE, exposure=1.0 + t / 800.0))
    assert not by_name(lamp)["levels"].found
    for seed in range(300):  # neither noise of frames nor a flickering lamp leaves a gap
        each = np.random.default_rng(seed)
        for noise in (each.normal(200.0, 3.0, 32), each.uniform(190.0, 210.0, 32)):
            assert levels_check(noise, 8.0 * noise, GAIN).p == 1.0


def test_a_period_of_the_frames_and_even_and_odd_ones_are_told_apart() -> None:
    rng = np.random.default_rng(6)
    t = np.arange(SHAPE[0])[:, None, None]
    wave, even = (
        by_name(without_codes(stack(rng, SHAPE, lambda dn, each=each: dn + each)))["period"]  # type: ignore[misc]
        for each in (0.35 * np.sin(2 * np.pi * t / 7.3), 0.3 * (-1.0) ** t)
    )
    assert wave.found
    period = float(wave.where.split()[1])
    assert abs(1.0 / period - 1.0 / 7.3) < 1.0 / SHAPE[0]
    assert wave.size == pytest.approx(0.35 / np.sqrt(2), rel=0.2)
    assert even.where == "even and odd frames differ"
    assert even.size == pytest.approx(0.3, rel=0.2)


def test_charge_of_the_frame_before_and_of_neighbours_is_found() -> None:
    rng, expected = np.random.default_rng(8), 0.02 * EXPOSURE / GAIN**2 / VARIANCE
    (lag,) = looked(stack(rng, SHAPE, charge=lambda e: e + 0.02 * np.roll(e, 1, axis=0))).found
    assert lag.name == "lag"
    assert "gain (e⁻/DN) is too high by about this share" in lag.advice
    assert lag.size == pytest.approx(expected, abs=5 / np.sqrt(np.prod(SHAPE)))
    sides = lambda e: np.roll(e, 1, axis=2) + np.roll(e, -1, axis=2)  # noqa: E731
    (coupled,) = looked(stack(rng, SHAPE, charge=lambda e: e + 0.01 * sides(e))).found
    assert coupled.name == "neighbours_x"
    assert coupled.size == pytest.approx(expected, abs=6 / np.sqrt(np.prod(SHAPE)))


def test_the_gain_moves_as_the_advice_on_correlations_says() -> None:
    """Charge that couples to neighbours, or is carried over, makes the gain in e-/DN read high."""
    rng = np.random.default_rng(34)
    electrons = rng.poisson(EXPOSURE, (1500, 12, 12)).astype(float)
    sides = sum(np.roll(electrons, step, axis) for step in (-1, 1) for axis in (1, 2))
    for moved, axis, times in (
        (0.92 * electrons + 0.02 * sides, 2, 2.0),
        (0.95 * electrons + 0.05 * np.roll(electrons, 1, axis=0), 0, 1.0),
    ):
        dn = np.rint(200.0 + (moved + 0.25 * rng.standard_normal(moved.shape)) / GAIN).astype(np.uint16)
        rest = np.moveaxis(dn - dn.mean(axis=0), axis, 0)
        correlation = float(np.mean(rest[1:] * rest[:-1]) / np.mean(rest**2))
        counts = histogram_frames(dn)
        gain = fit_counts(counts.counts, counts.origin).conversion_gain
        high, error = np.median(gain) / GAIN - 1.0, 1.253 * gain.std() / np.sqrt(gain.size) / GAIN
        assert high > 10.0 * error
        assert high == pytest.approx(times * correlation, rel=0.25)


def test_repeated_and_single_frames_are_told_by_their_numbers() -> None:
    frames = stack(np.random.default_rng(9), SHAPE)
    frames[400] = frames[399]
    frames[77] += 3
    found = by_name(looked(frames))
    assert found["repeated_frames"].where == "frame 400"
    # the error of the mean of a frame is 0.3 DN
    assert re.fullmatch(r"frame 77 is (2|3|4)(\.\d)? DN above the others", found["odd_frames"].where)
    assert {check.name for check in found.values() if check.found} == {"repeated_frames", "odd_frames"}
    assert found["odd_frames"].level == "caution"
    frames = stack(np.random.default_rng(1), (400, 16, 24))
    frames[1::2] = frames[::2]
    (check,) = looked(frames).found
    assert (check.name, check.size) == ("repeated_frames", 0.5)


@pytest.mark.parametrize(
    ("odd", "cure"),
    [
        ([0, 1, 2], "with --frames 3: (input.frame_range)"),
        ([-2, -1], "with --frames :{} (input.frame_range)"),
        ([5, 77], "of the files"),  # no range leaves these out
    ],
)
def test_the_cure_of_odd_frames_leaves_them_out(odd: list[int], cure: str) -> None:
    frames = stack(np.random.default_rng(9), SHAPE)
    frames[odd] += 5
    found = by_name(looked(frames))["odd_frames"]
    assert found.advice.endswith(f"leave them out {cure.format(len(frames) - len(odd))}")


@pytest.mark.parametrize(("shape", "gain"), [((400, 32, 32), 0.05), ((300, 48, 70), 0.125)])
@pytest.mark.parametrize("kind", ["half lost", "half dark", "noisy", "shifted", "shifted down"])
def test_frames_that_differ_are_told_by_their_numbers_and_nothing_else(
    shape: tuple[int, int, int], gain: float, kind: str
) -> None:
    """Rows that a link has lost, samples of fourfold read noise, pixels that are one column or row away."""
    rng = np.random.default_rng(zlib.crc32(repr((kind, *shape)).encode()))
    noise = READ_NOISE * np.ones((shape[0], 1, 1))
    # four frames that are half dark may be of another exposure
    odd = np.sort(rng.choice(shape[0], 3 if kind == "half dark" else 6, replace=False))
    noise[odd] *= 4.0 if kind == "noisy" else 1.0
    bias = 200.0 + 0.6 / gain * rng.standard_normal(shape[1:])
    electrons = rng.poisson(EXPOSURE, shape) + noise * rng.standard_normal(shape)
    dark = bias + READ_NOISE / gain * rng.standard_normal(shape)
    frames = electrons / gain + bias
    lower = np.s_[odd, shape[1] // 2 :]
    if kind.startswith("half"):
        frames[lower] = 0.0 if kind == "half lost" else dark[lower]
    if kind.startswith("shifted"):
        frames[odd] = np.roll(frames[odd], 1, axis=1 if kind == "shifted down" else 2)
    (check,) = without_codes(np.rint(frames).astype(np.uint16)).found
    assert check.size == pytest.approx(odd.size / shape[0])
    says, name = {
        "half lost": ("DN below the others", "odd_frames"),
        "half dark": ("DN below the others", "odd_frames"),
        "noisy": ("DN rms more noise than the others", "odd_frames"),
        "shifted": ("look moved by one column", "moved_frames"),
        "shifted down": ("look moved by one row", "moved_frames"),
    }[kind]
    assert check.name == name
    assert says in check.where
    assert all(f" {t}" in check.where for t in odd[:2])


def test_frames_look_moved_only_where_the_pattern_tells() -> None:
    rng = np.random.default_rng(23)
    frames = rng.normal(200.0, 10.0, (300, 32, 32)) + 0.3 * rng.standard_normal((32, 32))
    frames[::40] = np.roll(frames[::40], 1, axis=1)
    assert without_codes(np.rint(frames).astype(np.uint16)).found == ()


@pytest.mark.parametrize("axis", [1, 2])
@pytest.mark.parametrize(("shape", "gain"), [((600, 32, 32), 0.125), ((400, 64, 40), 0.05)])
def test_noise_with_a_phase_of_its_own_in_each_line_is_found(
    axis: int, shape: tuple[int, int, int], gain: float
) -> None:
    """Signs + + - - along a row: no covariance of neighbours, and none of the same column of other rows."""
    rng = np.random.default_rng(19)
    phase = rng.integers(0, 4, [n if i != axis else 1 for i, n in enumerate(shape)])
    place = np.arange(shape[axis]).reshape([-1 if i == axis else 1 for i in range(3)])
    size = 0.4 * READ_NOISE / gain
    electrons = rng.poisson(EXPOSURE, shape) + READ_NOISE * rng.standard_normal(shape)
    frames = 200.0 + electrons / gain + size * np.array([1.0, 1.0, -1.0, -1.0])[(place + phase) % 4]
    (check,) = without_codes(np.rint(frames).astype(np.uint16)).found
    assert check.name == "wave"
    assert check.size == pytest.approx(size, rel=0.1)
    along, line = ("column", "row") if axis == 2 else ("row", "column")
    assert check.where == f"+0.25 cycles per {along}, new in each {line}"


def test_chance_alarms_as_often_as_stated() -> None:
    """Of 80 stacks of several sizes none has odd or moved frames, and p of noise in lines is uniform."""
    rng, p = np.random.default_rng(29), []
    shapes = [(200, 16, 24), (150, 32, 32), (120, 64, 16), (300, 17, 40)]
    for number in range(80):
        exposure, read_noise = float(np.exp(rng.uniform(-4.0, 3.0))), float(rng.uniform(0.15, 0.8))
        sums = sums_of(stack(rng, shapes[number % 4], exposure=exposure, read_noise=read_noise))
        assert not any(frames.size for frames in sums.odd.values()), number
        p.append(look_elsewhere(sums.spectrum["line_p"], sums.spectrum["line_looks"]))
    for level in (0.05, 0.3):
        assert np.mean(np.array(p) < level) < level + 4.0 * np.sqrt(level * (1.0 - level) / len(p))


@pytest.mark.parametrize("size", [0.05, 0.15])
def test_widths_of_codes_are_found_with_their_size(size: float) -> None:
    rng = np.random.default_rng(10)
    # differences of edges have the rms ``size``
    edges = np.arange(400) - 0.5 + size / np.sqrt(2.0) * rng.standard_normal(400)
    look = looked(stack(rng, SHAPE, lambda dn: np.searchsorted(edges, dn) - 1.0))
    assert [check.name for check in look.found] == ["codes"]
    # some 60 codes are occupied; widths that share an edge are anticorrelated, which the estimate
    # (against the mean of both neighbours) takes for (1 + 2/3) of the variance
    assert look.found[0].size == pytest.approx(size * np.sqrt(5 / 3), rel=0.4)


def test_clipping_is_found() -> None:
    rng = np.random.default_rng(12)
    frames = stack(rng, (800, 8, 12), lambda dn: np.minimum(dn, 222.0))
    unknown, known = (by_name(looked(frames, limits=limits)) for limits in (None, (0, 222)))
    assert (unknown["top_code"].level, known["top_limit"].level) == ("serious", "caution")


def test_samples_cut_off_at_0_are_the_black_level_and_no_widths() -> None:
    shape = (800, 8, 12)
    frames = stack(np.random.default_rng(12), shape, lambda dn: dn - dn.mean(axis=(0, 1, 2)) + 11.0)
    found = by_name(looked(frames, limits=(0, 65535)))
    assert found["bottom_limit"].found
    assert found["bottom_limit"].size == pytest.approx(np.mean(frames == 0), rel=0.02)
    assert found["bottom_limit"].where == "0 DN"
    assert "black level is too low" in found["bottom_limit"].advice
    assert "codes" not in found
    assert not found["top_code"].found


def test_frames_below_the_others_do_not_cut_samples_off() -> None:
    """Pixels in which they lie lowest fit badly; where the codes of the rest end is no limit."""
    frames = stack(np.random.default_rng(13), SHAPE, lambda dn: dn - dn.mean(axis=0) + 210.0, read_noise=0.22)
    frames[:8] -= 18
    found = by_name(looked(frames))
    assert found["odd_frames"].found
    assert not found["bottom_code"].found
    assert found["bottom_code"].where == f"{frames.min()} DN"


@pytest.mark.parametrize("n", [700, 1000, 1500])
def test_a_region_that_is_moved_in_the_middle_of_the_run_is_found(n: int) -> None:
    frames = stack(np.random.default_rng(17), (n, 16, 16))
    frames[n // 2 :] = np.roll(frames[n // 2 :], 1, axis=2)
    block = HistogramSettings().block_length(n)
    look = quick_look(sums_of(frames, block), maps_of((16, 16)))
    check = by_name(look)["wandering_pixels"]
    assert check.found
    assert re.fullmatch(r"y, x = \d+, \d+; \d+, \d+; \d+, \d+ and \d+ more", check.where)
    assert "pixels along the run" not in look.missing
    short = quick_look(sums_of(frames[:90], HistogramSettings().block_length(90)), maps_of((16, 16)))
    assert "pixels along the run" in short.missing


@pytest.mark.parametrize("exposure", [0.01, 0.05, 30.0])
def test_pixels_with_few_electrons_in_a_block_do_not_wander(exposure: float) -> None:
    """The means of blocks are as skewed as Poisson counts of a few; 10,000 pixels, a look at each."""
    for seed in range(2):
        frames = stack(np.random.default_rng(seed), (600, 70, 71), exposure=exposure)
        look = quick_look(sums_of(frames, 37), maps_of((70, 71), exposure))
        assert not by_name(look)["wandering_pixels"].found


def test_a_pickup_along_the_reading_order_is_found_with_its_size() -> None:
    """A wave of 19 % of the read noise, whose phase runs on from row to row and is new in every frame."""
    rng = np.random.default_rng(18)
    n, ny, nx = 1500, 24, 24
    t = np.arange(ny)[:, None] * (nx + 5) + np.arange(nx)
    phase = rng.uniform(0.0, 2.0 * np.pi, (n, 1, 1))
    size = 0.19 * SIGMA
    look = looked(stack(rng, (n, ny, nx), lambda dn: dn + size * 2.0**0.5 * np.sin(0.613 * t + phase)))
    assert look.found[0].name == "wave"
    # a frequency between those of the spectrum is spread over more than are summed
    assert 0.7 * size < look.found[0].size < 1.2 * size


def test_what_the_model_has_is_a_remark() -> None:
    rng = np.random.default_rng(13)
    frames = stack(rng, SHAPE, lambda dn: dn + SIGMA * rng.standard_normal((*SHAPE[:2], 1)))
    for effect in (RowNoise(row_noise_dn=SIGMA), OfAnotherPackage()):
        found = looked(frames, (effect,)).found[0]
        assert (found.name, found.level, found.in_model) == ("row_noise", "note", True)
    assert not looked(frames, (ColumnNoise(column_noise_dn=SIGMA),)).found[0].in_model


def test_signs_are_statistics_of_the_catalogue() -> None:
    signs = {kind.signs for kind in KINDS.values()} - {""}
    assert all(any(re.fullmatch(sign, name) for name in STATISTICS) for sign in signs)


def test_without_summaries_only_codes_are_looked_at() -> None:
    frames = stack(np.random.default_rng(15), (400, 8, 8))
    look = quick_look(None, maps_of((8, 8)), codes_of(frames), missing={"rows": "no order in time"})
    assert [check.name for check in look.checks] == ["codes", "top_code", "bottom_code"]
    assert look.to_dict()["missing"] == {"rows": "no order in time"}


def test_the_codes_of_a_joint_fit_are_judged_by_its_parameters() -> None:
    """At 8 e- and 0.7 e- one exposure alone does not tell the gain; others did, with errors of their own."""
    frames = stack(np.random.default_rng(3), (800, 16, 16), exposure=8.0, read_noise=0.7)
    codes = codes_of(frames, 8.0, 0.7)
    given = codes.parameters
    odd = (frames & 1) * (np.random.default_rng(4).random(frames.shape) < 0.1).astype(frames.dtype)
    uneven = replace(codes_of(frames - odd, 8.0, 0.7), parameters=given)
    right, wrong = (
        next(check.p for check in code_checks(replace(each, joint=True)) if check.name == "codes")
        for each in (codes, uneven)
    )
    assert right > 1e-3
    assert wrong < 1e-6
    assert code_checks(replace(codes, counts=np.zeros_like(codes.counts))) == []
    assert code_checks(replace(codes, parameters=given * (1e5, 1.0, 1.0, 1.0))) == []


def test_a_pixel_of_wild_noise_makes_no_wave() -> None:
    """Its samples moved the mean of the frame, and with it all the others."""
    frames = stack(np.random.default_rng(6), (300, 16, 20))
    frames[:, 5, 5] = np.random.default_rng(7).integers(5000, 12000, 300)
    assert not by_name(without_codes(frames))["wave"].found


def test_a_wave_midway_between_two_frequencies_is_seen_as_stated() -> None:
    """Frames of 16 x 16, padded to 32 x 32: a wave of 12.5 cycles in 32 rows and columns is the farthest."""
    rng, side, n = np.random.default_rng(11), 16, 400
    y, x = np.indices((side, side))
    phase = rng.uniform(0.0, 2.0 * np.pi, (n, 1, 1))
    cycles = (6 + 0.25) / side  # a quarter from a frequency of the frame, half of one of the padded frame
    wave = 3.0 * np.sin(2.0 * np.pi * cycles * (y + x) + phase)
    frames = np.rint(300.0 + wave + 12.0 * rng.standard_normal((n, side, side))).astype(np.uint16)
    spectrum = FrameSpectrum((side, side))
    spectrum.add(frames)
    line = spectrum.line()
    power = side**2 / 2.0 * 4.5 / (12.0**2 + 1.0 / 12.0 + 4.5)
    # the noise is the median of those around, which the wave is in, too; a power scatters by itself
    error = (1.0 + SEEN_MIDWAY * power) / np.sqrt(n)
    assert abs(line["ratio"] - 1.0 - SEEN_MIDWAY * power) < 4.0 * error + 0.05 * power
    assert line["ratio"] > 1.0 + 0.3 * power  # without padding 0.16 of the power would be seen
