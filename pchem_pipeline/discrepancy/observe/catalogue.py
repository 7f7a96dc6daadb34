"""The statistics: every name, its family, its channel, and a sentence.

Each is about N(0, 1) where the PCD holds; the order is that of the vector. ``VERSION`` is raised when any
statistic changes its meaning, since vectors of different versions must not be compared.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from pchem_pipeline.effects.framework.evidence import SCORES
from pchem_pipeline.effects.framework.region import parse_place

VERSION = 2

Family = Literal["shape", "code", "tail", "time", "frame", "space"]
FAMILIES: tuple[Family, ...] = ("shape", "code", "tail", "time", "frame", "space")
Channel = Literal["charge", "readout", "cross", "digital"]


@dataclass(frozen=True)
class Statistic:
    """One component of the vector.

    Attributes:
        name: ``family.what``.
        channel: charge (electron numbers), readout (residuals), cross (their products) or digital (codes).
        sentence: what a large positive value says.
        opposite: what a large negative value says; empty: the sentence, less than the model makes it.
    """

    name: str
    channel: Channel
    sentence: str
    opposite: str = ""

    @property
    def family(self) -> str:
        """The part of the name before the first dot."""
        return self.name.partition(".")[0]

    def says(self, z: float) -> str:
        """Return what a value of this sign says."""
        if not z < 0.0:
            return self.sentence
        return self.opposite or f"{self.sentence}, less than the model makes it"


_SCORE_CHANNEL: dict[str, Channel] = {
    "C2": "charge", "C3": "charge", "He3": "readout", "He4": "readout",
    "He2C1": "cross", "He1C2": "cross", "He2C2": "cross", "He3C1": "cross",
}  # fmt: skip
#: What a score says where it is positive and where it is negative, and what it measures.
_SCORE_WORDS = {
    "C2": (
        "the electron numbers vary more than Poisson",
        "the electron numbers vary less than Poisson",
        "the variance of the electron numbers",
    ),
    "C3": (
        "the electron numbers are more skewed than Poisson",
        "the electron numbers are less skewed than Poisson",
        "the skew of the electron numbers",
    ),
    "He3": (
        "the read noise is skewed to high DN",
        "the read noise is skewed to low DN",
        "the skew of the read noise",
    ),
    "He4": (
        "the read noise has heavy tails",
        "the read noise has lighter tails than a Gaussian",
        "the weight of the tails of the read noise",
    ),
    "He2C1": (
        "the peaks widen with the electron number",
        "the peaks narrow with the electron number",
        "the widening of the peaks with the electron number",
    ),
    "He1C2": (
        "the spacing of the peaks grows with the electron number",
        "the spacing of the peaks shrinks with the electron number",
        "the change of the peaks' spacing with the electron number",
    ),
    "He2C2": (
        "the widening of the peaks grows with the electron number",
        "the widening of the peaks falls with the electron number",
        "the change of the peaks' widening with the electron number",
    ),
    "He3C1": (
        "the skew of the peaks grows with the electron number",
        "the skew of the peaks falls with the electron number",
        "the change of the peaks' skew with the electron number",
    ),
}


def _scores() -> list[Statistic]:
    found = []
    for score in SCORES:
        channel, (more, less, what) = _SCORE_CHANNEL[score], _SCORE_WORDS[score]
        words = {
            "mean": (f"{more}, in the mean of the pixels", f"{less}, in the mean of the pixels"),
            "chi": (f"{what} deviates from the PCD pixel by pixel, with either sign", ""),
            "cnt": (f"{what} stands out in single pixels", ""),
            "slope": (
                f"{what} is the higher, the higher the exposure",
                f"{what} is the lower, the higher the exposure",
            ),
        }
        found += [Statistic(f"shape.{score}.{form}", channel, *pair) for form, pair in words.items()]
    return found


def _of_channels(pattern: str, sentence: str, opposite: str = "") -> list[Statistic]:
    words: dict[Channel, str] = {"charge": "electron numbers", "readout": "readout residuals"}
    return [
        Statistic(pattern.format(c), c, sentence.format(word), opposite.format(word))
        for c, word in words.items()
    ]


def _time() -> list[Statistic]:
    found: list[Statistic] = []
    for lag, frames in (1, "successive frames"), (2, "every second frame"), (3, "every third frame"):
        found += _of_channels(
            f"time.lag{lag}.{{}}.mean",
            f"{{}} of {frames} are alike, in the mean of the pixels",
            f"{{}} of {frames} are opposite, in the mean of the pixels",
        )
    found += _of_channels(
        "time.lag1.{}.chi", "{} of successive frames are correlated pixel by pixel, with either sign"
    )
    found += _of_channels(
        "time.lag1.{}.cnt", "{} of successive frames are correlated strongly in single pixels"
    )
    after = "the charge of the frame before"
    found += [
        Statistic(
            "time.cross.readout_charge", "cross", f"residuals follow {after}", f"residuals oppose {after}"
        ),
        Statistic(
            "time.cross.readout_charge.chi",
            "cross",
            f"residuals follow {after} pixel by pixel, with either sign",
        ),
        Statistic(
            "time.cross.charge_readout",
            "cross",
            "charge follows the residual of the frame before",
            "charge opposes the residual of the frame before",
        ),
        Statistic(
            "time.nearer",
            "digital",
            "samples are nearer to the one before than to others",
            "samples are farther from the one before than from others",
        ),
        Statistic(
            "time.follows.sample", "cross", "residuals follow the charge of another pixel one frame before"
        ),
        Statistic(
            "time.follows.line",
            "cross",
            "residuals follow the charge of a row, column or frame one frame before",
        ),
    ]
    found += _of_channels("time.block.{}.chi", "block means of the {} wander, each pixel by itself")
    found += _of_channels("time.block.{}.cnt", "block means of the {} wander strongly in single pixels")
    return found


def _frame() -> list[Statistic]:
    found: list[Statistic] = []
    for name, sentence, opposite in (
        (
            "frame.{}.variance",
            "frame means of the {} scatter more than their pixels",
            "frame means of the {} scatter less than their pixels",
        ),
        (
            "frame.{}.lag1",
            "frame means of the {} resemble those of the frame before",
            "frame means of the {} are opposite to those of the frame before",
        ),
        ("frame.{}.slow", "frame means of the {} wander slowly (means of blocks scatter)", ""),
        (
            "frame.{}.trend",
            "frame means of the {} rise along the run",
            "frame means of the {} fall along the run",
        ),
        ("frame.{}.line", "frame means of the {} hold a periodic component", ""),
        (
            "frame.{}.alternating",
            "even and odd frames differ in the mean of the {} (even above odd)",
            "even and odd frames differ in the mean of the {} (odd above even)",
        ),
        ("frame.{}.largest", "one frame's mean of the {} stands out", ""),
        ("frame.{}.quadrants", "quadrants wander apart slowly in the {}", ""),
    ):
        found += _of_channels(name, sentence, opposite)
    return [
        *found,
        Statistic(
            "frame.covariance",
            "cross",
            "frame means of charge and residual vary together",
            "frame means of charge and residual vary against each other",
        ),
        Statistic("frame.gain.slow", "cross", "the gain wanders slowly (blocks)"),
        Statistic(
            "frame.gain.trend",
            "cross",
            "the gain rises along the run (residuals follow H)",
            "the gain falls along the run (residuals oppose H)",
        ),
        Statistic(
            "frame.noise.variance",
            "readout",
            "single frames are noisier than others",
            "frames are too equally noisy",
        ),
        Statistic("frame.noise.slow", "readout", "the read noise wanders slowly (blocks)"),
        Statistic("frame.repeated", "digital", "frames repeat the one before exactly"),
        Statistic("frame.repeated_rows", "digital", "rows repeat those of the frame before exactly"),
    ]


def _lines() -> list[Statistic]:
    found: list[Statistic] = []
    for line in ("row", "column"):
        found += _of_channels(
            f"space.{line}.{{}}.variance",
            f"{line} means of the {{}} scatter from frame to frame",
            f"{line} means of the {{}} scatter too little from frame to frame",
        )
        found += _of_channels(
            f"space.{line}.{{}}.lag1",
            f"adjacent {line}s have similar means of the {{}}",
            f"adjacent {line}s have opposite means of the {{}}",
        )
    found += [
        Statistic("space.row.readout.line", "readout", "the rows of a frame hold a periodic component"),
        Statistic("space.column.readout.line", "readout", "the columns of a frame hold a periodic component"),
        Statistic("space.sample.readout.line", "readout", "a wave runs across rows, columns and frames"),
        Statistic(
            "space.sample.readout.spectrum", "readout", "samples of a frame resemble others at some distance"
        ),
    ]
    return found


def _neighbours() -> list[Statistic]:
    pairs: dict[str, tuple[Channel, str, str]] = {
        "kk": (
            "charge",
            "electron numbers of neighbours are correlated",
            "electron numbers of neighbours are anticorrelated",
        ),
        "rr": (
            "readout",
            "residuals of neighbours are correlated",
            "residuals of neighbours are anticorrelated",
        ),
        "rk": (
            "cross",
            "residuals follow the charge of the neighbour",
            "residuals oppose the charge of the neighbour",
        ),
    }
    return [
        Statistic(f"space.{axis}.{p}", c, f"{more}, along {axis}", f"{less}, along {axis}")
        for axis in ("x", "y")
        for p, (c, more, less) in pairs.items()
    ]


def _samples_of_others() -> list[Statistic]:
    return [
        *(
            Statistic(
                f"space.{line}.noise.variance",
                "readout",
                f"single {line}s of frames are noisier than others",
                f"{line}s of frames are too equally noisy",
            )
            for line in ("row", "column")
        ),
        Statistic(
            "space.predicted.equal",
            "digital",
            "samples equal what their neighbours predict",
            "too few samples equal what their neighbours predict",
        ),
        Statistic(
            "space.predicted.above",
            "digital",
            "samples far exceed what their neighbours predict",
            "too few samples far exceed what their neighbours predict",
        ),
        Statistic("space.equal.squares", "digital", "samples of squares of 2 x 2 pixels are all equal"),
        Statistic("space.x.bits", "digital", "samples follow bits of the sample read before"),
        Statistic(
            "space.follows.sample", "cross", "residuals follow the charge of another sample of the frame"
        ),
        Statistic("space.follows.line", "cross", "residuals follow the charge of a row, column or frame"),
        Statistic("space.misplaced.rows", "digital", "rows hold the samples of other pixels"),
        Statistic("space.misplaced.columns", "digital", "columns hold the samples of other pixels"),
        Statistic("space.repeated.rows", "digital", "rows repeat the one above exactly"),
        Statistic("space.repeated.columns", "digital", "columns repeat the one on the left exactly"),
    ]


def _deviations() -> list[Statistic]:
    found = []
    subjects: tuple[tuple[str, Channel, str], ...] = (
        ("goodness", "digital", "histograms"),
        ("peaks", "readout", "the peaks of the histograms"),
    )
    for name, channel, what in subjects:
        words = {
            "mean": (
                f"{what} deviate from the PCD, in the mean of the pixels",
                f"{what} come nearer to the PCD than chance lets them, in the mean of the pixels",
            ),
            "chi": (f"{what} deviate from the PCD pixel by pixel", ""),
            "cnt": (f"{what} deviate from the PCD strongly in single pixels", ""),
        }
        found += [Statistic(f"shape.{name}.{form}", channel, *pair) for form, pair in words.items()]
    return found


_CODE = [
    Statistic("code.rough", "digital", "neighbouring codes deviate from the smooth expectation"),
    Statistic(
        "code.alternating",
        "digital",
        "residuals of adjacent codes have opposite signs",
        "residuals of adjacent codes have the same sign",
    ),
    Statistic(
        "code.smooth", "digital", "residuals of the codes vary slowly along DN, beyond the pixels' own"
    ),
    *(
        Statistic(f"code.period{period}", "digital", f"residuals of the codes have a period of {period} DN")
        for period in (2, 4, 8, 16)
    ),
    Statistic("code.largest", "digital", "one code stands out"),
    Statistic("code.top", "digital", "counts pile up at the highest code, and none lie beyond"),
    Statistic("code.bottom", "digital", "counts pile up at the lowest code, and none lie beyond"),
]
_TAIL = [
    Statistic(
        "tail.low.count",
        "readout",
        "samples below all that the PCD allows",
        "too few samples lie at the low end of what the PCD allows",
    ),
    Statistic("tail.low.pixels", "readout", "pixels with samples below all that the PCD allows"),
    Statistic(
        "tail.high.count",
        "charge",
        "samples above all that the PCD allows",
        "too few samples lie at the high end of what the PCD allows",
    ),
    Statistic("tail.high.pixels", "charge", "pixels with samples above all that the PCD allows"),
    Statistic("tail.high.clusters", "charge", "such samples come next to each other in the same frame"),
]


class _Catalogue(dict[str, Statistic]):
    """Statistics by name; ``name@columns=30:40`` is the one of that name in a part of the sensor or run."""

    def __missing__(self, name: str) -> Statistic:
        """Return a statistic of a part; those are no members, since there are as many as there are parts."""
        whole, at, place = name.partition("@")
        if not at or whole not in self:
            raise KeyError(name)
        known = self[whole]
        words = ", ".join(each.describe() for each in parse_place(place) if each is not None)
        more, less = (f"{known.says(sign)}, in {words}" for sign in (1.0, -1.0))
        return replace(known, name=name, sentence=more, opposite=less)


#: Every statistic by name, in the order of the vector.
STATISTICS: dict[str, Statistic] = _Catalogue(
    (s.name, s)
    for s in [
        *_scores(),
        *_deviations(),
        *_CODE,
        *_TAIL,
        *_time(),
        *_frame(),
        *_lines(),
        *_neighbours(),
        *_samples_of_others(),
    ]
)

#: Statistics that are exact tests, never positive by chance, and by how much each event raises them (rows
#: come by the dozen).
EXACT: dict[str, float] = {
    "frame.repeated": 10.0,
    "frame.repeated_rows": 160.0,
    "space.repeated.rows": 10.0,
    "space.repeated.columns": 10.0,
}
