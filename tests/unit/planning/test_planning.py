"""Plans from the bound: against the paper's own numbers, brute force, and what cannot be reached."""

import itertools
import json

import numpy as np
import pytest

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.commands.plan import make_plan
from pchem_pipeline.model.errors.expected_information import inverse_information, shared_information
from pchem_pipeline.planning.plan import plan_one_sample, plan_samples
from pchem_pipeline.planning.split import best_samples, best_split, split_frames
from pchem_pipeline.planning.targets import (
    TARGET_NAMES,
    Point,
    best_exposure,
    frames_needed,
    parse_target,
    precision,
)
from pchem_pipeline.planning.verify import frames_simulated, verify
from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.pages.tables import result_tables
from pchem_pipeline.stages.report.stored import plan_section

GAIN = 1 / 11
ONE_PERCENT = parse_target("conversion_gain=1%")


def point(exposure=2.0, noise=0.305, gain=GAIN):
    return Point(exposure, noise, gain)


@pytest.mark.parametrize(
    ("noise", "exposure", "percent"),
    [(0.2, 2, 0.12), (0.305, 0.1, 1.19), (0.305, 10, 0.16), (0.45, 2, 0.92), (0.5, 10, 0.74), (0.6, 2, 4.22)],
)
def test_known_bounds_of_17750_frames(noise, exposure, percent):
    there = point(exposure, noise)
    assert 100 * precision(there, 17_750)["conversion_gain"] == pytest.approx(percent, abs=0.006)
    asked = parse_target(f"conversion_gain={100 * precision(there, 17_750)['conversion_gain']}%")
    assert frames_needed(asked, there) == pytest.approx(17_750, abs=1.5)


def test_units_of_a_target_are_the_same_wish_and_every_parameter_can_be_planned_for():
    there = point()
    for texts in (
        ("conversion_gain=1%", f"conversion_gain={0.01 * GAIN}e-/DN"),
        ("bias=0.02e-", "bias=0.22DN"),
        ("read_noise_e=2%", "read_noise_e=0.0061e-"),
        ("read_noise_dn=2%", f"read_noise_dn={0.02 * 0.305 * 11}DN"),
        ("quanta_exposure=5%", "quanta_exposure=0.1e-", "dark_current=5%"),
    ):
        frames = {frames_needed(parse_target(text), there) for text in texts}
        assert max(frames) - min(frames) <= 1
    for name, units in TARGET_NAMES.items():
        for unit in units:
            assert 1 < frames_needed(parse_target(f"{name}=0.001{unit}"), point()) < 1e12


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("gain=1%", "gain is not a parameter"),
        ("conversion_gian=1%", "did you mean conversion_gain"),
        ("conversion_gain", "give a number"),
        ("conversion_gain=1", "give a number in % or e-/DN, such as conversion_gain=1%"),
        ("bias=1%", "in e- or DN"),
        ("bias=1.2.3e-", "give a number"),
        ("bias=0e-", "give a number above 0"),
        ("read_noise_e=-1%", "give a number above 0"),
    ],
)
def test_a_wrong_target_gets_its_line(text, words):
    with pytest.raises(ConfigError, match=words):
        parse_target(text)


@pytest.mark.parametrize(("text", "noise"), [("conversion_gain=1%", 0.8), ("read_noise_e=1%", 0.3)])
def test_best_exposure_is_that_of_a_fine_grid(text, noise):
    target = parse_target(text)
    best, frames = best_exposure([target], point(noise=noise), 0.05, 10.0)
    grid = np.geomspace(0.05, 10, 400)
    needed = np.array([frames_needed(target, Point(h, noise, GAIN)) for h in grid])
    assert best == pytest.approx(grid[np.argmin(needed)], rel=0.1)  # the minimum is flat
    assert frames <= needed.min() * 1.0001
    assert 0.05 < best < 10


@pytest.mark.parametrize(("noise", "gain"), [(0.305, 0.7), (0.2, 0.4)])
def test_the_bound_of_coarse_codes_is_what_fits_reach(noise, gain):
    """The bound of the density is beaten or far off there; fits take the cells."""
    targets = [parse_target(t) for t in ("conversion_gain=1%", "read_noise_e=1%", "bias=0.01e-")]
    there = point(2.0, noise, gain)
    bound = precision(there, 2000)
    for check in verify(targets, there, [2.0], [2000], 300, 1).checks:
        # pixels whose bias lies badly are above the spread of most, below the mean
        assert 0.6 < check.robust_sd / bound[check.target.name] < 1.15


def brute_force(informations, gradient, steps=60):
    best = np.inf
    for shares in itertools.product(range(steps + 1), repeat=len(informations) - 1):
        if sum(shares) <= steps:
            p = np.array([*shares, steps - sum(shares)]) / steps
            covariance = inverse_information(np.einsum("j,jab->ab", p, informations))
            value = gradient @ covariance @ gradient
            best = min(best, value) if np.isfinite(value) else best
    return best


def test_the_best_split_is_that_of_brute_force_and_chosen_exposures_are_no_worse():
    there = point(noise=0.6)
    lights = [0.0, 2.0, 8.0]
    informations = np.stack([shared_information(h, 0.6) for h in lights])
    gradients = {"conversion_gain=1%": [1, 0, 0], "bias=0.01e-": [0, 1, 0], "read_noise_e=1%": [1, 0, 1]}
    for text, gradient in gradients.items():
        target = parse_target(text)
        split = best_split([target], lights, there)
        assert sum(split.shares) == pytest.approx(1)
        # the shares of brute force are whole sixtieths
        assert 0.98 < split.frames / (1e4 * brute_force(informations, np.array(gradient))) < 1.002
        assert split.frames <= split_frames([target], lights, [1 / 3] * 3, there)
    targets = [ONE_PERCENT, parse_target("read_noise_e=1%")]
    alone = [best_split([target], lights, there).frames for target in targets]
    assert max(alone) <= best_split(targets, lights, there).frames <= sum(alone)
    free = best_samples([ONE_PERCENT], there, 8.0)
    assert free.frames <= best_split([ONE_PERCENT], lights, there).frames * 1.001
    assert free.exposures[0] == 0
    assert len(free.exposures) <= 4
    assert max(free.exposures) <= 8.0001


def one(targets, there, *, given=True, budget=None, max_frames=1e7):
    limits = {"budget": budget, "max_exposure": 10.0, "max_frames": max_frames}
    return plan_one_sample([parse_target(t) for t in targets], there, exposure_given=given, **limits)


def test_out_of_reach_says_why_and_what_would_help():
    with pytest.raises(ConfigError, match=r"several samples \(--samples best\) need"):
        one(["conversion_gain=1%"], point(2.0, 1.5))
    with pytest.raises(ConfigError, match=r"an exposure of .* e- needs"):
        one(["conversion_gain=1%"], point(0.001, 0.3), max_frames=1e5)
    with pytest.raises(ConfigError, match="5 % of simulated pixels stay flagged"):
        one(["quanta_exposure=5%"], point(12.0, 0.305), max_frames=1000)
    # without a target the precision of the frames that there are
    assert one([], point(noise=0.8), given=False, budget=2000).frames == 2000
    limits = {"budget": None, "max_exposure": 1, "max_frames": 1e7}
    for target, lights, words in (
        ("conversion_gain=1%", [0.0, 1e-4], "not reached within --max-frames"),
        ("quanta_exposure=1%", [0.0, 1.0], "choose from the shared parameters"),
    ):
        with pytest.raises(ConfigError, match=words):
            plan_samples([parse_target(target)], lights, point(), **limits)


def simulated(targets, there, frames, n_pixels=150, **options):
    asked = [parse_target(t) for t in targets]
    return verify(asked, there, [there.quanta_exposure], [int(frames)], n_pixels, 1, **options)


def test_electron_numbers_must_be_certain_for_bias_and_exposure_only():
    there = point(12.0, 0.2)
    plan = one(["conversion_gain=1%"], there)
    assert plan.needed < 5 * plan.bounds[0]
    both = one(["conversion_gain=1%", "quanta_exposure=5%"], there)
    assert both.needed > 10 * both.bounds[1]
    # of other pixels about one in twenty is flagged
    assert 0 < simulated(["quanta_exposure=5%"], there, both.needed, 600).n_flagged < 60


def test_the_best_exposure_ends_without_flags():
    plan = one(["conversion_gain=0.5%"], point(noise=0.15), given=False)
    assert plan.frames == plan.best_frames
    assert simulated(["conversion_gain=0.5%"], plan.point, plan.frames, every_flag=True).n_flagged <= 15
    # with more light the gain takes fewer frames, and leaves exposure and bias open
    bright = one(["conversion_gain=0.5%"], point(8.0, 0.15))
    assert bright.frames < 0.5 * plan.frames
    for target, low, high in (("conversion_gain=1%", 0, 3), ("bias=1e-", 100, 150)):
        assert low <= simulated([target], bright.point, bright.frames).n_flagged <= high


def test_few_frames_must_show_electrons_at_all_and_those_of_no_use_are_not_simulated():
    plan = one(["bias=0.09e-"], point(0.05, 0.3))
    assert plan.frames == plan.needed > 2 * plan.bounds[0]
    given = ([ONE_PERCENT], point(), [2.0], [1.0])
    assert frames_simulated(*given, 2000, 1999) == np.inf
    assert frames_simulated(*given, 100, 200) == np.inf
    enough = frames_simulated(*given, 100, 1e5)
    assert enough == pytest.approx(frames_needed(ONE_PERCENT, point()), rel=0.25)


def test_impossible_pixels_and_samples_get_their_line():
    for pixel in ((0.0, 0.3, 0.1), (1.0, 0.0, 0.1), (1.0, np.nan, 0.1), (1, 0.2, 1.0)):
        with pytest.raises(ConfigError, match="--"):
            Point(*pixel)
    for lights in ([0.0, 0.0], [0.0, -1.0]):
        with pytest.raises(ConfigError, match="--samples"):
            best_split([ONE_PERCENT], lights, point())


def test_the_real_fit_confirms_a_plan():
    there, n = point(), int(frames_needed(parse_target("conversion_gain=0.5%"), point()))
    found = simulated(["conversion_gain=0.5%"], there, n, 600)
    check = found.checks[0]
    assert found.n_failed == 0
    assert abs(check.rmse / 0.005 - 1) < 5 / np.sqrt(2 * 600)
    assert check.rmse_stderr == pytest.approx(0.005 / np.sqrt(1200), rel=0.2)
    assert check.reached
    # a tenth of the frames do not do, and it is seen
    assert not simulated(["conversion_gain=0.5%"], there, n // 10, 600).checks[0].reached


def test_the_joint_fit_confirms_a_split():
    there = point(noise=0.6)
    plan = plan_samples([ONE_PERCENT], [0.0, 8.0], there, budget=None, max_exposure=8, max_frames=1e7)
    found = verify([ONE_PERCENT], there, plan.split.exposures, plan.per_sample, 300, 1)
    assert abs(found.checks[0].rmse / 0.01 - 1) < 5 / np.sqrt(2 * 300)
    quarter = [n // 4 for n in plan.per_sample]
    assert not verify([ONE_PERCENT], there, plan.split.exposures, quarter, 300, 1).checks[0].reached


def test_the_command_in_words_and_files(tmp_path):
    path, gain = tmp_path / "plan.json", ("conversion_gain=1%",)
    frames = frames_needed(ONE_PERCENT, Point(2.0, 0.3, 0.09))
    for given, words in (
        ({"exposure": 2.0, "target": gain, "json": path}, (f"{frames:,.0f} frames", "best exposure")),
        ({"samples": "0,2,8", "target": gain, "frames": 5000}, ("3 samples", "evenly divided")),
        ({"frames": 2000, "target": ("bias=0.02e-",)}, ("(the best)", "2,000 frames are enough")),
    ):
        text = make_plan(read_noise=0.6 if "samples" in given else 0.3, **given)
        assert all(each in text for each in words)
    assert json.loads(path.read_text())["frames"] == frames


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, "--read-noise is missing"),
        ({"read_noise": 0.3}, "--target is missing"),
        ({"read_noise": 0.3, "samples": "2", "target": ("bias=1DN",)}, "two or more exposures"),
        ({"read_noise": 0.3, "samples": "a,b", "target": ("bias=1DN",)}, "two or more exposures"),
        ({"read_noise": 0.3, "samples": "0,2"}, "--target is missing"),
        ({"read_noise": 0.3, "exposure": 0.0, "frames": 9}, "--exposure 0"),
    ],
)
def test_what_is_missing_gets_its_line(given, words):
    with pytest.raises(ConfigError, match=words):
        make_plan(**given)


@pytest.mark.parametrize(("exposure", "noise", "gain"), [(8.0, 0.4, GAIN), (1.0, 0.2, 0.47)])
def test_rivals_need_more_frames_than_the_bound_asks_for(exposure, noise, gain):
    """Weak peaks leave other gains as likely; at 0.47 e-/DN whole DN show a comb of 0.53 e-/DN as well."""
    there = point(exposure, noise, gain)
    plan = one(["conversion_gain=1%"], there)
    assert plan.needed > 2 * plan.bounds[0]
    n, few = 200, (0.05 + 5 * np.sqrt(0.05 * 0.95 * (1 / 200 + 1 / 200))) * 200
    spoilt, good = (simulated(["conversion_gain=1%"], there, k, n) for k in (*plan.bounds, plan.needed))
    assert spoilt.n_flagged > 0.2 * n
    assert good.n_flagged < few
    assert good.checks[0].rmse < 0.01
    if gain > 0.4:  # the best exposure leaves few pixels flagged in anything
        best = point(plan.best_exposure, noise, gain)
        found = simulated(["conversion_gain=1%"], best, plan.best_frames, n, every_flag=True)
        assert found.n_flagged < few
        assert found.checks[0].reached


def test_the_section_of_the_report_is_of_the_median_pixel():
    maps = {
        "quanta_exposure": np.array([[2.0, 2.0], [2.0, np.nan]]),
        "read_noise_e": np.array([[0.305, 0.305], [0.305, np.nan]]),
        "conversion_gain": np.full((2, 2), GAIN),
    }
    section = plan_section(maps, 17_750)
    assert section["rows"][0]["frames"] == frames_needed(ONE_PERCENT, point())
    assert section["reached"]["conversion_gain"] == pytest.approx(0.0028, abs=5e-5)
    data = ReportData(title="a run", shape=(2, 2), plan=section)
    [table] = [table for table in result_tables(data) if table.section == "plan"]
    assert table.rows[0]["this run's"] == "0.28 %"
    assert {tuple(row) for row in table.rows} == {table.head}
    assert plan_section({name: np.full((2, 2), np.nan) for name in maps}, 10) is None
