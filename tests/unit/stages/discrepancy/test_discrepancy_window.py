"""Which part of a stack is looked at, the limits it starts from, and what ends the stage."""

import contextlib
import json
import signal
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from helpers.discrepancy_material import verdict_of
from helpers.drawn_pixels import codes
from helpers.small_stacks import Stack

from pchem_pipeline.base.errors import ConfigError, StoreError
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.discrepancy.splits import split_frames
from pchem_pipeline.discrepancy.verdict import Elsewhere, Verdict
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.effects.operators.curve import Clipping
from pchem_pipeline.run.progress import Reporter
from pchem_pipeline.run.signals import InterruptedRunError
from pchem_pipeline.stages.discrepancy import discrepancy
from pchem_pipeline.stages.discrepancy.window import (
    SURVEY,
    Spot,
    Survey,
    Window,
    choose_window,
    fewer_samples,
    is_clear,
    other_window,
    read_window,
    search_bytes,
    within_memory,
)

WHOLE = DiscrepancySettings(max_pixels=1 << 25)


def test_a_small_stack_or_the_region_asked_for_is_looked_at_whole():
    window = choose_window((4000, 64, 64), WHOLE)
    assert (window.numbers.size, window.rows, window.columns) == (4000, (0, 64), (0, 64))
    window = choose_window((1000, 64, 64), WHOLE, (8, 24, 16, 48))
    assert (window.rows, window.columns) == ((8, 24), (16, 48))


def stored(survey):
    return SURVEY.validate_python(json.loads(json.dumps(SURVEY.dump_python(survey, mode="json"))))


def test_odd_frames_are_not_looked_at_and_those_delivered_twice_once():
    seen = stored(Survey(left_out=(0, 700)))
    for shape in ((900, 16, 16), (17750, 512, 512)):
        numbers = choose_window(shape, WHOLE, None, seen).numbers
        assert not np.isin(numbers, (0, 700)).any()
        assert np.all(np.diff(numbers) > 0)
    assert seen.told(verdict_of("named"), 1.0).examined.left_out == (0, 700)
    copied = tuple(range(1, 1800, 2))
    seen = stored(Survey(left_out=(6, *copied), copied=copied))
    window = choose_window((1800, 16, 16), WHOLE, None, seen)
    np.testing.assert_array_equal(window.numbers, np.delete(np.arange(0, 1800, 2), 3))
    np.testing.assert_array_equal(window.times, np.delete(np.arange(900), 3))
    assert split_frames(window.times, 20).train.size == 280


def n_pixels(window):
    return np.ptp(window.rows) * np.ptp(window.columns)


@pytest.mark.parametrize("shape", [(17750, 512, 512), (1000, 2048, 2048), (100_000, 8, 8), (7000, 3, 4000)])
def test_of_a_large_stack_no_more_than_allowed(shape):
    window = choose_window(shape, WHOLE)
    most = min(1 << 25, np.prod(shape))
    assert 0.8 * most < window.numbers.size * n_pixels(window) <= most
    # slow effects must show: the frames span the run
    assert window.numbers[0] < 0.02 * shape[0]
    assert window.numbers[-1] > 0.98 * shape[0] - 1
    assert np.all(np.diff(window.numbers) > 0)


def test_of_a_large_sensor_no_more_pixels_than_allowed():
    window = choose_window((1000, 512, 512), DiscrepancySettings())
    assert 0.95 * 8192 < n_pixels(window) <= 8192
    assert window.numbers.size == 1000
    assert n_pixels(choose_window((1000, 512, 512), DiscrepancySettings(max_pixels=400))) <= 400


@pytest.mark.parametrize("shape", [(1000, 512, 512), (6000, 64, 64), (17750, 512, 512), (400, 60, 80)])
def test_the_window_becomes_smaller_with_the_memory(shape):
    settings, sizes = DiscrepancySettings(), []
    full = choose_window(shape, settings)
    assert within_memory(settings, shape, None, 100.0, search_bytes(full, 100.0)) == settings
    for limit in (320, 360, 400):
        window = choose_window(shape, within_memory(settings, shape, None, 100.0, limit << 20))
        assert search_bytes(window, 100.0) <= limit << 20
        # frames stay: slow effects need the whole run, and pixels resemble each other
        assert window.numbers.size == full.numbers.size
        sizes.append(n_pixels(window))
    assert sizes[0] < sizes[1] < sizes[2] or shape == (400, 60, 80)
    with pytest.raises(ConfigError, match=r"needs at least \d+ MiB.*--max-memory.* allows 290; raise it"):
        within_memory(settings, shape, None, 100.0, 290 << 20)


def test_frames_of_the_window_are_those_of_the_stack():
    t, y, x = np.ogrid[:300, :9, :11]
    source = Stack((t * 10_000 + y * 100 + x).astype(np.uint32))  # a value tells where it comes from
    window = Window(np.r_[0:40, 100:160], (2, 6), (3, 8))
    np.testing.assert_array_equal(read_window(source, window), source.values[window.numbers][:, 2:6, 3:8])


def place(p=1e-9, **region):
    return Spot(Region.model_validate(region), p)


def test_the_window_lies_where_the_sensor_disagrees_half_of_it_outside():
    tap = {"next_x": place(columns=[448, 512])}
    window = choose_window((17750, 512, 512), WHOLE, None, Survey(tap))
    x0, x1 = window.columns
    assert 0.4 < (x1 - 448) / (x1 - x0) < 0.6
    blob = {"lag": place(1e-5, columns=[0, 9]), "spread": place(1e-20, rows=[20, 40], columns=[30, 50])}
    window = choose_window((17750, 512, 512), WHOLE, None, Survey(blob))
    (y0, y1), (x0, x1) = window.rows, window.columns
    assert y0 <= 20 < 40 <= y1
    assert x0 <= 30 < 50 <= x1
    # without a place, or with one outside of the region asked for, the middle is looked at
    middle = choose_window((17750, 512, 512), WHOLE)
    assert choose_window((17750, 512, 512), WHOLE, None, Survey({})).rows == middle.rows
    elsewhere = {"lag": place(rows=[500, 512])}
    asked = choose_window((17750, 512, 512), WHOLE, (0, 256, 0, 256), Survey(elsewhere))
    assert asked.rows == choose_window((17750, 512, 512), WHOLE, (0, 256, 0, 256)).rows


ALL = DiscrepancySettings().max_samples


@pytest.mark.parametrize(
    ("row_noise", "fewest", "compared"),
    # as many as show it: the fewest, or twice or four times as many
    [
        (0.0, 1 << 17, ALL), (0.25, 1 << 17, ALL), (3.0, 1 << 17, 1 << 17), (3.0, 1 << 25, ALL),
        (3.0, 1 << 16, 1 << 16), (1.0, 1 << 16, 1 << 17), (0.8, 1 << 16, 1 << 18),
    ],
)  # fmt: skip
def test_few_samples_are_compared_where_they_disagree_clearly(row_noise, fewest, compared):
    rng = np.random.default_rng(5)
    light = 11.0 * (rng.poisson(2.0, (900, 16, 24)) + 0.3 * rng.standard_normal((900, 16, 24)))
    stack = np.rint(100.0 + light + row_noise * rng.standard_normal((900, 16, 1))).astype(np.uint16)
    settings = DiscrepancySettings(clear_samples=fewest)
    found = fewer_samples(Stack(stack), settings, None, Survey(), ())
    assert found.max_samples == compared
    if compared == ALL:
        assert found == settings
    else:
        assert (found.replicates, found.extended_replicates) == (24, 12)
    # with effects in the model the plain one disagrees for a reason that is known
    assert fewer_samples(Stack(stack), settings, None, Survey(), (Clipping(low=0),)) == settings
    own = settings.model_copy(update={"replicates": 20})
    assert fewer_samples(Stack(stack), own, None, Survey(), ()).replicates == 20
    # what is wrong with frames is no clear disagreement
    assert not is_clear(np.full_like(stack, 7), np.arange(900), n_run=900, block_frames=20)


@pytest.mark.parametrize(
    ("rows", "columns", "roi", "other"),
    [
        ((16, 48), (16, 48), None, ((0, 32), (0, 32))),
        ((0, 32), (40, 64), None, ((32, 64), (0, 24))),
        ((16, 48), (23, 55), None, ((0, 32), (0, 32))),
        ((0, 64), (0, 64), None, None),
        ((0, 64), (0, 50), None, None),
        ((8, 24), (8, 24), (0, 24, 8, 40), ((0, 16), (24, 40))),
    ],
)
def test_another_window_of_the_same_size_lies_as_far_away_as_there_is_room(rows, columns, roi, other):
    window = Window(np.arange(100), rows, columns)
    found = other_window(window, (100, 64, 64), roi)
    assert (None if found is None else (found.rows, found.columns)) == other


def test_the_work_is_that_of_all_searches_and_looks(monkeypatch):
    values = codes(np.random.default_rng(2), (400, 32, 32), 2.0, 11.0, 0.3, 100.0).astype(np.uint16)
    sensor = SimpleNamespace(bit_depth=12, integration_time=1.0, seen_limits=(None, None), adc_limits=None)
    context = SimpleNamespace(sensor=sensor, store=None)
    search = discrepancy._Search(context, Stack(values), (), None, Survey({}, {}), lambda _: None)
    named = SimpleNamespace(verdict=verdict_of("named").costing(30.04), model=())
    monkeypatch.setattr(discrepancy, "find_discrepancies", lambda *_, **__: named)

    def deviation(by, model):
        by.effort.spent += 5.0
        return ""

    monkeypatch.setattr(discrepancy, "deviation", deviation)
    settings = DiscrepancySettings(max_samples=1 << 16, max_pixels=256)
    window, found = search.found(settings, "")
    assert search.work == 30.0
    there = search.elsewhere(settings, "elsewhere-", window, found)
    assert there.rows != (0, 32)
    search.found(settings, "whole-")
    assert search.work == pytest.approx(65.0)
    # a weak effect beside a strong one shows in more samples
    there = search.elsewhere(settings, "elsewhere-", window, found, DiscrepancySettings())
    assert there.rows == there.columns == (0, 32)


def test_a_verdict_is_not_lost_where_no_pixel_of_the_other_window_can_be_used():
    """Reference columns, say."""
    notes: list[str] = []
    values = np.full((400, 24, 24), 7, np.uint16)
    values[:, 12:, 12:] += np.arange(400, dtype=np.uint16)[:, None, None] % 5
    context = SimpleNamespace(sensor=SimpleNamespace(bit_depth=12, integration_time=1.0), note=notes.append)
    search = discrepancy._Search(context, Stack(values), (), None, Survey({}, {}), lambda _: None)
    window = Window(np.arange(400), (12, 24), (12, 24))
    for verdict in ("named", "named_in_part"):  # which is not checked elsewhere
        found = SimpleNamespace(verdict=verdict_of(verdict), model=())
        assert search.elsewhere(DiscrepancySettings(), "x-", window, found) is None
        [note] = notes
    assert note.startswith("not checked in rows 0 to 11, columns 0 to 11: ")


def test_a_name_that_does_not_hold_elsewhere_is_in_part():
    verdict = verdict_of("named")
    there = Elsewhere(rows=(0, 32), columns=(8, 40))
    assert verdict.checked(there).model_copy(update={"examined": verdict.examined}) == verdict
    found = verdict.checked(there.model_copy(update={"deviates": "row means scatter"}))
    assert found.verdict == "named_in_part"
    assert found.sentence.endswith(
        "; it does not hold in rows 0 to 31, columns 8 to 39, where row means scatter."
    )
    assert Verdict.from_json(found.to_json()) == found


def context(low, high, **ends):
    store = SimpleNamespace(has=lambda _: bool(ends), read=lambda name: ends[name.partition("/")[2]])
    sensor = SimpleNamespace(seen_limits=(low, high), adc_limits=(0, 4095))
    return SimpleNamespace(sensor=sensor, store=store)


def test_the_limits_of_the_run_are_in_the_model_of_the_search_once():
    assert discrepancy._limits(context(None, None), ()) == ()
    assert discrepancy._limits(context(None, 135), ()) == (Clipping(high=135),)
    assert discrepancy._limits(context(40, 135), ()) == (Clipping(low=40, high=135),)
    assert discrepancy._limits(context(None, 135), (Clipping(high=130),)) == ()
    # the end of the ADC is no code that is seen to be a limit, but samples lie there
    cut = {"minimum": np.array([[0, 0, 3]]), "maximum": np.array([[90, 80, 95]])}
    assert discrepancy._limits(context(None, None, **cut), ()) == (Clipping(low=0),)
    few = {"minimum": np.r_[0, np.full(200, 9)], "maximum": np.full(201, 99)}
    assert discrepancy._limits(context(None, None, **few), ()) == ()


@pytest.mark.parametrize("error", [InterruptedRunError(signal.SIGINT), StoreError("no space left")])
def test_a_stop_in_the_middle_of_a_comparison_makes_no_verdict(monkeypatch, error):
    """Not even where the search takes whatever a candidate raises for a defect of the candidate."""

    def search(context, *_):
        try:
            discrepancy._Mapper(context)([])
        except Exception:
            pytest.fail("the stop was taken for a defect")

    context = SimpleNamespace(sensor=SimpleNamespace(kind="frames"), reporter=Reporter(quiet=True))
    context.run_units = Mock(side_effect=error)
    context.stop = SimpleNamespace(at_once=contextlib.nullcontext)
    context.store = SimpleNamespace(records=SimpleNamespace(read=lambda _: None))
    monkeypatch.setattr(discrepancy, "model_of", lambda *_: SimpleNamespace(effects=()))
    monkeypatch.setattr(discrepancy, "_run_frames", search)
    with pytest.raises(type(error)) as found:
        discrepancy.run(context)
    assert found.value is error
