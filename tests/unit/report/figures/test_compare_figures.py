"""The figures, tables and settings of a comparison of runs."""

import numpy as np
import pytest

from pchem_pipeline.base.variables import MEASURED_MAPS
from pchem_pipeline.commands.compare.settings import settings_that_differ
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.model.checks.run_differences import MapDifference, compare_maps
from pchem_pipeline.report.charts.on_paper import Drawing, Look, draw_chart
from pchem_pipeline.report.comparison import RunFacts
from pchem_pipeline.report.figures.compare import (
    difference_chart,
    ensemble_tables,
    ensembles_chart,
    history_figures,
)


def difference(shape: tuple[int, int], size: float, *, same_data: bool = False):
    rng = np.random.default_rng(1)
    one, error = rng.normal(10, 1, shape), np.full(shape, 0.1)
    other = one + size * 0.1 * rng.standard_normal(shape)
    one[0, 0] = np.nan
    maps = [("bias", (one, error), (other, error))]
    return compare_maps(maps, np.ones(shape, bool), same_data=same_data)["bias"]


def drawn(found: MapDifference, *, same_data: bool) -> Drawing:
    chart = difference_chart(found.z, found.n_changed, "bias: B − A", same_data=same_data)
    return draw_chart(Look(), chart)


@pytest.mark.parametrize("shape", [(12, 16), (1, 9), (40, 4)])
def test_maps_of_differences_of_all_shapes(shape: tuple[int, int]) -> None:
    found = difference(shape, 1.4)
    figure = drawn(found, same_data=False)
    top, bottom = figure.axes[0], figure.axes[-1]
    if min(shape) > 1:
        level = np.asarray(top.images[0].get_array(), dtype=float)
        np.testing.assert_allclose(level, found.z, rtol=1e-6)
        assert figure.axes[0].child_axes[0].get_yticklabels()[0].get_text() == "−4"
    assert sum(bottom.patches[0].get_data().values) == np.isfinite(found.z).sum()
    assert len(bottom.lines) == 1  # what chance gives


def test_tiny_differences_of_the_same_frames_are_seen() -> None:
    found = difference((12, 16), 3e-9, same_data=True)
    figure = drawn(found, same_data=True)
    assert figure.axes[-1].get_xlabel() == "difference (10⁻⁹ standard errors)"
    ends = [
        abs(float(text.get_text().replace("−", "-")))
        for text in figure.axes[0].child_axes[0].get_yticklabels()
    ]
    assert 0.5 <= max(ends) < 10.0
    assert not figure.axes[-1].lines
    nothing = difference((12, 16), 0.0, same_data=True)
    assert drawn(nothing, same_data=True).axes[0].child_axes[0].get_ylim() == (-1.0, 1.0)


def run_facts(label: str, mean: float) -> RunFacts:
    rng = np.random.default_rng(2)
    dn = np.arange(60, 140)
    counts = np.histogram(rng.normal(mean, 8, 20_000), np.arange(59.5, 140.5))[0]
    arrays = {"dn": dn, "counts": counts, "density": counts / counts.sum()}
    return RunFacts(label, f"{label}$x$.zarr", (8, 8), 100, "", ensemble=arrays)


def test_ensembles_lie_over_each_other() -> None:
    (top, strip), (_, level) = (
        draw_chart(Look(180.0), ensembles_chart(ensemble_tables([run_facts("A", 100.0), other]))).axes
        for other in (run_facts("B", 104.0), run_facts("B", 100.0))
    )
    assert [line.get_label() for line in top.lines] == ["A (A\\$x\\$.zarr)", "B (B\\$x\\$.zarr)"]
    z = np.asarray(strip.lines[0].get_ydata())
    # f(x - 4) - f(x) of N(0, 8^2) is 0.0149 at most, its error sqrt(1050) / 20,000: 9.2, and chance
    assert 7 < np.abs(z).max() < 13
    # of equal ones the strip reaches beyond its band: ticks at its ends would run into those above
    assert level.get_ylim() == (-3.0, 3.0)
    assert ensemble_tables([RunFacts("A", "a", (8, 8), 1, ""), run_facts("B", 99.0)]) == ()


def test_settings_that_differ_name_their_readers() -> None:
    one = RunConfig.model_validate({"input": {"files": ["a.tif"], "integration_time": 1.0}})
    other = RunConfig.model_validate(
        {"input": {"files": ["a.tif"]}, "fit": {"gap_threshold": 6}, "simulate": {}}
    )
    rows = {row.name: row for row in settings_that_differ(one, other)}
    assert set(rows) == {"input.integration_time", "fit.gap_threshold", "simulate"}
    assert (rows["fit.gap_threshold"].one, rows["fit.gap_threshold"].other) == ("5.0", "6.0")
    assert rows["input.integration_time"].stages == ("maps",)
    assert (rows["simulate"].one, rows["simulate"].stages) == ("not set", ("simulate",))
    assert settings_that_differ(one, one) == []
    effects = {"model": {"effects": [{"tag": "row_noise", "row_noise_dn": 1.0}]}}
    extended = RunConfig.model_validate({"input": {"files": ["a.tif"], "integration_time": 1.0}, **effects})
    (row,) = settings_that_differ(one, extended)
    assert (row.name, row.stages) == ("model.effects", ("fit",))


@pytest.mark.parametrize(
    ("labels", "ticks"),
    [
        (["before", "after"], [(0.0, "before"), (1.0, "after")]),
        (["2026-01-31T12:00:00+00:00"] * 2, [(0.0, "1"), (1.0, "2")]),
    ],
)
def test_runs_in_their_order_are_told_by_label_or_number(
    labels: list[str], ticks: list[tuple[float, str]]
) -> None:
    parts = ("median", "median_stderr", "scatter")
    bias = {f"bias_{part}": "1" for part in parts}
    others = {f"{name}_{part}": "" for name in MEASURED_MAPS if name != "bias" for part in parts}
    rows = [{"label": label, "date": "", "run": "r.zarr", **bias, **others} for label in labels]
    (figure,) = history_figures(rows)
    assert figure.tables[0]["name"].tolist() == ["r.zarr", "r.zarr"]
    axis = figure.draw(Look()).axes[-1].xaxis
    assert list(zip(axis.get_ticklocs(), [t.get_text() for t in axis.get_ticklabels()], strict=True)) == ticks
