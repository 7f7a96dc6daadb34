"""The texts under the figures, and the sections of the report."""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["CAPTIONS", "MAP_READING", "SECTIONS", "case_name", "highlighted_cases"]

#: (id, heading, introduction, parts that may be missing) of the sections that show figures.
SECTIONS: tuple[tuple[str, str, str, tuple[str, ...]], ...] = (
    (
        "pixels",
        "Single pixels",
        "Each pixel is described by the photon counting distribution (PCD): a Poisson number of electrons"
        " with mean H, converted with gain g, on top of the bias μ, with Gaussian read noise σ.",
        ("pixels",),
    ),
    (
        "goodness",
        "Does the model describe each pixel?",
        "The histogram of each pixel is tested against its fitted density by a chi-square of merged bins, "
        "whose p-values are uniform by chance. Of many thousand tests some look significant: pixels are "
        "called misfits only as far as the rate of false discoveries allows. Single samples that the model "
        "does not expect at all (cosmic rays, glitches) are left out of the fit and counted.",
        (),
    ),
    (
        "cells",
        "From signal to electron number",
        "The peaks of the PCD are whole electrons. Each signal belongs to the electron number that "
        "explains it best; the edges between these cells are not half-way between the peaks, since small "
        "and large numbers are not equally likely.",
        (),
    ),
    (
        "read-noise",
        "Read noise",
        "Read noise in electrons, quantisation included, of every pixel with a fit.",
        ("maps",),
    ),
    (
        "maps",
        "Parameter maps",
        "Histogram and map of each parameter. Structure in a map points to the architecture of the sensor.",
        (
            "maps",
            "dark_current",
        ),
    ),
    (
        "ensemble",
        "The sensor as a whole",
        "If the model holds, the parameters of the pixels predict the distribution of all raw data taken "
        "together.",
        (
            "ensemble",
            "nuced",
        ),
    ),
    (
        "electrons",
        "Electron numbers",
        "Each raw value of the ensemble frames was turned into a number of electrons.",
        ("electrons",),
    ),
    (
        "components",
        "Why the peaks of the ensemble fade",
        "The ensemble is a sum of components, one for each electron number. Where pixels differ in gain, "
        "the components become wider with the electron number.",
        ("components",),
    ),
    (
        "uncertainty",
        "How sure are the numbers?",
        "Standard errors follow from the curvature of each pixel's likelihood, those of derived "
        "quantities from the whole covariance of the four parameters.",
        (),
    ),
    (
        "methods",
        "Other methods beside PCH-EM",
        "The same pixels characterised by the methods of the literature, with the smallest errors that any "
        "method could have.",
        ("methods",),
    ),
    (
        "plan",
        "How many frames are enough?",
        "The information of one frame tells how many of them a precision needs, before they are taken.",
        (),
    ),
    (
        "status",
        "Fit status",
        "Pixels that could not be fitted, or whose values deserve caution, and why.",
        (),
    ),
)

CAPTIONS: dict[str, str] = {
    "cluster_edges_example": (
        "The example of Hendrickson et al. (2023): density of a PCD with H = 1.8 e⁻ and a read noise of "
        "0.33 e⁻ (line), and the edges of the cells in which each electron number is the most likely one "
        "(dashed)."
    ),
    "cluster_edges_pixel": (
        "The same for a pixel of this run: its histogram (gray), fitted density (line) and cell edges "
        "(dashed)."
    ),
    "pixel_fits": (
        "Gray: share of the frames at each digital number. Black: fitted density. Below: (observed − "
        "expected) / √expected; the gray band is two standard deviations. A good fit has about one line "
        "in twenty beyond the band and no pattern. Uncertainties are standard errors of the fit."
    ),
    "goodness": (
        "p-values of the goodness of fit of all pixels (blue); by chance they are uniform (line, with two "
        "standard deviations in gray), a peak at 0 is made of pixels that the model does not describe. Map: "
        "chi-square as standard normal deviate, clipped at −4 and 6; circles are the misfits at a rate of "
        "false discoveries of {rate:g}."
    ),
    "worst_pixels": (
        "The pixels of the poorest fit, the poorest first, drawn as above. With thousands of pixels the "
        "poorest look odd by chance, too: q is the rate of false discoveries at which the pixel counts."
    ),
    "left_out": (
        "Samples where the fitted model expects fewer than {floor:g} frames per DN are left out of the "
        "likelihood. Left: pixels by how many they lost. Right: where they are; white pixels lost none. "
        "Without outliers about one pixel in two hundred loses a single sample by chance."
    ),
    "uncertainty": (
        "Left: part of the variance of each map over the pixels that is noise of the estimates; near 100 % "
        "(dotted) the map shows noise alone, and more frames would show more of the sensor. Right: "
        "predicted density of the ensemble (black), its standard error from those of the maps (blue), and "
        "the sampling noise of the data it is compared with (light blue)."
    ),
    "rounding": (
        "Bias that rounding gives to estimates from the density of the PCD, in standard errors of one pixel, "
        "at the median quanta exposure and read noise of this run and its number of frames; the worst of all "
        "places of the bias between two whole DN. Above the dotted line (0.05) "
        "fit.likelihood: auto fits with the exact masses."
    ),
    "read_noise_histogram": (
        "Read noise, quantisation included. The blue line is the median, the shaded part holds the pixels"
        " from 5 to 95 %. {below} of the {noun}s with a value lie below 0.4 e⁻."
    ),
    "map_dark_current": "Dark current: quanta exposure over integration time.",
    "map_conversion_gain": "Conversion gain: electrons per digital number.",
    "map_bias": "Bias: the digital number at zero electrons.",
    "map_read_noise_e": "Read noise in electrons, quantisation included.",
    "ensemble": (
        "Histogram of all pixels over the chosen frames (gray), raw at the top and after two-point non-"
        "uniformity correction at the bottom, where the peaks lie at whole electrons. Lines: prediction "
        "from the fitted parameters, as the exact mean over the pixels, with the parameters' joint "
        "histogram (dependent), and with the product of their four histograms (independent). Strips: data"
        " minus prediction, with two standard deviations of the sampling noise in gray. An RMSE close to "
        "that of the sampling noise alone means that the model explains the data."
    ),
    "electron_numbers": (
        "Gray: share of each electron number among the estimates. Dots: mass p(k) predicted from the map "
        "of H. Crosses: mass that the estimator itself should show, which errs between neighbouring "
        "numbers. Below: estimate minus prediction, with two standard deviations of the "
        "sampling noise in gray."
    ),
    "component_widths": (
        "Standard deviation of the component of electron number k, raw (left or top) and after non-"
        "uniformity correction (right or bottom). Each line holds a set of parameters constant over the "
        "pixels; gray lines are the remaining ones of the sixteen sets. Flat lines keep the peaks "
        "resolved at every signal."
    ),
    "fit_status": (
        "Light gray pixels have a good fit. A pixel with several reasons has the colour of the first that"
        " applies; the numbers count every reason."
    ),
}

#: How to read the figures of the section ``maps``, by how they are drawn.
MAP_READING: dict[str, str] = {
    "beta": (
        "Colours follow the rank of a pixel (Beta(2,2) stretch), so that a few outliers do not hide the "
        "structure: the five labels of the colour bar are the minimum, the 15.6, 50 and 84.4 % quantiles "
        "and the maximum. The blue line in a histogram is the median."
    ),
    "linear": (
        "Colours are linear between the 1st and the 99th percentile; values beyond have the end colours. "
        "The blue line in a histogram is the median."
    ),
    "channels": (
        "Each point is a channel with its standard error; crosses at the bottom are channels without a value."
    ),
}

_SYMBOLS = {"mu": "μ", "sigma": "σ", "sigma2": "σ²"}
_HIGHLIGHTED = ("none", "g", "H, g", "g, μ, σ²", "H, g, μ, σ²")


def case_name(constant: Sequence[str]) -> str:
    """Return the name of a case of Appendix B: the parameters held constant, or ``none``."""
    return ", ".join(_SYMBOLS.get(symbol, symbol) for symbol in constant) or "none"


def highlighted_cases(cases: Sequence[str]) -> tuple[str, ...]:
    """Return the cases that are drawn in colour."""
    return tuple(case for case in _HIGHLIGHTED if case in cases)
