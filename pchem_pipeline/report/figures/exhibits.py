"""The figures of a report with their titles, captions and alternative texts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from matplotlib.figure import Figure

from pchem_pipeline.model.electrons.electrons import thresholds
from pchem_pipeline.model.maps.maps import summarise
from pchem_pipeline.report.data import MAP_NAMES, PixelFit, ReportData
from pchem_pipeline.report.figures import (
    ensemble_figures,
    map_figures,
    pixel_figures,
    rounding_figures,
    trust_figures,
)
from pchem_pipeline.report.pages.captions import CAPTIONS, highlighted_cases
from pchem_pipeline.report.settings import ReportSettings
from pchem_pipeline.report.style.ranges import finite
from pchem_pipeline.report.style.style import COLUMN_MM, PAGE_MM
from pchem_pipeline.report.style.wording import count, measured, percent, scientific, short, symbol

__all__ = ["EXHIBIT_NAMES", "UNCERTAIN", "Drawing", "Exhibit", "drawing", "exhibits"]

#: Names of all figures that a report can have, in their order.
EXHIBIT_NAMES = (
    "cluster_edges_example",
    "cluster_edges_pixel",
    "pixel_fits",
    "goodness",
    "worst_pixels",
    "left_out",
    "read_noise_histogram",
    *(f"map_{name}" for name in MAP_NAMES),
    "ensemble",
    "electron_numbers",
    "component_widths",
    "uncertainty",
    "rounding",
    "fit_status",
)

#: Maps of which the figure of uncertainties tells the share of noise.
UNCERTAIN = ("quanta_exposure", "conversion_gain", "bias", "read_noise_dn", "read_noise_e")


@dataclass(frozen=True)
class Exhibit:
    """One figure of the report.

    Attributes:
        name: name of its files.
        section: id of the section that shows it.
        title: heading in the report.
        caption: what is drawn and how to read it.
        alt: what a reader who does not see it should know, with the numbers.
        draw: makes the figure at a width in mm.
        width_mm: width at which it is saved.
        raster: embed it as PNG (images of many pixels) instead of SVG.
    """

    name: str
    section: str
    title: str
    caption: str
    alt: str
    draw: Callable[[float], Figure]
    width_mm: float = COLUMN_MM
    raster: bool = False


def exhibits(data: ReportData, settings: ReportSettings) -> list[Exhibit]:
    """Return the figures that the data allow, in the order of the report."""
    makers = (
        _cells, _pixels, _goodness, _left_out, _read_noise, _maps, _ensemble, _electrons, _components,
        _uncertainty, _rounding, _status,
    )  # fmt: skip
    return [exhibit for make in makers for exhibit in make(data, settings)]


@dataclass(frozen=True)
class Drawing:
    """A drawing that waits only for its width; another process can be sent it."""

    call: Callable[..., Figure]

    def __call__(self, width_mm: float) -> Figure:
        """Draw it at a width in mm."""
        return self.call(width_mm=width_mm)


def drawing(draw: Callable[..., Figure], *args: object, **kwargs: object) -> Drawing:
    """Return the drawing of a function of a module with these arguments, all but its width."""
    return Drawing(partial(draw, *args, **kwargs))


def _edges_text(parameters: Mapping[str, float]) -> str:
    exposure, gain, bias, sigma = (parameters[name] for name in pixel_figures.PAPER_EXAMPLE)
    edges = thresholds(exposure, gain, bias, sigma, 4)
    return ", ".join(short(float(edge), 4) for edge in edges if np.isfinite(edge))


def _cells(data: ReportData, _: ReportSettings) -> list[Exhibit]:
    example = dict(pixel_figures.PAPER_EXAMPLE)
    found = [
        Exhibit(
            "cluster_edges_example",
            "cells",
            "Example: H = 1.8 e⁻, read noise 0.33 e⁻",
            CAPTIONS["cluster_edges_example"],
            "Density of a PCD with peaks at 0, 1, 2, … electrons and the first four cell edges at "
            f"{_edges_text(example)} e⁻.",
            drawing(pixel_figures.cluster_edges, example),
        )
    ]
    fitted = [pixel for pixel in data.pixels if pixel_figures.has_fit(pixel.parameters)]
    if fitted:
        pixel = fitted[0]
        found.append(
            Exhibit(
                "cluster_edges_pixel",
                "cells",
                f"{pixel.place.capitalize()} of this run",
                CAPTIONS["cluster_edges_pixel"],
                f"Histogram and density of {pixel.place}; first cell edges at "
                f"{_edges_text(pixel.parameters)} DN.",
                drawing(
                    pixel_figures.cluster_edges,
                    dict(pixel.parameters),
                    counts=pixel.counts,
                    origin=pixel.origin,
                ),
            )
        )
    return found


def _value_text(pixel: PixelFit, name: str) -> str:
    _, words, unit = symbol(name)
    nan = float("nan")
    return f"{words} {measured(pixel.parameters.get(name, nan), pixel.stderr.get(name, nan), unit)}"


def _pixels(data: ReportData, _: ReportSettings) -> list[Exhibit]:
    if not data.pixels:
        return []
    words = []
    for pixel in data.pixels:
        names = ("quanta_exposure", "conversion_gain", "bias", "read_noise_e")
        numbers = ", ".join(_value_text(pixel, name) for name in names)
        state = f" ({pixel.status})" if pixel.status else ""
        words.append(f"{pixel.label} {pixel.place}: {numbers}{state}".strip())
    return [
        Exhibit(
            "pixel_fits",
            "pixels",
            "Histograms of single pixels with their fits",
            CAPTIONS["pixel_fits"],
            "Histograms with fitted densities. " + "; ".join(words) + ".",
            drawing(pixel_figures.pixel_fits, data.pixels),
            PAGE_MM if len(data.pixels) > 1 else COLUMN_MM,
        )
    ]


def _goodness(data: ReportData, _: ReportSettings) -> list[Exhibit]:
    names = [f"goodness_{part}" for part in ("p", "chi2", "dof", "q")]
    if not data.misfits or any(name not in data.fit for name in names):
        return []
    facts = data.misfits
    text = (
        f"p-values and misfit of {count(int(facts['tested']), data.noun)}; "
        f"{count(int(facts['misfits']), 'misfit')} at a rate of false discoveries of "
        f"{facts['false_discovery_rate']:g}."
    )
    found = [
        Exhibit(
            "goodness",
            "goodness",
            "Goodness of fit of all pixels",
            CAPTIONS["goodness"].format(rate=facts["false_discovery_rate"]),
            text,
            drawing(
                trust_figures.goodness,
                {name: data.fit[name] for name in names},
                float(facts["false_discovery_rate"]),
            ),
            PAGE_MM,
            raster=not map_figures.is_strip(data.shape),
        )
    ]
    if data.worst:
        places = ", ".join(pixel.place for pixel in data.worst)
        found.append(
            Exhibit(
                "worst_pixels",
                "goodness",
                "Pixels of the poorest fit",
                CAPTIONS["worst_pixels"],
                f"Histograms with fitted densities and residuals: {places}.",
                drawing(pixel_figures.pixel_fits, data.worst),
                PAGE_MM if len(data.worst) > 1 else COLUMN_MM,
            )
        )
    return found


def _left_out(data: ReportData, _: ReportSettings) -> list[Exhibit]:
    share = data.fit.get("outlier_share")
    if share is None or not data.misfits.get("tail_guard"):
        return []
    hit = int((share > 0).sum())
    return [
        Exhibit(
            "left_out",
            "goodness",
            "Samples left out of the fit",
            CAPTIONS["left_out"].format(floor=data.misfits["tail_guard"]),
            f"{count(hit, data.noun)} of {share.size:,} lost samples, at most "
            f"{percent(float(np.max(share, initial=0.0)), 1.0)} of their frames.",
            drawing(trust_figures.left_out, share, data.n_frames),
            PAGE_MM,
            raster=not map_figures.is_strip(data.shape),
        )
    ]


def _uncertainty(data: ReportData, _: ReportSettings) -> list[Exhibit]:
    shares = trust_figures.noise_shares(data.maps, UNCERTAIN)
    if not shares or "epcd_exact" not in data.ensemble:
        return []
    words = ", ".join(f"{symbol(name)[1]} {percent(min(value, 1.0), 1.0)}" for name, value in shares.items())
    return [
        Exhibit(
            "uncertainty",
            "uncertainty",
            "Noise in the maps and in the prediction",
            CAPTIONS["uncertainty"],
            f"Part of the variance of the maps that is noise of the estimates: {words}.",
            drawing(trust_figures.uncertainty, shares, data.ensemble),
            PAGE_MM,
        )
    ]


def _rounding(data: ReportData, _: ReportSettings) -> list[Exhibit]:
    curves = rounding_figures.rounding_curves(data.maps, data.n_frames)
    if not curves or not data.has_values("conversion_gain"):
        return []
    step = 1.0 / float(np.median(finite(data.maps["conversion_gain"])))
    known = {name: values for name, values in curves.items() if name != "step"}
    words = [
        f"{name} {short(float(np.interp(step, curves['step'], values)), 2)}" for name, values in known.items()
    ]
    return [
        Exhibit(
            "rounding",
            "uncertainty",
            "Bias by rounding to whole DN",
            CAPTIONS["rounding"],
            f"At {short(step)} DN per electron, in standard errors of a pixel: {', '.join(words)}.",
            drawing(rounding_figures.rounding, curves, data.maps["conversion_gain"]),
        )
    ]


def _map_alt(data: ReportData, name: str, what: str) -> str:
    _, words, unit = symbol(name)
    summary = summarise(data.maps[name], percentiles=(5.0, 95.0), outlier_sigmas=data.outlier_sigmas)
    low, high = summary.percentiles[5.0], summary.percentiles[95.0]
    return (
        f"{what} of the {words}: median {measured(summary.median, summary.median_stderr, unit)}, "
        f"5 to 95 % of the {data.noun}s from {short(low)} to {short(high)} {unit}, "
        f"extremes {short(summary.minimum)} and {short(summary.maximum)} {unit}; "
        f"{count(summary.n_missing, data.noun)} without a value."
    )


def _read_noise(data: ReportData, settings: ReportSettings) -> list[Exhibit]:
    # a line of few channels is shown channel by channel, with the maps
    if not data.has_values("read_noise_e") or data.few_channels:
        return []
    known = finite(data.maps["read_noise_e"])
    below = percent(float((known < 0.4).sum()), known.size)
    return [
        Exhibit(
            "read_noise_histogram",
            "read-noise",
            "Read noise of the pixels",
            CAPTIONS["read_noise_histogram"].format(below=below, noun=data.noun),
            _map_alt(data, "read_noise_e", "Histogram")
            + f" {below} of the {data.noun}s with a value lie below 0.4 e⁻.",
            drawing(
                map_figures.read_noise_histogram, data.maps["read_noise_e"], bins=settings.histogram_bins
            ),
        )
    ]


def _maps(data: ReportData, settings: ReportSettings) -> list[Exhibit]:
    found = []
    for name in MAP_NAMES:
        if not data.has_values(name):
            continue
        strip = map_figures.is_strip(data.maps[name].shape)
        found.append(
            Exhibit(
                f"map_{name}",
                "maps",
                symbol(name)[1].capitalize(),
                CAPTIONS[f"map_{name}"],
                _map_alt(data, name, "Values of the channels" if strip else "Histogram and map"),
                drawing(
                    map_figures.map_and_histogram,
                    data.maps[name],
                    name,
                    stderr=data.maps.get(f"{name}_stderr"),
                    stretch=settings.map_stretch,
                    bins=settings.histogram_bins,
                ),
                raster=not strip,
            )
        )
    return found


def _ensemble(data: ReportData, _: ReportSettings) -> list[Exhibit]:
    if "density" not in data.ensemble and "nuced_density" not in data.ensemble:
        return []
    rmse = dict(data.ensemble_facts.get("rmse", {}))
    numbers = ", ".join(f"{name.replace('_', ' ')} {scientific(value)}" for name, value in rmse.items())
    return [
        Exhibit(
            "ensemble",
            "ensemble",
            "Ensemble histogram and its prediction",
            CAPTIONS["ensemble"],
            "Ensemble histogram before and after non-uniformity correction with predictions. "
            f"RMSE: {numbers}.",
            drawing(
                ensemble_figures.ensemble, data.ensemble, rmse, n_frames=data.ensemble_facts.get("n_frames")
            ),
            PAGE_MM,
        )
    ]


def _electrons(data: ReportData, _: ReportSettings) -> list[Exhibit]:
    arrays = data.ensemble
    if "electron_mass" not in arrays:
        return []
    mass, pmf = arrays["electron_mass"], arrays["electron_pmf"]
    first = ", ".join(f"k = {k}: {mass[k]:.4f} against {pmf[k]:.4f}" for k in range(min(5, mass.size)))
    return [
        Exhibit(
            "electron_numbers",
            "electrons",
            "Estimated electron numbers",
            CAPTIONS["electron_numbers"],
            f"Share of each electron number among the estimates against the prediction; {first}.",
            drawing(
                ensemble_figures.electron_numbers,
                arrays["k"],
                mass,
                pmf,
                pmf_map=arrays.get("electron_pmf_map"),
                counts=arrays.get("electron_counts"),
            ),
        )
    ]


def _components(data: ReportData, _: ReportSettings) -> list[Exhibit]:
    variance = data.ensemble.get("component_variance")
    if variance is None or variance.size == 0:
        return []
    cases: Sequence[str] = data.component_cases or [f"case {i}" for i in range(variance.shape[0])]
    width = np.sqrt(np.maximum(variance[0], 0.0))
    return [
        Exhibit(
            "component_widths",
            "components",
            "Width of the components of the ensemble",
            CAPTIONS["component_widths"],
            "Standard deviation of the ensemble's component k, nothing held constant: "
            f"{short(float(width[0]))} DN at k = 0, "
            f"{short(float(width[-1]))} DN at k = {variance.shape[1] - 1}.",
            drawing(
                ensemble_figures.component_widths,
                np.arange(variance.shape[1]),
                variance,
                cases,
                nuced_variance=data.ensemble.get("nuced_component_variance"),
                highlight=highlighted_cases(cases),
            ),
            PAGE_MM,
        )
    ]


def _status(data: ReportData, _: ReportSettings) -> list[Exhibit]:
    status = data.fit.get("fit_status")
    if status is None:
        return []
    rows = map_figures.status_counts(status, data.status_words)
    parts = [f"{count(int(((status == 0) & ~data.unfitted).sum()), data.noun)} with a good fit"]
    parts += [f"{count(n, data.noun)}: {text}" for _, text, n in rows]
    return [
        Exhibit(
            "fit_status",
            "status",
            "Fit status of the pixels",
            CAPTIONS["fit_status"],
            "Map of the fit status. " + "; ".join(parts) + ".",
            drawing(map_figures.fit_status_map, status, data.status_words, unfitted=data.unfitted),
            raster=not map_figures.is_strip(status.shape),
        )
    ]
