"""``report.json``: the shape that programs rely on."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.report_material import report_data

from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.pages.report_json import report_json
from pchem_pipeline.report.pages.tables import result_tables


@pytest.fixture(scope="module")
def data() -> ReportData:
    return report_data((16, 20), failed=0.1)


@pytest.fixture(scope="module")
def numbers(data: ReportData) -> dict[str, object]:
    content: dict[str, object] = json.loads(report_json(data))
    return content


def test_every_map_is_summarised_with_its_unit(numbers: dict, data: ReportData) -> None:
    names = {name for name in data.maps if not name.endswith("_stderr")}
    assert set(numbers["summary"]) == names
    # what others read
    parts = "summary ensemble fit_status run inputs stages moments electron_numbers"
    assert set(numbers) >= set(parts.split())
    rmse = "epcd_exact epcd_dependent epcd_independent nuced_dependent nuced_independent noise_floor"
    assert set(numbers["ensemble"]["rmse"]) >= set(rmse.split())
    assert numbers["ensemble"]["error_rate"] == 0.107
    assert sum(numbers["electron_numbers"]["mass"]) == pytest.approx(1.0)
    assert numbers["electron_numbers"]["k"][:3] == [0, 1, 2]
    noise = numbers["summary"]["read_noise_e"]
    assert noise["unit"] == "e-"
    assert noise["percentiles"]["50"] == noise["median"]
    assert noise["n_pixels"] + noise["n_flagged"] + noise["n_without_value"] == data.shape[0] * data.shape[1]
    unflagged = ~data.flagged_in("read_noise_e")
    for key, name in (("median", "read_noise_e"), ("pixel_stderr", "read_noise_e_stderr")):
        assert noise[key] == pytest.approx(np.nanmedian(data.maps[name][unflagged]))


def test_parts_of_the_sensor_with_a_name_have_their_own_numbers(data: ReportData) -> None:
    taps = {"left": Region(columns=((0, 10),)), "right": Region(columns=((10, 20),))}
    shown = replace(data, regions=taps, maps=data.maps | {"bias": data.maps["bias"] + np.arange(20)})
    numbers = json.loads(report_json(shown))["regions"]
    for name, columns in (("left", slice(0, 10)), ("right", slice(10, 20))):
        inside = np.where(shown.flagged_in("bias"), np.nan, shown.maps["bias"])[:, columns]
        assert numbers[name]["bias"]["median"] == pytest.approx(np.nanmedian(inside))
        assert numbers[name]["bias"]["n_pixels"] == np.isfinite(inside).sum()
    [table] = [table for table in result_tables(shown) if table.id == "regions"]
    assert [row["where"] for row in table.rows] == ["columns 0 to 9", "columns 10 to 19"]
    assert {row["pixels"] for row in table.rows} == {"160"}
    assert not [table for table in result_tables(data) if table.id == "regions"]


def test_fit_status_counts_pixels_by_reason(numbers: dict, data: ReportData) -> None:
    status = data.fit["fit_status"]
    found = numbers["fit_status"]
    assert found["n_pixels"] == status.size
    assert found["n_good"] == (status == 0).sum()
    assert found["n_good"] + found["n_caution"] + found["n_failed"] == status.size
    few = found["reasons"]["too_few_bins"]
    assert few["pixels"] == ((status & int(FitStatus.TOO_FEW_BINS)) != 0).sum() > 0
    assert few["failed"] is True
    assert found["reasons"]["poor_fit"]["failed"] is False


def test_pulls_of_simulated_data(numbers: dict) -> None:
    bias = numbers["truth"]["bias"]
    n = numbers["summary"]["bias"]["n_pixels"]
    assert abs(bias["pull_mean"]) < 5 / np.sqrt(n)
    assert abs(bias["pull_sd"] - 1) < 5 / np.sqrt(2 * n)


def test_what_is_not_known_is_null_and_the_text_is_strict_json(data: ReportData) -> None:
    odd = replace(
        data,
        maps={"bias": np.full(data.shape, np.nan), "bias_stderr": np.full(data.shape, np.nan)},
        run={"seed": np.int64(7), "rate": np.float64("inf"), "path": object, "flags": (np.bool_(True),)},
        ensemble_facts={"rmse": {"epcd_exact": float("nan")}, "error_sizes": np.arange(3)},
    )
    text = report_json(odd)
    numbers = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert numbers["summary"]["bias"]["median"] is None
    assert numbers["ensemble"]["rmse"]["epcd_exact"] is None
    assert numbers["ensemble"]["error_sizes"] == [0, 1, 2]
    assert numbers["run"]["seed"] == 7
    assert numbers["run"]["rate"] is None
    assert numbers["run"]["flags"] == [True]
    assert text.endswith("\n")
