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
        "Quanta exposure over integration time, electrons per pixel and second, whatever made the charge.",
    ),
    Term(
        "conversion gain",
        "Electrons per digital number, g (e⁻/DN). EMVA 1288 gives the inverse, the overall system gain "
        "K = 1/g (DN/e⁻).",
    ),
    Term(
        "dark current",
        "Charge rate in the dark, electrons per pixel and second; called so only where the frames were dark "
        "(input.kind).",
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
        "What is the same in every frame: differences of bias (DSNU), dark current and gain between pixels, "
        "rows and columns.",
        ("fixed pattern",),
    ),
    Term(
        "flagged",
        "A pixel whose values the data leave open, for example by one electron: its standard errors say too "
        "little. Flagged pixels are left out of medians.",
    ),
    Term(
        "gap",
        "How far the law of the data is from that of the model (Kullback-Leibler divergence), on frames "
        "that no fit has seen. More data do not change it; they lower its floor, which chance alone makes.",
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
        "10⁻⁶ nat, the unit of the gap. N samples with a gap of G nats each are exp(N G) times as likely "
        "under the law of the data as under the model: 1 micronat, a million samples: a factor e.",
        ("micronats",),
    ),
    Term(
        "misfit",
        "A pixel whose histogram the fitted density does not describe, by the rate of false discoveries.",
        ("misfits",),
    ),
    Term(
        "non-uniformity of the gain",
        "Spread of the conversion gain between pixels over its mean. PRNU of EMVA 1288 holds gain and "
        "sensitivity together, measured under light.",
    ),
    Term(
        "NUCed",
        "After non-uniformity correction: each value less its pixel's bias, times its gain, in electrons.",
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
        "The best fit of an effect that has nothing to do with the named one. What it closes of the gap, any "
        "wrong effect could.",
    ),
    Term(
        "PRNU",
        "Photo response non-uniformity: spread between pixels of the response to light, over its mean. "
        "Here the spread of H under light stands for it; EMVA 1288 measures at half saturation.",
        ("photo response non-uniformity",),
    ),
    Term("quanta exposure", "Mean number of electrons of a pixel in one frame, H (e⁻)."),
    Term(
        "read noise",
        "Standard deviation that reading adds to a pixel's signal, σ in DN or σ·g in e⁻, quantisation "
        "included. Dark shot noise is not in it; in the temporal dark noise of EMVA 1288 it is.",
    ),
    Term(
        "readout and charge",
        "Each sample is split by its pixel's fit into the expected number of electrons (charge) and what is "
        "left (readout). Effects of light show in the first, those of the electronics in the second.",
        ("readout residuals", "readout channel", "charge channel"),
    ),
    Term(
        "replicate",
        "A stack simulated from the fitted model and treated like the data: what chance makes of it.",
        ("replicates",),
    ),
    Term(
        "RMSE",
        "Root mean square difference between the predicted and the measured density of the ensemble; "
        "sampling noise alone leaves some.",
    ),
    Term(
        "sd of chance",
        "Standard deviation of a statistic between stacks simulated from the fitted model. Of a hundred "
        "statistics the largest lies near 3 by chance.",
        ("standard deviations of chance", "sd"),
    ),
    Term(
        "standard error",
        "How far an estimate is from the truth by chance, as a standard deviation; from the curvature of the "
        "likelihood.",
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
