"""The statistics: every name, its family, its channel, and a sentence.

Each is about N(0, 1) where the PCD holds; the order is that of the vector. ``VERSION`` is raised when any
statistic changes its meaning, since vectors of different versions must not be compared.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from pchem_pipeline.effects.framework.evidence import SCORES
from pchem_pipeline.effects.framework.region import parse_place

VERSION = 1

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
    """

    name: str
    channel: Channel
    sentence: str

    @property
    def family(self) -> str:
        """The part of the name before the first dot."""
        return self.name.partition(".")[0]


_SCORE_CHANNEL: dict[str, Channel] = {
    "C2": "charge", "C3": "charge", "He3": "readout", "He4": "readout",
    "He2C1": "cross", "He1C2": "cross", "He2C2": "cross", "He3C1": "cross",
}  # fmt: skip
_SCORE_WORDS = {
    "C2": "the electron numbers vary more than Poisson",
    "C3": "the electron numbers are more skewed than Poisson",
    "He3": "the read noise is skewed to high DN",
    "He4": "the read noise has heavy tails",
    "He2C1": "the peaks widen with the electron number",
    "He1C2": "the spacing of the peaks grows with the electron number",
    "He2C2": "the widening of the peaks grows with the electron number",
    "He3C1": "the skew of the peaks grows with the electron number",
}


def _scores() -> list[Statistic]:
    found = []
    for score in SCORES:
        channel, words = _SCORE_CHANNEL[score], _SCORE_WORDS[score]
        found += [
            Statistic(f"shape.{score}.mean", channel, f"{words}, in all pixels alike"),
            Statistic(f"shape.{score}.chi", channel, f"{words}, or less, differently from pixel to pixel"),
            Statistic(f"shape.{score}.cnt", channel, f"{words}, or less, in few pixels strongly"),
            Statistic(f"shape.{score}.slope", channel, f"{words}, and the more so the higher the exposure"),
        ]
    return found


def _of_channels(pattern: str, sentence: str) -> list[Statistic]:
    words: dict[Channel, str] = {"charge": "electron numbers", "readout": "readout residuals"}
    return [Statistic(pattern.format(c), c, sentence.format(word)) for c, word in words.items()]


def _time() -> list[Statistic]:
    found: list[Statistic] = []
    for lag, frames in (1, "successive frames"), (2, "every second frame"), (3, "every third frame"):
        found += _of_channels(f"time.lag{lag}.{{}}.mean", f"{{}} of {frames} are alike, in all pixels")
    found += _of_channels("time.lag1.{}.chi", "{} of successive frames are correlated, differently by pixel")
    found += _of_channels(
        "time.lag1.{}.cnt", "{} of successive frames are correlated, in few pixels strongly"
    )
    found += [
        Statistic("time.cross.readout_charge", "cross", "residuals follow the charge of the frame before"),
        Statistic(
            "time.cross.readout_charge.chi",
            "cross",
            "residuals follow the charge of the frame before, differently by pixel",
        ),
        Statistic("time.cross.charge_readout", "cross", "charge follows the residual of the frame before"),
    ]
    found += [
        Statistic("time.nearer", "digital", "samples are nearer to the one before than to others"),
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
    found += _of_channels("time.block.{}.cnt", "block means of the {} wander, in few pixels strongly")
    return found


def _frame() -> list[Statistic]:
    found: list[Statistic] = []
    for name, sentence in {
        "frame.{}.variance": "frame means of the {} scatter more than their pixels",
        "frame.{}.lag1": "frame means of the {} resemble those of the frame before",
        "frame.{}.slow": "frame means of the {} wander slowly (means of blocks scatter)",
        "frame.{}.trend": "frame means of the {} rise along the run",
        "frame.{}.line": "frame means of the {} hold a periodic component",
        "frame.{}.alternating": "even and odd frames differ in the mean of the {} (even above odd)",
        "frame.{}.largest": "one frame's mean of the {} stands out",
        "frame.{}.quadrants": "quadrants wander apart slowly in the {}",
    }.items():
        found += _of_channels(name, sentence)
    return [
        *found,
        Statistic("frame.covariance", "cross", "frame means of charge and residual vary together"),
        Statistic("frame.gain.slow", "cross", "the gain wanders slowly (blocks)"),
        Statistic("frame.gain.trend", "cross", "the gain rises along the run (residuals follow H)"),
        Statistic("frame.repeated", "digital", "frames repeat the one before exactly"),
        Statistic("frame.repeated_rows", "digital", "rows repeat those of the frame before exactly"),
    ]


def _space() -> list[Statistic]:
    found: list[Statistic] = []
    for line in ("row", "column"):
        found += _of_channels(
            f"space.{line}.{{}}.variance", f"{line} means of the {{}} scatter from frame to frame"
        )
        found += _of_channels(f"space.{line}.{{}}.lag1", f"adjacent {line}s have similar means of the {{}}")
    found += [
        Statistic("space.row.readout.line", "readout", "the rows of a frame hold a periodic component"),
        Statistic("space.column.readout.line", "readout", "the columns of a frame hold a periodic component"),
    ]
    pairs: dict[str, tuple[Channel, str]] = {
        "kk": ("charge", "electron numbers of neighbours are correlated"),
        "rr": ("readout", "residuals of neighbours are correlated"),
        "rk": ("cross", "residuals follow the charge of the neighbour"),
    }
    for axis in ("x", "y"):
        found += [
            Statistic(f"space.{axis}.{p}", c, f"{text}, along {axis}") for p, (c, text) in pairs.items()
        ]
    return [
        *found,
        Statistic("space.predicted.equal", "digital", "samples equal what their neighbours predict"),
        Statistic("space.predicted.above", "digital", "samples far exceed what their neighbours predict"),
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


_GOODNESS = [
    Statistic("shape.goodness.mean", "digital", "histograms deviate from the PCD, in all pixels alike"),
    Statistic("shape.goodness.chi", "digital", "histograms deviate from the PCD, differently by pixel"),
    Statistic("shape.goodness.cnt", "digital", "histograms deviate from the PCD, in few pixels strongly"),
    Statistic(
        "shape.peaks.mean", "readout", "the form of the peaks deviates from the PCD, in all pixels alike"
    ),
    Statistic(
        "shape.peaks.chi", "readout", "the form of the peaks deviates from the PCD, differently by pixel"
    ),
    Statistic(
        "shape.peaks.cnt", "readout", "the form of the peaks deviates from the PCD, in few pixels strongly"
    ),
]
_CODE = [
    Statistic("code.rough", "digital", "neighbouring codes deviate from the smooth expectation"),
    Statistic("code.alternating", "digital", "residuals of adjacent codes have opposite signs"),
    Statistic(
        "code.smooth", "digital", "residuals of the codes vary slowly along DN, beyond the pixels' own"
    ),
    Statistic("code.period2", "digital", "residuals of the codes have a period of 2 DN"),
    Statistic("code.period4", "digital", "residuals of the codes have a period of 4 DN"),
    Statistic("code.period8", "digital", "residuals of the codes have a period of 8 DN"),
    Statistic("code.period16", "digital", "residuals of the codes have a period of 16 DN"),
    Statistic("code.largest", "digital", "one code stands out"),
    Statistic("code.top", "digital", "counts pile up at the highest code, and none lie beyond"),
    Statistic("code.bottom", "digital", "counts pile up at the lowest code, and none lie beyond"),
]
_TAIL = [
    Statistic("tail.low.count", "readout", "samples below all that the PCD allows"),
    Statistic("tail.low.pixels", "readout", "pixels with samples below all that the PCD allows"),
    Statistic("tail.high.count", "charge", "samples above all that the PCD allows"),
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
        words = ", ".join(each.words() for each in parse_place(place) if each is not None)
        return replace(known, name=name, sentence=f"{known.sentence} (in {words})")


#: Every statistic by name, in the order of the vector.
STATISTICS: dict[str, Statistic] = _Catalogue(
    (s.name, s) for s in [*_scores(), *_GOODNESS, *_CODE, *_TAIL, *_time(), *_frame(), *_space()]
)

#: Statistics that are exact tests, never positive by chance, and by how much each event raises them (rows
#: come by the dozen).
EXACT: dict[str, float] = {
    "frame.repeated": 10.0,
    "frame.repeated_rows": 160.0,
    "space.repeated.rows": 10.0,
    "space.repeated.columns": 10.0,
}
