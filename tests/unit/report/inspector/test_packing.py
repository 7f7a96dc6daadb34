"""Maps and histograms in few bytes: what comes back, and what it costs."""

import gzip
import tracemalloc

import numpy as np
import pytest
from helpers.packed_maps import unpack_map

from pchem_pipeline.report.inspector import Scale, choose_scale, pack_counts, pack_map, varints


def read_varints(data: bytes) -> list[int]:
    """Read them in the plainest way."""
    found, value, power = [], 0, 1
    for byte in data:
        value += (byte & 127) * power
        power *= 128
        if byte < 128:
            found.append(value)
            value, power = 0, 1
    return found


def back_of(values: np.ndarray) -> np.ndarray:
    return unpack_map(pack_map(values, choose_scale(values)), values.shape)


def test_values_come_back_to_half_a_step() -> None:
    values = np.random.default_rng(1).normal(100.0, 4.0, (40, 60))
    values[3, 5] = np.nan
    values[0, 0], values[1, 1] = 1e6, -1e6
    scale = choose_scale(values, step=0.01)
    packed = pack_map(values, scale)
    back = unpack_map(packed, values.shape)
    assert scale.step == 0.01
    assert packed.n_odd == 2
    assert back[0, 0] == 1e6
    assert back[1, 1] == -1e6
    np.testing.assert_array_equal(np.isnan(back), np.isnan(values))
    regular = np.abs(np.nan_to_num(values)) < 1e5
    error = np.abs(back - values)[regular & np.isfinite(values)]
    assert 0.004 < error.max() <= 0.005 + 1e-9


def test_wide_positive_values_keep_their_relative_error() -> None:
    values = 10.0 ** np.random.default_rng(3).uniform(-8, 0, (80, 80))
    values[0, 0] = 0.0
    scale = choose_scale(values)
    back = unpack_map(pack_map(values, scale), values.shape)
    assert scale.log
    assert back[0, 0] == 0.0
    np.testing.assert_allclose(back.ravel()[1:], values.ravel()[1:], rtol=0.0117)
    # the order of codes is the order of values, and many zeros cost nothing
    values = np.random.default_rng(2).lognormal(0.0, 2.0, (80, 80))
    assert (np.diff(back_of(values).ravel()[np.argsort(values, axis=None)]) >= 0).all()
    values[:, 20:] = 0.0
    packed = pack_map(values, choose_scale(values))
    assert packed.n_odd == 0
    assert len(packed.data) < 4000
    back = unpack_map(packed, values.shape)
    assert (back[:, 20:] == 0).all()
    np.testing.assert_allclose(back, values, rtol=0.0117)


@pytest.mark.parametrize("log", [False, True])
def test_a_map_of_coarse_codes_has_the_bars_of_its_values(log: bool) -> None:
    values = np.random.default_rng(5).normal(2.0, 0.5, (300, 300))
    values = 10.0**values if log else values
    values[0, :3] = np.nan, 1e9, -1e9 if not log else 0.0
    packed = pack_map(values, Scale(-3.0, 0.5, log))
    assert packed.bars is not None
    first, parts, counts = packed.bars["first"], packed.bars["parts"], np.array(packed.bars["counts"])
    assert 60 < counts.size < 130
    edges = -3.0 + 0.5 * (first - 2 - 0.5 + np.arange(counts.size + 1) / parts)
    with np.errstate(divide="ignore", invalid="ignore"):
        on_axis = np.log10(values) if log else values
    assert counts.sum() > 0.98 * values.size
    np.testing.assert_array_equal(counts, np.histogram(on_axis[np.isfinite(on_axis)], edges)[0])
    # the codes of the map have no more than a dozen steps there: bars of them would be as many
    assert np.unique(unpack_map(packed, values.shape)[np.isfinite(values)]).size < 20


def test_fine_codes_and_whole_numbers_have_no_bars() -> None:
    values = np.random.default_rng(6).normal(100.0, 4.0, (100, 100))
    assert pack_map(values, choose_scale(values)).bars is None
    assert pack_map(np.full((20, 20), 3.5), Scale(0.0, 1.0)).bars is None
    few = np.random.default_rng(6).integers(0, 9, (100, 100)).astype(np.uint8)
    assert pack_map(few, choose_scale(few)).bars is None


def test_whole_numbers_are_exact_and_one_value_or_none_comes_back() -> None:
    for dtype in (np.uint8, np.uint16, np.int32):
        values = np.random.default_rng(4).integers(0, 200, (30, 30)).astype(dtype)
        np.testing.assert_array_equal(back_of(values), values)
    for value in (0.0, 3.5, -2e9):
        np.testing.assert_allclose(back_of(np.full((6, 7), value)), value, rtol=1e-6)
    nothing = np.full((6, 7), np.nan)
    assert choose_scale(nothing) == Scale(0.0, 1.0)
    assert np.isnan(back_of(nothing)).all()


def test_numbers_of_any_length() -> None:
    values = np.array([0, 1, 127, 128, 16383, 16384, 2**32, 2**63 - 1])
    assert read_varints(varints(values)) == values.tolist()
    assert varints(np.empty(0)) == b""


def test_histograms_lose_their_empty_ends_only() -> None:
    counts = [np.array([0, 0, 5, 0, 300, 0]), np.zeros(4, int), np.array([7])]
    origin, bins, data = pack_counts(np.array([10, 20, -3]), counts)
    assert origin.tolist() == [12, 0, -3]
    assert bins.tolist() == [3, 0, 1]
    assert read_varints(data) == [5, 0, 300, 7]


def test_all_bins_are_never_held_at_once_as_wide_numbers() -> None:
    counts = [np.ones(16384, np.uint16)] * 64
    tracemalloc.start()
    pack_counts(np.zeros(64, int), counts)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 64 * 16384 * 8


def test_a_map_of_noise_costs_what_its_information_does() -> None:
    """Normal values in steps of a 64th of their spread hold log2(64 sqrt(2 pi e)) = 8.05 bits."""
    values = np.random.default_rng(6).normal(size=(256, 256))
    packed = pack_map(values, choose_scale(values))
    bits = 8 * len(packed.data) / values.size
    assert 8.0 < bits < 8.6
    assert len(gzip.decompress(packed.data)) == 2 * values.size + 8 * packed.n_odd
