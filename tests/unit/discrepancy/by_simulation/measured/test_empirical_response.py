"""Which samples follow which is measured in frames made by plain numpy, and simulated as it is told."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from helpers.small_sensors import a_uniform_sensor
from helpers.small_sensors import simulated as simulated_frames
from pydantic import ValidationError
from scipy import stats

from pchem_pipeline.discrepancy.by_simulation.measured.response import measured_response, residual_responses
from pchem_pipeline.discrepancy.by_simulation.measured.samples import Measurement, PartSamples
from pchem_pipeline.discrepancy.observe.observe import observe
from pchem_pipeline.discrepancy.size import size_of
from pchem_pipeline.effects.framework.compose import PixelPlaces, pixel_maps, sample_law
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.effects.operators.couple import EmpiricalResponse, ResponseTerm, excess_moments

SHAPE, FRAMES, STEP, NOISE = (14, 18), 1200, 14.0, 0.25
EVERYWHERE = np.ones(SHAPE, bool)
EXPOSURE = np.exp(np.random.default_rng(20).normal(0.6, 0.25, SHAPE))
Response = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def following(place: tuple[int, int, int], part: float, above: float | None = None) -> Response:
    """Return what gives signals a part of the one at a place, or of what that has above some charge."""

    def response(v: np.ndarray, _: np.random.Generator) -> np.ndarray:
        found = v.copy()
        sizes = list(zip(place, v.shape, strict=True))
        here = tuple(slice(max(-n, 0), size - max(n, 0)) for n, size in sizes)
        there = tuple(slice(max(n, 0), size + min(n, 0)) for n, size in sizes)
        found[here] += part * (v if above is None else np.maximum(v - above, 0.0))[there]
        return found

    return response


def drooping(v: np.ndarray, _: np.random.Generator) -> np.ndarray:
    """Return signals less 10 % of the mean of their row."""
    return np.asarray(v - 0.1 * v.mean(axis=2, keepdims=True))


def settling(v: np.ndarray, _: np.random.Generator) -> np.ndarray:
    """Return signals whose first and second in a row have 10 and 5 % of the last of the row above."""
    found = v.copy()
    for column, part in enumerate((0.1, 0.05)):
        found[:, 1:, column] += part * v[:, :-1, -1]
    return found


def opposite(v: np.ndarray, _: np.random.Generator) -> np.ndarray:
    """Return signals whose right half has 5 % of its mirror image in the left one, as of two outputs."""
    found, half = v.copy(), v.shape[2] // 2
    found[..., half:] += 0.05 * v[..., half - 1 :: -1]
    return found


def drawn(response: Response, seed: int, noise: float = NOISE) -> np.ndarray:
    """Return frames whose signals follow others."""
    rng = np.random.default_rng(seed)
    signal = response(rng.poisson(EXPOSURE, (FRAMES, *SHAPE)).astype(float), rng)
    signal += noise * rng.standard_normal(signal.shape)
    return np.floor(100.0 + STEP * signal + 0.5).astype(np.uint16)


def measured(frames: np.ndarray) -> Measurement | None:
    """Return what is measured of frames beside no effect."""
    numbers = np.arange(len(frames))
    evidence = observe(frames, numbers, n_run=len(frames), block_frames=100)
    data = residual_responses(PartSamples(frames, numbers, evidence.maps, evidence, EVERYWHERE))
    return measured_response(data, None, evidence, EVERYWHERE)


@pytest.mark.parametrize(
    ("response", "source", "place", "part"),
    [
        (following((0, 0, -5), 0.02), "sample", (0, 0, -5), 0.02),
        (drooping, "row", (0, 0, 0), -0.1 / SHAPE[1]),
        (following((-1, 1, 0), 0.02), "sample", (-1, 1, 0), 0.02),
    ],
)
@pytest.mark.parametrize("noise", [0.2, 0.35])
def test_what_samples_follow_is_told_with_its_part(
    response: Response, source: str, place: tuple[int, int, int], part: float, noise: float
) -> None:
    found = measured(drawn(response, 2, noise))
    (term,) = found.effect.terms
    assert (term.of, term.place, term.columns) == (source, place, None)
    # to first order; refits make it exact
    assert found.effect.response * term.weight == pytest.approx(part, rel=0.3)


def test_what_only_large_charge_does_is_told_with_how_large() -> None:
    found = measured(drawn(following((-1, 0, 0), -0.05, above=3.0), 3))
    (term,) = found.effect.terms
    assert (term.of, term.place, term.above) == ("sample", (-1, 0, 0), 3.0)
    assert found.effect.response * term.weight == pytest.approx(-0.05, rel=0.3)
    assert "what exceeds 3 e- in the sample one frame earlier" in found.effect.describe()


def test_what_follows_its_mirror_image_is_told_in_one() -> None:
    found = measured(drawn(opposite, 4))
    (term,) = found.effect.terms
    assert (term.of, term.place, term.mirrored) == ("sample", (0, 0, 0), ("rows",))
    assert term.columns == (SHAPE[1] // 2, SHAPE[1])
    assert found.effect.response == pytest.approx(0.05, rel=0.3)
    assert "% in columns 9 to 17 of its mirror image along the rows)" in found.effect.describe()


@pytest.mark.parametrize("along", [("rows",), ("columns",), ("rows", "columns")])
def test_a_mirror_image_in_a_window_is_where_it_is_on_the_sensor(along: Any) -> None:
    charge = np.random.default_rng(5).poisson(2.0, (3, 20, 24)).astype(float)
    exposure, window = np.full((20, 24), 2.0), ((3, 15), (2, 18))
    here = EmpiricalResponse(response=0.1, terms=(ResponseTerm(place=(0, 1, -2), mirrored=along),))
    there = here.to_sensor(*window, (20, 24))
    assert there.to_window(*window, (20, 24)) == here
    box = np.s_[:, 3:15, 2:18]
    seen = here.terms[0].seen(charge[box], exposure[box[1:]])
    on_sensor = there.terms[0].seen(charge, exposure)[box]
    # beyond the window there is none
    np.testing.assert_array_equal(seen[seen != 0.0], on_sensor[seen != 0.0])
    assert np.count_nonzero(seen) > 0.5 * seen.size


@pytest.mark.parametrize("above", [0.0, 1.0, 2.5])
def test_the_excess_of_poisson_counts_has_its_moments(above: float) -> None:
    exposure = np.array([0.05, 1.3, 9.0])
    mean, variance = excess_moments(exposure, above)
    k = np.arange(80)
    for number, each in enumerate(exposure):
        excess, chance = np.maximum(k - above, 0.0), stats.poisson.pmf(k, each)
        assert mean[number] == pytest.approx(excess @ chance, rel=1e-9)
        assert variance[number] == pytest.approx(excess**2 @ chance - (excess @ chance) ** 2, rel=1e-9)


def test_what_only_some_columns_follow_is_told_with_these() -> None:
    found = measured(drawn(settling, 3))
    first, second = found.effect.terms
    last = SHAPE[1] - 1
    # at the first distance the sensor has one pair of columns only
    assert (first.place, first.columns) == ((0, -1, last), (0, 1))
    assert (second.place, second.columns) == ((0, -1, last - 1), (1, 2))
    assert second.weight == pytest.approx(0.5, rel=0.2)


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_samples_that_follow_none_need_nothing(noise: float) -> None:
    """Nor do those with noise of their row and of their frame."""

    def noisy(v: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        rows, frames = (rng.standard_normal((FRAMES, size, 1)) for size in (SHAPE[0], 1))
        return np.asarray(v + noise * (rows + 0.5 * frames))

    assert measured(drawn(noisy, 4)) is None


def test_what_a_model_makes_is_not_measured_again() -> None:
    numbers = np.arange(FRAMES)
    first, second = (drawn(following((0, 0, -5), 0.02), seed) for seed in (5, 6))
    evidence = [observe(f, numbers, n_run=FRAMES, block_frames=100) for f in (first, second)]
    data, model = (
        residual_responses(PartSamples(frames, numbers, each.maps, each, EVERYWHERE))
        for frames, each in zip((first, second), evidence, strict=True)
    )
    assert measured_response(data, None, evidence[0], EVERYWHERE) is not None
    assert measured_response(data, model, evidence[0], EVERYWHERE) is None


def simulated(*terms: ResponseTerm, response: float, region: Any = None) -> np.ndarray:
    """Return signals of a sensor of next to no read noise under the effect, e-."""
    sensor = a_uniform_sensor(SHAPE, 2.0, 1 / STEP, 100.0, 1e-6)
    effect = EmpiricalResponse(response=response, terms=terms, region=region)
    return (simulated_frames(sensor, effect, n_frames=400, seed=5)[0] - 100.0) / STEP


@pytest.mark.parametrize(
    ("term", "power"),
    [
        (ResponseTerm(place=(0, 0, -3)), 1),
        (ResponseTerm(place=(-2, 1, 0), weight=-1.0), 1),
        (ResponseTerm(place=(-1, 0, 0), above=2.0), excess_moments(np.array([2.0]), 2.0)[1].item() / 2.0),
        (ResponseTerm(of="row", number=SHAPE[1]), SHAPE[1] - 1),
        (ResponseTerm(of="column", place=(0, 0, 1), number=SHAPE[0]), SHAPE[0]),
        (ResponseTerm(of="frame", place=(-1, 0, 0), number=SHAPE[0] * SHAPE[1]), SHAPE[0] * SHAPE[1]),
    ],
)
def test_simulated_samples_follow_what_is_told(term: ResponseTerm, power: float) -> None:
    plain, found = (simulated(term, response=part) for part in (0.0, 0.02))
    change = found - plain
    charge = np.rint(plain)
    # where a frame, row and column before it exist
    inner = np.s_[2:, 1:-1, 4:-1]
    followed = term.seen(charge, np.full(charge.shape[1:], 2.0))[inner]
    np.testing.assert_allclose(change[inner], 0.02 * term.weight * followed, atol=1.01 / STEP)
    limit = 2.0 / STEP / np.sqrt(12.0) + 0.002 * np.sqrt(power)  # the former is rounding
    assert change[inner].std() == pytest.approx(0.02 * np.sqrt(2.0 * power), abs=limit)


def test_the_law_has_the_variance_of_the_pixels_that_follow() -> None:
    maps = pixel_maps(tuple(np.full(8, v) for v in (2.0, 1 / STEP, 100.0, 4.0)), np.ones(8, bool))
    places = PixelPlaces.of_block(None, (2, 4), np.arange(0))
    row = ResponseTerm(of="row", number=18)
    few, all_but_one = (ResponseTerm(place=(0, -1, 7), columns=each) for each in ((0, 1), (0, 3)))
    upper = Region(rows=((0, 1),), columns=((0, 1), (2, 4)))
    for terms, region, power in (
        ((row,), None, [18.0] * 8),
        ((few,), None, [1.0, 0.0, 0.0, 0.0] * 2),
        ((few, all_but_one), None, [2.0, 1.0, 1.0, 0.0] * 2),
        ((row, few), upper, [19.0, 0.0, 18.0, 18.0] + [0.0] * 4),
    ):
        effect = EmpiricalResponse(response=0.1, terms=terms, region=region)
        law = sample_law((effect,), maps, places=places)
        np.testing.assert_allclose(law.extra_variance_e2, 0.02 * np.array(power), rtol=1e-12)
    # of pixels that lie anywhere, none of some columns
    law = sample_law((EmpiricalResponse(response=0.1, terms=(row, few)),), maps)
    np.testing.assert_allclose(law.extra_variance_e2, 0.02 * 18.0, rtol=1e-12)


def test_its_size_is_that_of_all_the_sensor_and_in_a_place_that_of_the_place() -> None:
    maps = PixelMaps.known((np.full(SHAPE, v) for v in (2.1, 1 / STEP, 100.0, 4.0)), EVERYWHERE)
    last, one = ResponseTerm(place=(0, 0, -SHAPE[1] + 1)), ResponseTerm(place=(0, 0, -1), columns=(7, 8))
    size = size_of(EmpiricalResponse(response=0.1, terms=(last,)), maps, FRAMES)
    assert size.samples == pytest.approx(1 / SHAPE[1], rel=0.1)  # of the last column only
    assert size.electrons == pytest.approx(0.1 * 2.1**0.5, rel=0.1)
    placed = EmpiricalResponse(response=0.1, terms=(one,), region=Region(columns=((6, 8),)))
    size = size_of(placed, maps, FRAMES)
    assert size.samples == pytest.approx(0.5, abs=0.02)
    assert size.electrons == pytest.approx(0.1 * (2.1 / 2) ** 0.5, rel=0.1)


def test_it_says_what_follows() -> None:
    column = [ResponseTerm(place=(0, 0, 1), columns=each) for each in ((0, 1), (2, 5))]
    # the last sample of a row is the one read before the first of the next
    wrapped = [ResponseTerm(place=(0, -1, 63 - n), columns=(n, n + 1), weight=0.5**n) for n in range(6)]
    of_row = [ResponseTerm(place=(0, 0, -16)), ResponseTerm(of="row", weight=-0.5, number=32)]
    for response, terms, words in (
        (
            0.004,
            of_row,
            "+0.4 % of the sample 16 columns to the left, -0.2 % of each other sample of the row",
        ),
        (0.01, column, "+1 % in column 0, +1 % in columns 2 to 4 of the sample one column to the right"),
        (
            0.16,
            wrapped,
            "+16 % in column 0, +8 % in column 1, +4 % in column 2, +2 % in column 3 and 2 more of the "
            "sample one row above in column 63",
        ),
    ):
        said = EmpiricalResponse(response=response, terms=terms).describe()
        assert said == f"samples depend on the charge of other samples ({words})"


@pytest.mark.parametrize("how", [{}, {"place": (1, 0, 0)}, {"of": "row", "place": (0, 0, 2)}])
def test_a_sample_follows_neither_itself_nor_the_future(how: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match="place"):
        ResponseTerm(**how)
