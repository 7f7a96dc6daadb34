"""Means of frames, rows and columns and their spectra: what is planted stands there, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.quick_stacks import stack, sums_of

from pchem_pipeline.discrepancy.quick.sums import StackSums
from pchem_pipeline.report.figures.figure import csv_text
from pchem_pipeline.report.figures.stability import (
    frame_table,
    line_spectra,
    pattern_spectra,
    power_table,
    profile_table,
    stability_figures,
)
from pchem_pipeline.report.style.style import Look, drawing_bytes

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
    ratio = frame_table(clean)["mean"].var() / frame_table(clean)["error of chance"][0] ** 2
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
    rng = np.random.default_rng(5)
    phase = rng.uniform(0.0, 2.0 * np.pi, (N, 1, 1))
    place = np.arange(length) * 2.0 * np.pi * cycles / length

    def moved(dn: np.ndarray) -> np.ndarray:
        wave = amplitude * np.sin((place[:, None] if line == "row" else place) + phase)
        return dn + wave

    sums = simulated(12, moved)
    table = next(each for each in line_spectra(sums) if each.part == f"noise_{line}")
    expected = 1.0 + across * length * amplitude**2 / 4.0 / float(np.mean(sums.variance))
    assert np.argmax(table["power"]) == cycles - 1
    assert table["frequency"][cycles - 1] == pytest.approx(cycles / length)
    height = table["power"][cycles - 1]
    assert height > 20.0
    if line == "row":  # columns are summed over groups of rows, each with less of it
        assert height == pytest.approx(expected, rel=5.0 * np.sqrt(2.0 / N))


def test_what_moves_in_time_and_what_repeats_in_space_is_seen() -> None:
    def moved(dn: np.ndarray) -> np.ndarray:
        time = np.arange(N)[:, None, None]
        return dn + 0.5 * np.sin(2.0 * np.pi * 0.2 * time) + 5.0 * (np.arange(NX) % 8 == 0)

    sums = simulated(13, moved)
    spectrum = power_table(sums)
    assert spectrum["frequency"][np.argmax(spectrum["largest"])] == pytest.approx(0.2, rel=0.05)
    assert spectrum["largest"].max() > 100.0
    columns = profile_table(sums, 1)
    outside = columns["mean signal"] > columns["chance to"]
    assert outside[::8].all()
    assert outside.sum() < 12
    pattern = next(each for each in pattern_spectra(sums) if each.part == "pattern_column")
    assert pattern["power"][NX // 8 - 1] > 20.0


def test_hot_pixels_leave_the_pattern_as_it_is() -> None:
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


def test_a_line_of_channels_has_what_it_can(clean: StackSums) -> None:
    line = sums_of(stack(np.random.default_rng(3), (200, 1, 30)))

    for figure in stability_figures(line):
        assert drawing_bytes(figure.draw(Look()), "png", dpi=50)
