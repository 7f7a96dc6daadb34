"""Runs compared: a rerun is proven to be the same, and what changed is found and shown."""

import contextlib
import csv
import hashlib
import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from helpers.html_page import Page
from helpers.report_material import report_data

from pchem_pipeline.base.errors import ChangedError, ConfigError, StoreError
from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.base.wording import percent
from pchem_pipeline.commands.compare.compare import compare_runs, comparison_of
from pchem_pipeline.commands.compare.history import HISTORY
from pchem_pipeline.commands.notebook import open_run
from pchem_pipeline.frames.camera import CameraFacts
from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.report.figures.compare import history_figures
from pchem_pipeline.report.pages.compare import sentence_of
from pchem_pipeline.report.pages.summary import criteria
from pchem_pipeline.run.progress import Reporter
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.stage import Command
from pchem_pipeline.stages.defects import stored_defects
from pchem_pipeline.store.run_store import RunStore, stored_config


@pytest.fixture
def copies(shell, finished):
    for name in ("a", "b"):
        shutil.copytree(finished, shell.folder / f"{name}.zarr")
    return RunStore.open(shell.folder / "b.zarr", writable=True)


def here(shell, *names, quiet=False, **options):
    """Compare in this process: the lines that are printed."""
    lines, paths = [], [shell.folder / name for name in names]
    with contextlib.suppress(ChangedError):
        command = Command(progress="off", quiet=quiet)
        compare_runs(paths, shell.folder / "compare", command, write=lines.append, **options)
    return lines


def compared(shell, *names, **options):
    """Return the comparison of runs; nothing is written."""
    paths = [shell.folder / name for name in names]
    return comparison_of(paths, shell.folder / "nowhere", Reporter("off"), **options)[0]


def put(store, name, values):
    """Write a whole array of a run."""
    store.write(name, (slice(None),) * values.ndim, values)


def numbers(shell, folder="compare"):
    return json.loads((shell.folder / folder / "compare.json").read_text())


def test_nothing_changed_is_proven_by_digests(shell, copies):
    result = shell.ok("compare", "a.zarr", "b.zarr")
    assert (result.stdout, result.stderr) == ("no change\n", "")
    sentence = numbers(shell)["sentence"]
    assert sentence.startswith("Nothing changed: ")
    assert sentence.endswith(" are bit-identical.")
    [pair] = numbers(shell)["comparisons"]
    assert (pair["same_data"], pair["changed"], pair["what"]) == (True, False, [])
    rows = {row["name"]: row for row in pair["arrays"]}
    assert {row["state"] for row in rows.values()} == {"identical"}
    assert len(rows) > 60
    for name in ("histogram/counts", "fit/correlation", "summary/row_sum", "ensemble/epcd_exact"):
        values = np.ascontiguousarray(copies.read(name))
        digest = hashlib.sha256(values.tobytes()).hexdigest()
        assert rows[name]["sha256"] == [digest, digest]
        assert rows[name]["n_values"] == values.size
    page = (shell.folder / "compare" / "compare.html").read_text(encoding="utf-8")
    # figures are saved with their numbers, words explained
    for words in ("Nothing changed", "bit-identical", 'id="figure-tables"', 'id="term-read-noise"'):
        assert words in page
    for source in re.findall(r'(?:src|srcset|href)="([^"]*)"', page):
        assert source.startswith(("data:image/", "#"))


def test_one_value_that_moved_is_found(shell, copies, undrawn):
    bias = copies.read("maps/bias")
    y, x = np.argwhere(np.isfinite(bias))[5]
    bias[y, x] *= 1 + 1e-9
    put(copies, "maps/bias", bias)
    result = shell("compare", "a.zarr", "b.zarr", "-o", "out", "--quiet")
    assert result.code == 3
    head, what = result.stdout.splitlines()
    assert head == "b.zarr since the reference a.zarr:"
    assert what.startswith("  maps/bias: 1 value of 560 changed")
    assert result.last == f"pchem: changed; see {shell.folder}/out/compare.html"
    [limited] = compared(shell, "a.zarr", "b.zarr", limits=["bias=0.1"]).pairs
    assert [row.name for row in limited.arrays if row.state != "identical"] == ["maps/bias"]
    [equal] = compared(shell, "a.zarr", "b.zarr", tolerance=1e-6).pairs
    assert not limited.changed
    assert not equal.changed
    assert "equal" in {row.state for row in equal.arrays}


def test_lost_and_new_arrays_settings_and_versions(shell, copies, undrawn):
    copies.delete("fit/goodness_p")
    copies.delete("fit/n_iterations")
    shutil.rmtree(shell.folder / "a.zarr" / "ensemble" / "epcd_independent")
    text = stored_config(copies.path) or ""
    copies.write_config(text.replace("gap_threshold: 5.0", "gap_threshold: 7.0"))
    assert "fit/goodness_p: missing" in "\n".join(here(shell, "a.zarr", "b.zarr"))
    [pair] = numbers(shell)["comparisons"]
    assert pair["what"] == ["fit/goodness_p: missing."]  # what is new, or no result, counts nothing
    assert pair["settings"] == [
        {"name": "fit.gap_threshold", "one": "5.0", "other": "7.0", "stages": ["fit"]}
    ]
    assert pair["versions"] == []
    put(copies, "maps/quality", np.full_like(copies.read("maps/quality"), 2))
    other_capture(copies)
    assert "No pixel has a good fit in both runs." in "\n".join(here(shell, "a.zarr", "b.zarr"))


def other_capture(store, *, exposure=1.0, seed=1, noise=2**0.5):
    """Make of a run what another capture would have given: noise of its standard errors, other frames."""
    rng = np.random.default_rng(seed)
    for name in (*PARAMETERS, "read_noise_e", "charge_rate"):
        values, error = store.read(f"maps/{name}"), store.read(f"maps/{name}_stderr")
        factor = exposure if name in ("quanta_exposure", "charge_rate") else 1.0
        values = factor * values + noise * error * rng.standard_normal(values.shape)
        put(store, f"maps/{name}", values)
    store.delete("maps/analog_read_noise_e")
    sensor = store.attributes("frames")["sensor"]
    sensor["identity"]["digest"] = f"capture {seed}"
    store.set_attributes("frames", {"sensor": sensor})


def test_another_capture_agrees_until_it_is_warmer(shell, copies, finished, undrawn):
    other_capture(copies)
    shutil.copytree(finished, shell.folder / "warm <b>.zarr")
    warm = RunStore.open(shell.folder / "warm <b>.zarr", writable=True)
    other_capture(warm, exposure=1.2, seed=2)
    lines = here(shell, "a.zarr", "b.zarr", "warm <b>.zarr")
    assert lines[:2] == [
        "b.zarr since the reference a.zarr: no change",
        "warm <b>.zarr since the reference a.zarr:",
    ]
    assert lines[2].startswith("  Quanta exposure: median changed by ")
    assert "warm <b>.zarr since the last run b.zarr:" in lines
    assert numbers(shell)["sentence"] == "Changed: C since A, C since B. No change: B since A."
    same, moved, since_last = numbers(shell)["comparisons"]
    assert [pair["since"] for pair in (same, moved, since_last)] == ["reference", "reference", "last run"]
    assert not same["changed"]
    assert moved["maps"]["charge_rate"]["reasons"]["shifted"]
    assert not any(moved["maps"]["bias"]["reasons"].values())
    # 20 % of the exposure is many standard errors: the test can fail
    rate = moved["maps"]["charge_rate"]
    assert rate["median_z"] / np.sqrt(np.pi / (2 * rate["n_counted"])) > 20
    page = (shell.folder / "compare" / "compare.html").read_text(encoding="utf-8")
    assert "warm &lt;b&gt;.zarr" in page
    assert "<b>.zarr" not in page


def test_the_history_of_a_camera(shell, copies, finished, undrawn):
    """Pixels that moved are found at the stated rate, run by run, and the medians against the labels."""
    other_capture(copies)
    shutil.copytree(finished, shell.folder / "c.zarr")
    third = RunStore.open(shell.folder / "c.zarr", writable=True)
    other_capture(third, seed=3)
    bias, error = third.read("maps/bias"), third.read("maps/bias_stderr")
    good = np.argwhere(third.read("maps/quality") == 0)[:40]
    bias[tuple(good.T)] += 12 * error[tuple(good.T)]
    put(third, "maps/bias", bias)
    exposure = third.read("maps/quanta_exposure")
    words, origin = third.read("fit/fit_status"), third.read("histogram/origin")
    y, x = good[:3].T
    exposure[y, x] = 60.0
    origin[y, x] += 50  # the samples are others, too
    put(third, "histogram/origin", origin)
    words[y[0], x[0]] |= int(FitStatus.BIAS_AMBIGUOUS)  # a flagged pixel is hot, too
    put(third, "maps/quanta_exposure", exposure)
    put(third, "fit/fit_status", words)
    labels = ["-20 C", "-10 C", "0 C"]
    paths = [shell.folder / f"{name}.zarr" for name in "abc"]
    with pytest.raises(ChangedError):
        compare_runs(paths, shell.folder / "history", Command(progress="off"), labels=labels, rate=0.05)
    with (shell.folder / "history" / "history.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["label"] for row in rows] == labels
    assert [row["run"] for row in rows] == ["../a.zarr", "../b.zarr", "../c.zarr"]
    assert rows[0]["bias_moved"] == ""
    n = int(rows[1]["compared_pixels"])
    # without a change each of 6 maps calls a pixel moved with a probability of 5 %, not each of its pixels
    assert int(rows[1]["moved_pixels"]) <= 6
    found = int(rows[2]["bias_moved"])
    assert 38 <= found <= 40 + 12  # 40 moved; at most one in twenty of those found by chance, and its scatter
    assert found < 0.2 * n
    (bias,) = (w for w in numbers(shell, "history")["comparisons"][1]["what"] if w.startswith("Bias: "))
    # they fill the first row; one count in both
    assert re.fullmatch(
        rf"Bias: .*row 0 moved by .* DN.* against the others, {found} pixels changed, p < 0.001.", bias
    )
    assert int(rows[2]["pixels_good"]) == int((third.read("maps/quality") == 0).sum())
    summary = third.attributes("maps")["summary"]["conversion_gain"]
    assert float(rows[2]["conversion_gain_median"]) == pytest.approx(summary["median"])
    assert rows[0]["date"][:2] == "20"
    assert "flag_poor_fit" in rows[0]
    assert rows[0]["defects_new"] == rows[0]["defects_gone"] == ""
    new = rows[2]["defects_new"].split()
    assert set(new) >= {f"{y}/{x}" for y, x in good[:3]}
    known = exposure[np.isfinite(exposure)]
    data = report_data(exposure.shape)
    now = {"maps": {**data.maps, "quanta_exposure": exposure}, "fit": {**data.fit, "fit_status": words}}
    data = replace(data, **now, defects=stored_defects(third, open_run(third.path).config))
    share = next(each for each in criteria(data) if each.setting == "hot_pixels").found  # of the report
    assert share == percent(int(rows[2]["hot_pixels"]), known.size)
    page = Page((shell.folder / "history" / "compare.html").read_text(encoding="utf-8")).text
    assert "The camera over time" in page
    assert re.search(rf"Defects ?: {len(new)} new\b", page)
    assert "-20 C" in page


def test_the_history_has_date_and_temperature_of_the_files(shell, copies):
    other_capture(copies)
    for name, temperature, taken in (("a", -20.0, 1.75e9), ("b", -5.5, 1.76e9)):
        store = RunStore.open(shell.folder / f"{name}.zarr", writable=True)
        sensor = SensorInfo.read(store)
        replace(sensor, camera=CameraFacts("Camera <X>", "7", temperature, taken)).write(store)
    rows = compared(shell, "a.zarr", "b.zarr", labels=["-20 °C", "-5.5 °C"]).history
    assert rows[0]["date"].startswith("2025-06-15T")
    assert list(rows[0])[:4] == ["label", "date", "temperature", "run"]
    assert rows[1]["temperature"] == "-5.5"
    (figure,) = history_figures(rows)
    assert figure.tables[0]["label"].tolist() == [-20.0, -5.5]


def test_nights_of_one_camera(shell, finished, monkeypatch):
    """Nothing is said where nothing changed; a jump is told once since the last run, then since the first."""
    pages = []  # what they would be made of
    render = "pchem_pipeline.commands.compare.compare.render_comparison"
    monkeypatch.setattr(render, lambda found, draw: pages.append(found) or ("", ""))
    monkeypatch.setattr("pchem_pipeline.commands.compare.compare.warn_if_old", lambda *_: None)

    def tonight(n):
        shutil.copytree(finished, shell.folder / f"night{n}.zarr")
        store = RunStore.open(shell.folder / f"night{n}.zarr", writable=True)
        other_capture(store, seed=100 + n, noise=1.0)
        return store

    def lines(n, *limits):
        return here(shell, "night0.zarr", f"night{n}.zarr", limits=limits, quiet=True)

    tonight(0)
    history = shell.folder / "compare" / HISTORY
    for n in range(1, 4):
        tonight(n)
        assert lines(n) == []
        before = history.read_text()
        assert len(before.splitlines()) == n + 2
        assert lines(n) == []
        assert history.read_text() == before
    limits = ("bias=0.5", "read_noise_e=5%", "pixels=1%")
    for n in (4, 5):
        store = tonight(n)
        put(store, "maps/bias", store.read("maps/bias") + 2.0)
    said = lines(4, *limits)
    assert [line.partition(":")[0] for line in said] == [
        "night4.zarr since the reference night0.zarr",
        "  Bias",
        "  Pixels",
        "night4.zarr since the last run night3.zarr",
        "  Bias",
        "  Pixels",
    ]
    change, error = re.search(r"median changed by ([\d.]+) ± ([\d.]+) DN, limit 0.5 DN\.", said[1]).groups()
    assert abs(float(change) - 2.0) < 5 * float(error) < 0.5
    said = lines(5, *limits)
    assert said[0] == "night5.zarr since the reference night0.zarr:"
    assert said[-1] == "night5.zarr since the last run night4.zarr: no change beyond the limits"
    other_capture(store, seed=205, noise=1.0)  # night 5 again: the last run is the night before
    assert any("since the last run night4.zarr" in line for line in lines(5, *limits))
    assert lines(5, "bias=2.5", "pixels=100%") == []
    # the limits of the reference's YAML are those of the command line
    shutil.rmtree(shell.folder / "night4.zarr")
    reference = RunStore.open(shell.folder / "night0.zarr", writable=True)
    text = stored_config(reference.path)
    reference.write_config(text.replace("  bias: null\n", "  bias: 3\n", 1))
    assert lines(5) == []
    [pair] = pages[-1].pairs  # the last run is gone
    assert sentence_of(pages[-1]).endswith("all that has a limit is within it: bias.")
    assert pair.limits == {"bias": 3.0}
    assert [row["run"] for row in pages[-1].history] == [f"../night{n}.zarr" for n in (*range(6), 5)]
    assert len(history.read_text().splitlines()) == 1 + 7


def test_bad_input_gets_one_line(shell, finished):
    assert shell.refused(2, "compare", finished) == "pchem: compare: give two runs or more"
    RunStore.create(shell.folder / "empty.zarr")
    for name, words in (("nothing", "does not exist"), ("empty", "")):
        with pytest.raises(StoreError, match=rf"{name}\.zarr.*{words}"):
            here(shell, finished, f"{name}.zarr")
    for limit, words in (
        ("bais=3", "compare.bais: unknown key; did you mean bias?"),
        ("bias", "write name=value, such as bias=0.5"),
        ("bias=-1", "compare.bias: give a number from 0 on, or per cent"),
        ("dark_current=5%", "compare.dark_current: .* has no such map; omit this limit"),
    ):
        with pytest.raises(ConfigError, match=words):
            compared(shell, finished, finished, limits=[limit])
    for each in ({"labels": ["one"]}, {"rate": 0.0}):
        with pytest.raises(ConfigError, match="--"):
            compared(shell, finished, finished, **each)
