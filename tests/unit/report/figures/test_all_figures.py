"""Every figure, on data as they should be and on data as they are; spectra show what is planted."""

import io
from dataclasses import replace
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from helpers.quick_stacks import stack, sums_of
from helpers.report_material import CASES, PARAMETERS, pixel_fit, report_data, true_maps
from PIL import Image

from pchem_pipeline.discrepancy.quick.sums import StackSums
from pchem_pipeline.model.fit.status import MEANINGS, FitStatus
from pchem_pipeline.model.maps.ordered import Ordered
from pchem_pipeline.report.charts.chart import COLUMN_MM, PAGE_MM, Chart
from pchem_pipeline.report.charts.on_paper import Drawing, Look, draw_chart, drawing_bytes, small_png
from pchem_pipeline.report.data import PixelFit, reasons_in
from pchem_pipeline.report.figures.ensemble import (
    component_table,
    components_chart,
    electrons_chart,
    ensemble_chart,
    ensemble_tables,
)
from pchem_pipeline.report.figures.figure import DataTable, csv_text
from pchem_pipeline.report.figures.maps import map_chart, map_tables, status_chart
from pchem_pipeline.report.figures.pixels import pixels_chart
from pchem_pipeline.report.figures.stability import (
    frame_table,
    line_spectra,
    pattern_spectra,
    power_table,
    profile_table,
    stability_figures,
)

LOOK = Look()


def drawn(figure: Drawing) -> bytes:
    """Draw at low resolution; warnings are errors."""
    content = drawing_bytes(figure, "png", dpi=50)
    assert content.startswith(b"\x89PNG")
    return content


def texts(figure: Drawing) -> str:
    found = [text.get_text() for text in figure.findobj(mpl.text.Text)]
    return "\n".join(found)


@pytest.fixture(scope="module")
def pixel() -> PixelFit:
    return pixel_fit(true_maps((8, 8)), 3, 4, "low read noise, low exposure")


NAN_PIXEL = PixelFit(
    "failed", 1, 2, 100, np.array([0, 5, 6, 0]), dict.fromkeys((*PARAMETERS, "read_noise_e"), float("nan")),
    status="fewer than 3 occupied bins; one Gaussian fits as well: the conversion gain is not identified",
)  # fmt: skip
EMPTY_PIXEL = replace(NAN_PIXEL, counts=np.zeros(4, dtype=np.uint16))


@pytest.mark.parametrize("width", [COLUMN_MM, PAGE_MM])
def test_pixel_fits_show_parameters_with_errors_and_the_status(pixel: PixelFit, width: float) -> None:
    figure = draw_chart(Look(width), pixels_chart([pixel, NAN_PIXEL, EMPTY_PIXEL]))
    words = texts(figure)
    for each in ("± 0.012 e⁻", "fewer than 3 occupied bins", "no fit", "no frames"):
        assert each in words
    assert figure.get_size_inches()[0] * 25.4 == pytest.approx(width)
    drawn(figure)


def test_residuals_beyond_the_strip_are_marked_and_a_bin_far_out_does_not_stretch_it(pixel: PixelFit) -> None:
    wrong = replace(pixel, parameters={**pixel.parameters, "bias": pixel.parameters["bias"] + 5.0})
    assert "beyond 12 σ" in texts(draw_chart(LOOK, pixels_chart([wrong])))
    counts = np.zeros(5000, dtype=np.int64)
    counts[: pixel.counts.size] = pixel.counts
    counts[4999] = 1
    figure = draw_chart(LOOK, pixels_chart([replace(pixel, counts=counts)]))
    assert np.ptp(figure.axes[0].get_xlim()) < 400
    assert "1 outside the axis" in texts(figure)
    drawn(figure)


def put(values: np.ndarray, *changes: tuple[Any, float]) -> np.ndarray:
    """Return a copy with other values at places."""
    values = values.copy()
    for place, value in changes:
        values[place] = value
    return values


PLAIN = np.random.default_rng(5).normal(2.0, 0.2, (24, 32))
HOLES = np.where(np.random.default_rng(6).random(PLAIN.shape) < 0.3, np.nan, PLAIN)
NOTHING = np.full(PLAIN.shape, np.nan)
MAPS = {
    "plain": PLAIN,
    "hot": put(PLAIN, ((3, 4), 1e4)),
    "holes": HOLES,
    "empty": NOTHING,
    "one value": put(NOTHING, ((2, 3), 1.0)),
    "constant": np.full(PLAIN.shape, -7.5),
    "zero": np.zeros(PLAIN.shape),
    "decades": np.exp(3 * np.random.default_rng(7).standard_normal(PLAIN.shape)),
    "tiny": PLAIN[:8, :8],
    "wide": PLAIN.reshape(1, -1)[:, :600],
    "column": PLAIN.reshape(-1, 1)[:40],
    "long": PLAIN.reshape(4, -1),
    "channels": put(PLAIN[:1, :6], ((0, 2), np.nan)),
    "one pixel": PLAIN[:1, :1],
}


def chart_of(values: np.ndarray, name: str = "bias", stderr: np.ndarray | None = None) -> Chart:
    known = Ordered.of(values)
    return map_chart(map_tables(values, name, stderr, known), name, known)


@pytest.mark.parametrize("kind", MAPS)
def test_maps_of_all_kinds(kind: str) -> None:
    figure = draw_chart(LOOK, chart_of(MAPS[kind], "dark_current", np.abs(MAPS[kind]) / 100))
    assert "(e⁻/px/s)" in texts(figure)
    drawn(figure)


def test_a_map_of_more_pixels_than_an_image_can_show_has_every_odd_th_of_them() -> None:
    values = np.random.default_rng(3).normal(100.0, 4.0, (90, 1300))
    values[7, 9] = np.nan  # is not drawn, and counted all the same
    chart = chart_of(values)
    figure = draw_chart(Look(dpi=100), chart)  # 346 dots across
    axes = figure.axes[1]
    assert axes.images[0].get_array().shape == (30, 434)
    assert axes.get_xlim() == (-0.5, 1299.5)
    assert axes.get_ylim() == (89.5, -0.5)
    assert axes.images[0].get_extent() == pytest.approx([-0.5, 3 * 434 - 0.5, 89.5, -0.5])
    assert "no value: 1 pixel" in texts(figure)
    assert draw_chart(Look(dpi=600), chart).axes[1].images[0].get_array().shape == values.shape


@pytest.mark.parametrize("shape", [(12, 20), (1, 9), (8, 8), (60, 2)])
def test_fit_status_map_has_a_legend_of_words(shape: tuple[int, int]) -> None:
    status = np.zeros(shape, dtype=np.uint16)
    status[0, 0] = int(FitStatus.TOO_FEW_BINS)
    status[0, 1] = int(FitStatus.POOR_FIT | FitStatus.BIAS_AMBIGUOUS)
    figure = draw_chart(LOOK, status_chart(status, reasons_in(status)))
    words = texts(figure).replace("\n", " ")
    for bit in (FitStatus.TOO_FEW_BINS, FitStatus.POOR_FIT, FitStatus.BIAS_AMBIGUOUS):
        assert f"{MEANINGS[bit]}: 1" in words
    assert f"good fit: {status.size - 2}" in words
    drawn(figure)


def test_pixels_that_no_fit_has_reached_are_not_called_good_and_every_status_is_counted() -> None:
    status, missing = np.zeros((6, 8), dtype=np.uint16), np.zeros((6, 8), dtype=bool)
    missing[:2] = True
    words = texts(draw_chart(LOOK, status_chart(status, reasons_in(status), missing))).replace("\xa0", " ")
    assert "not fitted yet: 16 (33 %)" in words
    assert "good fit: 32 (67 %)" in words
    every = (1 << np.arange(16, dtype=np.uint16)).reshape(2, 8)
    rows = reasons_in(every)
    assert sum(n for _, _, n in rows) == 16
    drawn(draw_chart(LOOK, status_chart(every, rows)))


@pytest.fixture(scope="module")
def arrays() -> dict[str, np.ndarray]:
    return dict(report_data((12, 16)).ensemble)


RMSE = {"epcd_exact": 1.3e-4, "noise_floor": 1.2e-4, "nuced_exact": 2e-4}


@pytest.mark.parametrize("width", [COLUMN_MM, PAGE_MM])
def test_ensemble_shows_both_halves_with_rmse(arrays: dict[str, np.ndarray], width: float) -> None:
    figure = draw_chart(Look(width), ensemble_chart(ensemble_tables(arrays), RMSE, 250))
    words = texts(figure)
    for each in ("exact mean over pixels, RMSE 1.3×10⁻⁴", "sampling noise alone, RMSE 1.2×10⁻⁴"):
        assert each in words
    assert "raw data, 250 frames" in words
    drawn(figure)


def test_ensemble_with_parts_missing(arrays: dict[str, np.ndarray]) -> None:
    raw, nuced = (
        {name: arrays[name] for name in names}
        for names in (
            ("dn", "counts", "density"), ("electrons", "nuced_counts", "nuced_density", "nuced_exact")
        )
    )  # fmt: skip
    one = {"dn": np.array([100]), "counts": np.array([7]), "density": np.array([1.0])}
    for some in (raw, nuced, one):
        drawn(draw_chart(LOOK, ensemble_chart(ensemble_tables(some), {})))
    no_samples = {**raw, "epcd_exact": arrays["epcd_exact"], "counts": np.zeros_like(raw["counts"])}
    assert ensemble_tables({}) == ensemble_tables(no_samples) == ()


def test_electron_numbers(arrays: dict[str, np.ndarray]) -> None:
    names = ("k", "electron_mass", "electron_pmf", "electron_pmf_map", "electron_counts")
    k = arrays["k"]
    drawn(draw_chart(LOOK, electrons_chart(DataTable({name: arrays[name] for name in names}))))
    one = {"k": k[:1], "electron_mass": np.ones(1), "electron_pmf": np.ones(1)}
    drawn(draw_chart(LOOK, electrons_chart(DataTable(one))))
    none = {name: np.zeros(k.size) for name in names if name != "electron_pmf_map"} | {"k": k}
    drawn(draw_chart(LOOK, electrons_chart(DataTable(none))))


@pytest.mark.parametrize("width", [COLUMN_MM, PAGE_MM])
def test_component_widths(arrays: dict[str, np.ndarray], width: float) -> None:
    variance = arrays["component_variance"]
    table = component_table(variance, CASES, arrays["nuced_component_variance"])
    figure = draw_chart(Look(width), components_chart(table, ("none", "H, g")))
    assert "constant: H, g" in texts(figure)
    drawn(figure)
    drawn(draw_chart(LOOK, components_chart(component_table(variance[:1, :1], CASES[:1]))))
    drawn(draw_chart(LOOK, components_chart(component_table(np.zeros_like(variance), CASES))))


def test_drawing_leaves_the_users_settings_alone(pixel: PixelFit) -> None:
    with mpl.rc_context({"font.size": 31.0, "axes.facecolor": "red"}):
        before = dict(mpl.rcParams)
        figure = draw_chart(LOOK, pixels_chart([pixel]))
        drawing_bytes(figure, "svg")
        assert dict(mpl.rcParams) == before
        assert figure.axes[0].get_facecolor() != (1.0, 0.0, 0.0, 1.0)


def test_a_palette_does_not_change_a_map_visibly() -> None:
    full = drawing_bytes(draw_chart(LOOK, chart_of(HOLES)), "png", dpi=150)
    few = small_png(full)
    assert len(few) < len(full)
    before, after = (
        np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), dtype=float) for png in (full, few)
    )
    assert np.abs(before - after).mean() < 1.0
    assert np.abs(before - after).max() < 32


N, NY, NX = 400, 40, 48


def simulated(seed: int, moved=lambda dn: dn) -> StackSums:
    return sums_of(stack(np.random.default_rng(seed), (N, NY, NX), moved))


@pytest.fixture(scope="module")
def clean() -> StackSums:
    return simulated(11)


def test_independent_pixels_give_the_power_of_chance(clean: StackSums) -> None:
    power = power_table(clean)["power"]
    assert np.all(power > 0)
    # a frame's mean scatters as chance says: n - 1 degrees of freedom
    ratio = frame_table(clean)["mean"].var() / frame_table(clean)["expected error"][0] ** 2
    assert abs(ratio - 1.0) < 5.0 * np.sqrt(2.0 / N)
    for table in line_spectra(clean):
        each = table["power"]
        # means over N frames of squares that are exponential at each frequency but the last
        assert np.all(np.abs(each[:-1] - 1.0) < 5.0 / np.sqrt(N - 2))
    for table in pattern_spectra(clean):
        assert abs(table["power"].mean() - 1.0) < 5.0 / np.sqrt(table["power"].size)


@pytest.mark.parametrize(("line", "cycles"), [("row", 5), ("column", 6)])
def test_a_planted_wave_has_its_power_at_its_frequency(line: str, cycles: int) -> None:
    amplitude, length, across = 2.0, *((NY, NX) if line == "row" else (NX, NY))
    phase = np.random.default_rng(5).uniform(0.0, 2.0 * np.pi, (N, 1, 1))
    place = np.arange(length) * 2.0 * np.pi * cycles / length
    wave = amplitude * np.sin((place[:, None] if line == "row" else place) + phase)
    sums = simulated(12, lambda dn: dn + wave)
    table = next(each for each in line_spectra(sums) if each.part == f"noise_{line}")
    expected = 1.0 + across * length * amplitude**2 / 4.0 / float(np.mean(sums.variance))
    assert np.argmax(table["power"]) == cycles - 1
    assert table["frequency"][cycles - 1] == pytest.approx(cycles / length)
    height = table["power"][cycles - 1]
    assert height > 20.0
    if line == "row":  # columns are summed over groups of rows, each with less of it
        assert height == pytest.approx(expected, rel=5.0 * np.sqrt(2.0 / N))


def test_what_moves_in_time_and_what_repeats_in_space_is_seen() -> None:
    time = np.arange(N)[:, None, None]
    added = 0.5 * np.sin(2.0 * np.pi * 0.2 * time) + 5.0 * (np.arange(NX) % 8 == 0)
    sums = simulated(13, lambda dn: dn + added)
    spectrum = power_table(sums)
    assert spectrum["frequency"][np.argmax(spectrum["largest"])] == pytest.approx(0.2, rel=0.05)
    assert spectrum["largest"].max() > 100.0
    columns = profile_table(sums, 1)
    outside = columns["mean signal"] > columns["expected to"]
    assert outside[::8].all()
    assert outside.sum() < 12
    pattern = next(each for each in pattern_spectra(sums) if each.part == "pattern_column")
    assert pattern["power"][NX // 8 - 1] > 20.0
    # and a hot pixel leaves the pattern as it is
    spoiled = simulated(11, lambda dn: dn + 900.0 * ((np.arange(NY)[:, None] == 7) & (np.arange(NX) == 9)))
    assert max(table["power"].max() for table in pattern_spectra(spoiled)) < 20.0


def test_long_runs_are_averaged_and_figures_come_with_their_tables(clean: StackSums) -> None:
    long = replace(clean, numbers=np.arange(10 * N), all_means=np.tile(clean.all_means, 10))
    assert frame_table(long)["mean"].size == 1000
    assert frame_table(long)["mean"].mean() == pytest.approx(clean.frame_mean.mean())
    figures = stability_figures(clean)
    assert [figure.name for figure in figures] == ["frame_means", "profiles", "spatial_spectra"]
    for figure in figures:
        assert drawing_bytes(figure.draw(Look(figure.width_mm)), "png", dpi=50)
        assert all(csv_text(table).count("\n") > 5 for table in figure.tables)
        assert any(sign.isdigit() for sign in figure.alt)
    assert stability_figures(None) == []
    # a line of channels has what it can
    for figure in stability_figures(sums_of(stack(np.random.default_rng(3), (200, 1, 30)))):
        assert drawing_bytes(figure.draw(Look()), "png", dpi=50)
