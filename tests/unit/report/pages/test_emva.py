"""The table in the words of EMVA 1288, against plain numpy on maps that are drawn here."""

import numpy as np
import pytest
from helpers.report_material import defects_of

from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.report.data import Sample, Samples
from pchem_pipeline.report.pages.emva import COLUMNS, emva_rows

SHAPE = (60, 80)


def drawn():
    """Maps with their errors, the words of the pixels, and the true maps; some pixels are hot."""
    rng = np.random.default_rng(3)
    true = {
        "quanta_exposure": 2.0 + 0.1 * rng.standard_normal(SHAPE),
        "conversion_gain": 0.1 * (1 + 0.02 * rng.standard_normal(SHAPE)),
        "bias": 100 + 3 * rng.standard_normal(SHAPE),
        "read_noise_dn": 3 + 0.1 * rng.standard_normal(SHAPE),
        "read_noise_e": 0.3 + 0.01 * rng.standard_normal(SHAPE),
    }
    true["quanta_exposure"][0, :24] = 30.0  # half a per cent is hot
    maps, status = {}, np.zeros(SHAPE, np.uint16)
    for name, values in true.items():
        error = 0.02 * np.median(values)
        maps |= {name: values + error * rng.standard_normal(SHAPE), f"{name}_stderr": np.full(SHAPE, error)}
    status[1], status[2] = int(FitStatus.BIAS_AMBIGUOUS), int(FitStatus.NO_DATA)
    maps["bias"][1] += 500
    maps["dark_current"] = maps["quanta_exposure"] / 4
    for values in maps.values():
        values[2] = np.nan
    return maps, status, true


def table(maps, status, kind, *more):
    rows = emva_rows(maps, status, kind, defects_of(maps, status), *more)
    return {row.symbol or row.quantity: row for row in rows}


def test_spreads_are_those_of_the_sensor_not_of_its_errors():
    maps, status, true_maps = drawn()
    found = table(maps, status, "light")
    kept = np.ones(SHAPE, bool)
    kept[1:3] = False
    for row, true in (
        (found["DSNU_1288"], 0.1 * true_maps["bias"][kept].std()),
        (found["non-uniformity of the gain"], 2.0),
        (found["PRNU_1288 (similar)"], 5.0),  # 90 % with the hot pixels
        (found["K"], np.mean(1 / true_maps["conversion_gain"][kept])),
        (found["sigma_d"], 0.3),
    ):
        assert abs(row.value - true) < 5 * row.standard_error + 0.001 * true, row
        assert 0 < row.standard_error < 0.1 * true
    assert found["PRNU_1288 (similar)"].definition_here.endswith("; 24 pixels with defects left out")
    # it can fail: with the errors of the pixels in it the spread of the gain is 2.8 %
    gain = maps["conversion_gain"][kept]
    assert 100 * gain.std() / gain.mean() - 2.0 > 5 * found["non-uniformity of the gain"].standard_error
    assert found["hot pixels"].value == pytest.approx(100 * 24 / (60 * 80 - 80), rel=0.01)


def ladder(bend):
    """Return a table of four light levels: pixels of 3 % PRNU whose signal bends, and their true numbers."""
    rng, levels, error = np.random.default_rng(8), np.array([1.0, 2.0, 4.0, 8.0]), 0.03
    rate = 2.0 * (1 + 0.03 * rng.standard_normal(SHAPE))
    line = levels[:, None, None] * rate
    left = bend * (line - line.mean(axis=0)) ** 2 + error * rng.standard_normal((4, *SHAPE))
    read = {"read_noise_e": np.full(SHAPE, 0.3), "charge_per_level": rate + 0.01 * rng.standard_normal(SHAPE)}
    maps = {name: np.full(SHAPE, 1.0) for name in PARAMETERS} | read
    maps |= {f"{name}_stderr": np.full(SHAPE, 0.01) for name in maps}
    exposures = tuple(Sample(str(x), "exposed", x, 1000) for x in levels.tolist())
    arrays = {"quanta_exposure": line + left, "linearity_residual": left}
    samples = Samples(exposures, "light_level", arrays)
    rows = table(maps, np.zeros(SHAPE, np.uint16), "light", 6.0, samples)
    brightest = 8.0 * rate.mean() + left[3].mean()
    true = {
        "PRNU_1288": 3.0,
        "SNR": brightest / np.sqrt(brightest + 0.09),
        "LE": 100 * np.mean(np.abs(left.mean(axis=(1, 2)) / line.mean(axis=(1, 2)))),
    }
    return rows, true, brightest


def test_exposures_at_several_light_levels_determine_linearity_and_prnu():
    rows, true, brightest = ladder(bend=0.002)
    for symbol, value in true.items():
        assert abs(rows[symbol].value - value) < 5 * rows[symbol].standard_error + 1e-3 * value, symbol
    assert rows["LE"].value > 20 * rows["LE"].standard_error  # so that a bend would be missed if it were
    assert rows["DR"].value == pytest.approx(brightest / 0.3, rel=0.01)
    assert "PRNU_1288 (similar)" not in rows
    straight, _, _ = ladder(bend=0.0)
    assert straight["LE"].value < 5 * straight["LE"].standard_error


@pytest.mark.parametrize("kind", ["dark", "light", "unknown"])
def test_what_needs_dark_or_light_is_empty_without(kind):
    maps, status, _ = drawn()
    found = table(maps, status, kind)
    assert np.isfinite(found["mu_I.mean"].value) == (kind == "dark")
    assert np.isfinite(found["PRNU_1288 (similar)"].value) == (kind == "light")
    assert found["eta"].cells()[2:4] == ["", ""]
    assert all(len(row.cells()) == len(COLUMNS) for row in found.values())
    assert all(row.definition_here and row.where_it_differs for row in found.values())
    assert ("the bias alone" in found["DSNU_1288"].where_it_differs) == (kind != "dark")
    # a sensor without a value has an empty table
    status[:] = int(FitStatus.NO_DATA)
    with np.errstate(all="raise"):
        lost = table(maps, status, kind)
    assert all(row.cells()[2] == "" for row in lost.values() if row.quantity != "hot pixels")
