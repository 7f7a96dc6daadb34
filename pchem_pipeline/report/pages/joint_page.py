"""The report of a joint fit: one page, drawn and laid out as the report of a run."""

from __future__ import annotations

import numpy as np

from pchem_pipeline.report.figures.exhibits import Exhibit, drawing
from pchem_pipeline.report.figures.joint_figures import exposure_figure, photon_transfer
from pchem_pipeline.report.figures.map_figures import fit_status_map, map_and_histogram, status_counts
from pchem_pipeline.report.inspector.inspector import content_policy
from pchem_pipeline.report.pages.captions import MAP_READING
from pchem_pipeline.report.pages.joint_data import AXES, JointData, middle
from pchem_pipeline.report.pages.report import RenderedReport, template
from pchem_pipeline.report.pages.sections import Section
from pchem_pipeline.report.pages.tables import Table
from pchem_pipeline.report.settings import ReportSettings
from pchem_pipeline.report.style.pictures import DrawAll, Picture, draw_picture, longest_first, ready_picture
from pchem_pipeline.report.style.ranges import finite
from pchem_pipeline.report.style.wording import count, measured, percent, short, symbol

__all__ = ["JOINT_EXHIBIT_NAMES", "joint_exhibits", "render_joint"]

_MAPS = (
    "conversion_gain",
    "read_noise_e",
    "bias",
    "dark_current",
    "charge_per_level",
    "spurious_charge",
)
JOINT_EXHIBIT_NAMES = ("exposures", "photon_transfer", *(f"map_{name}" for name in _MAPS), "fit_status")

_INTRO = {
    "line": "Each exposure has its own H in the joint fit; what grows with {against} is the {noun}, and "
    "what does not is spurious charge (or a bias stack that holds electrons). The exposures of a pixel share "
    "the errors of its gain and bias, which the line takes into account.",
    "none": "The samples share g, mu and sigma; no line was asked for (joint.against: none).",
    "photon-transfer": "The same data as moments: where the points leave the curve, the sensor is not linear "
    "or the samples are not of one gain.",
    "maps": "Shared by all samples of a pixel.",
    "status": "A pixel that one exposure cannot determine may still be good here.",
}


def joint_exhibits(data: JointData, settings: ReportSettings) -> list[Exhibit]:
    """Return the figures of a joint fit, in their order."""
    found: list[Exhibit] = []
    if not any(finite(values).size for values in data.maps.values()):
        return [_status(data)]
    if data.against != "none":
        found.append(_exposures(data))
    found.append(
        Exhibit(
            "photon_transfer",
            "photon-transfer",
            "Variance against mean",
            "Medians over the pixels; the curve is that of the joint fit with its median parameters, drawn "
            "before the points and not through them.",
            "Variance against mean above the bias: "
            + "; ".join(
                f"{sample.name} {short(middle(values)[0])} DN²"
                for sample, values in zip(data.samples, data.joint["variance"], strict=True)
            ),
            drawing(photon_transfer, data),
        )
    )
    for name in _MAPS:
        if name in data.maps and finite(data.maps[name]).size:
            found.append(_map(data, name, settings))
    return [*found, _status(data)]


def _exposures(data: JointData) -> Exhibit:
    words, _, noun = AXES[data.against]
    name = "dark_current" if data.against == "integration_time" else "charge_per_level"
    slope, error, _, _ = middle(data.maps[name])
    return Exhibit(
        "exposures",
        "exposures",
        f"{noun.capitalize()} as the slope of H",
        f"Quanta exposure against {words} with the median line of the pixels; below, the median "
        "residual with its standard error.",
        f"Exposures on a line; median {noun} {measured(slope, error, symbol(name)[2])}.",
        drawing(exposure_figure, data),
    )


def _map(data: JointData, name: str, settings: ReportSettings) -> Exhibit:
    _, words, unit = symbol(name)
    centre, error, _, _ = middle(data.maps[name])
    return Exhibit(
        f"map_{name}",
        "maps",
        words.capitalize(),
        f"Map and histogram of the {words}.",
        f"Median {measured(centre, error, unit)}.",
        drawing(
            map_and_histogram,
            data.maps[name],
            name,
            stderr=data.maps.get(f"{name}_stderr"),
            stretch=settings.map_stretch,
            bins=settings.histogram_bins,
        ),
        raster=True,
    )


def _status(data: JointData) -> Exhibit:
    status = data.joint["fit_status"]
    good = int((status == 0).sum())
    return Exhibit(
        "fit_status",
        "status",
        "Fit status",
        "Where the joint fit failed or deserves caution.",
        f"{percent(good, status.size)} of the pixels have a good fit.",
        drawing(fit_status_map, status, dict(data.status_words)),
        raster=True,
    )


def render_joint(
    data: JointData, settings: ReportSettings | None = None, draw: DrawAll | None = None
) -> RenderedReport:
    """Draw everything and return the files of the report of a joint fit; nothing is written.

    Args:
        data: what was found.
        settings: section ``report``; None for the defaults.
        draw: draws all figures at once; None: one after the other, here.
    """
    settings = settings or ReportSettings()
    figures: dict[str, bytes] = {}
    shown = joint_exhibits(data, settings)
    drawn = {} if draw is None else draw(longest_first(shown), settings)

    def picture(exhibit: Exhibit) -> Picture:
        if exhibit.name in drawn:
            return ready_picture(exhibit, drawn[exhibit.name], figures)
        return draw_picture(exhibit, settings, figures)

    page = template("report.html.j2").render(
        title=data.title,
        data=data,
        flag_words={},
        flag_signs={},
        inspector=None,
        policy=content_policy(None),
        sections=_sections(data, settings, [picture(exhibit) for exhibit in shown]),
    )
    return RenderedReport(page, "", figures)


def _sections(data: JointData, settings: ReportSettings, pictures: list[Picture]) -> list[Section]:
    reading = "channels" if min(data.shape) < 2 else settings.map_stretch
    words, _, noun = AXES.get(data.against, ("", "", ""))
    line = _INTRO["line"].format(against=words, noun=noun) if words else _INTRO["none"]
    rows: tuple[tuple[str, str, str, list[Table]], ...] = (
        ("exposures", "Exposures", line, [_samples_table(data)]),
        ("photon-transfer", "Photon transfer", _INTRO["photon-transfer"], []),
        ("maps", "Parameter maps", f"{_INTRO['maps']} {MAP_READING[reading]}", []),
        ("status", "Fit status", _INTRO["status"], [_status_table(data)]),
    )
    found = [_summary(data)]
    for id_, title, intro, tables in rows:
        own = [picture for picture in pictures if picture.exhibit.section == id_]
        missing = [] if own or tables else ["no pixel has a value."]
        content = {"intro": intro, "missing": missing, "pictures": own, "tables": tables}
        found.append(Section(id_, title, "figures", content))
    found.append(Section("configuration", "Configuration", "text", {"text": data.settings}))
    return found


def _summary(data: JointData) -> Section:
    status = data.joint["fit_status"]
    good, failed = int((status == 0).sum()), int(((status & data.failed_mask) != 0).sum())
    noun = count(len(data.samples), "sample")
    intro = (
        f"{noun} of the same {count(status.size, 'pixel')} fitted together with one conversion gain, bias "
        f"and read noise for each pixel: {percent(good, status.size)} of the pixels have a good fit, "
        f"{percent(failed, status.size)} no value."
    )
    content = {"intro": intro, "missing": list(data.notes), "pictures": [], "tables": [_parameters(data)]}
    return Section("summary", "What the exposures tell together", "figures", content)


def _parameters(data: JointData) -> Table:
    rows = []
    for name in ("conversion_gain", "read_noise_e", "read_noise_dn", *_MAPS[2:]):
        if name not in data.maps:
            continue
        _, words, unit = symbol(name)
        centre, error, low, high = middle(data.maps[name])
        own = finite(data.maps[f"{name}_stderr"])
        each = short(float(np.median(own)), 2) if own.size else "not known"
        rows.append((f"{words} ({unit})", measured(centre, error), f"{short(low)} to {short(high)}", each))
    if "linearity_p" in data.joint:
        p = finite(data.joint["linearity_p"])
        if p.size:
            share = percent(int((p < 0.01).sum()), p.size)
            rows.append(("pixels off the line (p < 0.01; 1 % by chance)", share, "", ""))
    return Table(
        "parameters",
        "Parameters",
        "Median over the pixels with its standard error, the range of the middle 68 % of them, and the "
        "median standard error of one pixel.",
        ("parameter", "median", "16 to 84 %", "error of a pixel"),
        tuple(rows),
        "summary",
    )


def _samples_table(data: JointData) -> Table:
    words = AXES.get(data.against, ("", "", ""))
    head = f"{words[0]} ({words[1]})" if words[1] else words[0] or "exposure"
    rows = []
    for i, sample in enumerate(data.samples):
        centre, error, _, _ = middle(data.joint["quanta_exposure"][i])
        exposure = "0 (bias)" if sample.kind == "bias" else measured(centre, error)
        rest, rest_error, _, _ = (
            middle(data.joint["linearity_residual"][i])
            if "linearity_residual" in data.joint
            else (np.nan,) * 4
        )
        residual = measured(rest, rest_error) if sample.x is not None and len(data.on_line) > 2 else "–"
        share = f"{100.0 * rest / centre:+.2f} %".replace("-", "−") if residual != "–" and centre > 0 else "–"
        x = "–" if sample.x is None else f"{sample.x:g}"
        rows.append((sample.name, x, f"{sample.n_frames:,}", exposure, residual, share))
    return Table(
        "samples",
        "Samples",
        "Medians over the pixels, with their standard errors.",
        ("sample", head, "frames", "H (e⁻)", "residual (e⁻)", "residual / H"),
        tuple(rows),
        "exposures",
    )


def _status_table(data: JointData) -> Table:
    status = data.joint["fit_status"]
    rows = [("good fit", f"{int((status == 0).sum()):,}", percent(int((status == 0).sum()), status.size))]
    rows += [
        (text, f"{n:,}", percent(n, status.size)) for _, text, n in status_counts(status, data.status_words)
    ]
    head = ("outcome", "pixels", "share")
    return Table(
        "failures", "Outcomes", "A pixel with several reasons counts for each.", head, tuple(rows), "status"
    )
