"""How to describe a run in a paper, and what to cite: words with its numbers, versions, BibTeX."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata

import numpy as np

from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.pages.summary import pixel_counts
from pchem_pipeline.report.style.ranges import finite
from pchem_pipeline.report.style.wording import count, measured, percent, symbol


@dataclass(frozen=True)
class Paper:
    """A paper: key, how the text names it, and its BibTeX."""

    key: str
    short: str
    bibtex: str


_VERIFICATION = Paper(
    "Hendrickson2023",
    "Hendrickson et al. 2023, arXiv:2302.14654",
    """@article{Hendrickson2023,
  author  = {Hendrickson, Aaron and Haefner, David P. and Shade, Nicholas R. and Fossum, Eric R.},
  title   = {Experimental Verification of {PCH-EM} Algorithm for Characterizing {DSERN} Image Sensors},
  journal = {arXiv preprint arXiv:2302.14654},
  year    = {2023}
}""",
)
_SEVERAL = Paper(
    "Hendrickson2024",
    "Hendrickson et al. 2024, arXiv:2403.04498",
    """@article{Hendrickson2024,
  author  = {Hendrickson, Aaron J. and Haefner, David P. and Chan, Stanley H. and Shade, Nicholas R. and
             Fossum, Eric R.},
  title   = {{PCH-EM}: A Solution to Information Loss in the Photon Transfer Method},
  journal = {arXiv preprint arXiv:2403.04498},
  year    = {2024}
}""",
)


@dataclass(frozen=True)
class Citation:
    """A paragraph of methods and the entries of a bibliography."""

    text: str
    bibtex: str


def citation(data: ReportData) -> Citation:
    """Return what a paper would say of this run, its numbers filled in."""
    versions = data.run.get("versions")
    known: Mapping[str, str] = versions if isinstance(versions, Mapping) else {}
    version = known.get("pchem-pipeline") or metadata.version("pchem-pipeline")
    papers = [_VERIFICATION, *([_SEVERAL] if data.samples is not None else [])]
    sentences = [_data_sentence(data), _method_sentence(data, papers), _result_sentence(data), _quality(data)]
    libraries = ", ".join(f"{name} {known[name]}" for name in ("numpy", "numba") if name in known)
    used = f" with {libraries}" if libraries else ""
    sentences.append(f"The analysis was made with pchem_pipeline {version}{used}.")
    digest = data.run.get("digest of the input")
    if digest:
        sentences.append(f"Digest of the input: {digest}.")
    software = f"""@software{{pchem_pipeline,
  title   = {{pchem\\_pipeline}},
  version = {{{version}}}
}}"""
    return Citation(" ".join(filter(None, sentences)), "\n\n".join([*(p.bibtex for p in papers), software]))


def _data_sentence(data: ReportData) -> str:
    if data.shape[0] == 1:
        return f"The histograms of {count(data.shape[1], 'channel')} were analysed one by one."
    frames = f"{count(data.n_frames, 'frame')} of " if data.n_frames else ""
    time = f" at an integration time of {data.integration_time:g} s" if data.integration_time else ""
    if data.samples is not None:
        several = count(len(data.samples.samples), "sample")
        return (
            f"{several} of {data.shape[0]} × {data.shape[1]} pixels were analysed together, pixel by pixel."
        )
    return f"{frames}{data.shape[0]} × {data.shape[1]} pixels{time} were analysed pixel by pixel."


def _method_sentence(data: ReportData, papers: list[Paper]) -> str:
    model = f"the model {data.run['model']}" if "model" in data.run else "the photon counting distribution"
    text = (
        "Quanta exposure H, conversion gain g, bias μ and read noise σ of each were estimated by maximum "
        f"likelihood under {model} (PCH-EM; {'; '.join(paper.short for paper in papers)})"
    )
    return f"{text}, with standard errors from the information of the likelihood."


def _result_sentence(data: ReportData) -> str:
    pixels, flagged = pixel_counts(data), int(data.flagged.sum())
    if pixels.fitted == 0:
        return f"No {data.noun} could be fitted."
    counts = f"{pixels.fitted:,} of {count(pixels.total, data.noun)} have a value"
    if flagged:
        share = percent(flagged, pixels.fitted)
        counts += f"; {flagged:,} of them ({share}) are flagged: the data do not fix their electron number"
    if data.mostly_flagged:
        return f"{counts}; no medians can be given."
    parts = []
    for name in ("read_noise_e", "conversion_gain", "charge_rate", "dark_current"):
        if data.has_median(name):
            summary = data.summary(name)
            _, words, unit = symbol(name)
            value = measured(summary.median, summary.median_stderr, unit)
            parts.append(
                f"{words} {value} (robust spread between {data.noun}s {summary.robust_sd:.2g} {unit})"
            )
    left = "the others" if flagged else f"the {data.noun}s"
    return f"{counts}. Medians over {left}: {'; '.join(parts)}."


def _quality(data: ReportData) -> str:
    p = finite(data.fit.get("goodness_p", np.empty(0)))
    if not p.size:
        return ""
    return (
        f"{percent(int((p < 1e-3).sum()), p.size)} of the fits fail the chi-square test (p < 0.001; "
        "0.10 % expected)."
    )
