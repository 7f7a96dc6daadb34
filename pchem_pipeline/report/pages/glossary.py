"""The words of the report, explained: a list at its end, to which the words in its texts lead."""

from __future__ import annotations

import re
from dataclasses import dataclass

from markupsafe import Markup, escape


@dataclass(frozen=True)
class Term:
    """A word of the field: how it is written in texts, and what it means."""

    name: str
    meaning: str
    spellings: tuple[str, ...] = ()

    @property
    def id(self) -> str:
        """Anchor of the entry."""
        return "term-" + re.sub(r"\W+", "-", self.name.lower()).strip("-")


#: In the order of the list.
GLOSSARY: tuple[Term, ...] = (
    Term(
        "bias",
        "The digital number (DN) at zero electrons, μ; also called offset or black level. Its spread between "
        "pixels is a fixed-pattern noise.",
    ),
    Term(
        "charge rate",
        "Quanta exposure divided by integration time, electrons per pixel and second, whatever the source.",
    ),
    Term(
        "conversion gain",
        "Electrons per digital number, g (e⁻/DN). EMVA 1288 gives the inverse, the overall system gain "
        "K = 1/g (DN/e⁻).",
    ),
    Term(
        "dark current",
        "Charge rate in the dark, electrons per pixel and second; only for frames with input.kind: dark.",
    ),
    Term("DN", "Digital number, the unit of raw data; also called ADU, count or LSB."),
    Term(
        "DSNU",
        "Dark signal non-uniformity: spread between pixels of the mean dark signal. EMVA 1288 takes the "
        "standard deviation of averaged dark frames, in e⁻.",
        ("dark signal non-uniformity",),
    ),
    Term(
        "ensemble",
        "All values of all pixels in one histogram, as if the sensor were one pixel measured many times.",
    ),
    Term(
        "fixed-pattern noise",
        "Pattern that is the same in every frame: differences of bias (DSNU), dark current and gain between "
        "pixels, rows and columns.",
        ("fixed pattern",),
    ),
    Term(
        "flagged",
        "A pixel whose values the data do not fix, for example by one electron: the true errors are larger "
        "than quoted. Flagged pixels are excluded from medians.",
    ),
    Term(
        "gap",
        "Kullback-Leibler divergence of the model from the data, on frames not used in the fit. More data do "
        "not change it, but lower its floor (the value from sampling noise alone).",
        ("floor",),
    ),
    Term(
        "hot pixels",
        "Pixels with far more charge than the others: H above its median by more than maps.outlier_sigmas "
        "robust standard deviations. EMVA 1288 leaves the limit to the application.",
        ("hot pixel",),
    ),
    Term(
        "micronat",
        "10⁻⁶ nat, the unit of the gap. N samples with a gap of G nats each have a likelihood ratio of "
        "exp(N G) between data and model: a factor e for a million samples with 1 micronat.",
        ("micronats",),
    ),
    Term(
        "misfit",
        "A pixel whose histogram the fitted density does not describe, at a given false-discovery rate.",
        ("misfits",),
    ),
    Term(
        "non-uniformity of the gain",
        "Standard deviation of the conversion gain between pixels, relative to its mean. PRNU of EMVA 1288 "
        "combines gain and sensitivity, measured under light.",
    ),
    Term(
        "NUCed",
        "After non-uniformity correction: each value minus its pixel's bias, times its gain, in electrons.",
        ("non-uniformity correction",),
    ),
    Term(
        "PCD",
        "Photon counting distribution: a Poisson number of electrons with mean H, converted with gain g, on "
        "top of the bias μ, with Gaussian read noise σ.",
        ("photon counting distribution",),
    ),
    Term(
        "placebo",
        "Control: the best fit of an unrelated effect. A wrong effect can close as much of the gap.",
        ("control",),
    ),
    Term(
        "PRNU",
        "Photo response non-uniformity: standard deviation of the response to light between pixels, relative "
        "to its mean. Here computed from H under light; EMVA 1288 measures at half saturation.",
        ("photo response non-uniformity",),
    ),
    Term("quanta exposure", "Mean number of electrons per pixel and frame, H (e⁻)."),
    Term(
        "read noise",
        "Standard deviation that the readout adds to a pixel's signal, σ in DN or σ·g in e⁻, quantisation "
        "included. Excludes dark shot noise, which the temporal dark noise of EMVA 1288 includes.",
    ),
    Term(
        "readout and charge",
        "Each sample is split by its pixel's fit into the expected number of electrons (charge) and the "
        "remainder (readout). Effects of light appear in charge, effects of the electronics in readout.",
        ("readout residuals", "readout channel", "charge channel"),
    ),
    Term(
        "replicate",
        "A stack simulated from the fitted model and analysed like the data; gives the sampling noise.",
        ("replicates",),
    ),
    Term(
        "RMSE",
        "Root mean square difference between predicted and measured density of the ensemble; not 0 even for "
        "a perfect model, because of sampling noise.",
    ),
    Term(
        "sigma",
        "Standard deviation of an estimate, or of a statistic between stacks simulated from the fitted "
        "model. The largest of a hundred statistics is near 3 sigma by chance.",
        ("sd",),
    ),
    Term(
        "standard error",
        "1 sigma error of an estimate, from the curvature of the likelihood.",
        ("standard errors",),
    ),
    Term(
        "temporal dark noise",
        "Standard deviation of a pixel's dark signal from frame to frame (EMVA 1288: σ_d, σ_y.dark), shot "
        "noise of the dark current included.",
    ),
)  # fmt: skip

_BY_SPELLING = {spelling.lower(): term for term in GLOSSARY for spelling in (term.name, *term.spellings)}
_WORDS = "|".join(re.escape(word) for word in sorted(_BY_SPELLING, key=len, reverse=True))
_ANY = re.compile(rf"(?<![\w-])(?:{_WORDS})(?![\w-])", re.IGNORECASE)


def explained(text: str) -> Markup:
    """Return a text as HTML in which the first of each word of the glossary leads to its entry."""
    seen = set()

    def link(found: re.Match[str]) -> str:
        term = _BY_SPELLING[found[0].lower()]
        if term.id in seen:
            return found[0]
        seen.add(term.id)
        return f'<a class="term" href="#{term.id}">{found[0]}</a>'

    return Markup(_ANY.sub(link, str(escape(text))))
