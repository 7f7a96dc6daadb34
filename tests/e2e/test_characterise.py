"""A stack in memory, and plain histograms, from Python; frames by plain numpy."""

import gc

import dask.array
import numpy as np
import pytest

import pchem_pipeline
from pchem_pipeline.base.errors import ConfigError

FAST = {"run": {"tile": 8}}
TRUTH = {"conversion_gain": 0.1, "read_noise_e": 0.25}


@pytest.fixture(scope="module")
def frames():
    rng = np.random.default_rng(42)
    electrons = rng.poisson(1.7, (900, 8, 9)) + TRUTH["read_noise_e"] * rng.standard_normal((900, 8, 9))
    return np.rint(100 + electrons / TRUTH["conversion_gain"]).astype(np.int64)


@pytest.mark.parametrize(("noise", "exposure", "n"), [(0.3, 3.0, 500), (0.22, 6.0, 300)])
def test_pixels_whose_gain_or_bias_is_open_do_not_widen_the_components(noise, exposure, n, tmp_path):
    """Of a few the gain is off by 2, of some the bias by several electrons: 34 DN at k = 12 in place of 5."""
    rng, shape = np.random.default_rng(1001), (20, 26)
    step, bias = 9.0 * (1 + 0.012 * rng.standard_normal(shape)), 170 + 4.0 * rng.standard_normal(shape)
    light = exposure * rng.lognormal(0.0, 0.4, shape)
    signal = rng.poisson(light, (n, *shape)) + noise * rng.standard_normal((n, *shape))
    frames = np.rint(bias + step * signal).astype(np.uint16)
    found = pchem_pipeline.characterise(
        frames, store=tmp_path / "run.zarr", settings=FAST, integration_time=1.0, until="ensemble"
    )
    width = np.sqrt(found.group("ensemble").component_variance.values[0])
    for k in (8, 12, 16):
        weight = np.exp(-light) * light**k
        centre = bias + k * step
        mean = np.average(centre, weights=weight)
        right = np.average((centre - mean) ** 2 + (noise * step) ** 2, weights=weight) ** 0.5
        assert width[k] == pytest.approx(right, rel=0.3)


def test_an_array_becomes_a_run_and_nothing_is_done_twice(frames, tmp_path, undrawn):
    def again(stack, seconds=2.0):
        return pchem_pipeline.characterise(
            stack, store=tmp_path / "night.zarr", integration_time=seconds, settings=FAST, kind="dark"
        )

    run = again(frames)
    good = run.good.values
    for name, true in TRUTH.items():
        # rounding to whole DN adds to the read noise: 1/12 DN^2
        true = np.hypot(true, 0.1 / np.sqrt(12)) if name == "read_noise_e" else true
        value, error = run.maps[name].values[good], run.maps[f"{name}_stderr"].values[good]
        assert abs(np.mean((value - true) / error)) < 5 / np.sqrt(value.size)
        assert 0.05 * true / np.median(error) * np.sqrt(value.size) > 10  # off by a twentieth would be seen
    np.testing.assert_allclose(run.maps.dark_current.values, run.maps.quanta_exposure.values / 2.0)
    assert "Is the sensor within limits? <b>" in run._repr_html_()
    assert "conversion gain" in run.pixel(2, 3)._repr_html_()
    made = (tmp_path / "night.zarr" / "report.html").stat().st_mtime_ns
    other = again(dask.array.from_array(frames, chunks=(100, 8, 9)))
    assert (tmp_path / "night.zarr" / "report.html").stat().st_mtime_ns == made
    np.testing.assert_array_equal(other.maps.bias.values, run.maps.bias.values)
    with pytest.raises(ConfigError, match=r"input\.integration_time 2\.0 in the file, 3\.0 here"):
        again(frames, 3.0)


def test_without_a_store_it_goes_with_the_run(frames):
    run = pchem_pipeline.characterise(frames[:, :4, :4], settings=FAST, until="maps")
    path = run.path
    assert "charge_rate" not in run.maps
    assert run.maps.bias.shape == (4, 4)
    assert "ensemble missing" in run._repr_html_()
    del run
    gc.collect()
    assert not path.parent.exists()


def test_what_is_no_stack_is_refused():
    for stack, words in (
        (np.zeros((4, 4), np.uint16), "give an array"),
        (np.zeros((0, 4, 4), np.uint16), "of at least 2 frames"),
        ([[[0.5]], [[1.5]]], "give integers"),
        (np.zeros((4, 4, 4)), "give integers"),
        (np.full((4, 4, 4), -1), "from -1 to -1 DN"),
    ):
        with pytest.raises(ConfigError, match=words):
            pchem_pipeline.characterise(stack)


def test_plain_histograms_in_one_call(frames):
    flat = frames.reshape(900, -1) - 50
    counts = np.array([np.bincount(column, minlength=256) for column in flat.T])
    found = pchem_pipeline.fit_counts(counts.reshape(8, 9, -1), origin=50)
    np.testing.assert_array_equal(found.bias, pchem_pipeline.fit_counts(counts, np.full(72, 50)).bias)
    assert pchem_pipeline.fit_counts(counts[0], 50).bias == found.bias[:1]
    assert abs(np.median(found.conversion_gain) - 0.1) < 0.002
    assert repr(found).startswith("<FitResult of 72 histograms, 7")
    assert "median H = 1." in repr(found)
    shown = found._repr_html_()
    assert shown.count("<tr>") == 11
    assert "and 62 more" in shown
    with pytest.raises(ValueError, match="whole numbers"):
        pchem_pipeline.fit_counts(counts + 0.5)
