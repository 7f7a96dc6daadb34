"""The statistics: every name, its family, its channel, and a sentence.

Each is about N(0, 1) where the PCD holds; the order is that of the vector. ``VERSION`` is raised when any
statistic changes its meaning, since vectors of different versions must not be compared.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal, cast

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


#: Of each score its channel, what it says where it is positive [and where negative], and what it measures.
_SCORES: dict[str, tuple[str, str, str]] = {
    "C2": ("charge", "the electron numbers vary [more|less] than Poisson",
           "the variance of the electron numbers"),
    "C3": ("charge", "the electron numbers are [more|less] skewed than Poisson",
           "the skew of the electron numbers"),
    "He3": ("readout", "the read noise is skewed to [high|low] DN", "the skew of the read noise"),
    "He4": ("readout", "the read noise has [heavy tails|lighter tails than a Gaussian]",
            "the weight of the tails of the read noise"),
    "He2C1": ("cross", "the peaks [widen|narrow] with the electron number",
              "the widening of the peaks with the electron number"),
    "He1C2": ("cross", "the spacing of the peaks [grows|shrinks] with the electron number",
              "the change of the peaks' spacing with the electron number"),
    "He2C2": ("cross", "the widening of the peaks [grows|falls] with the electron number",
              "the change of the peaks' widening with the electron number"),
    "He3C1": ("cross", "the skew of the peaks [grows|falls] with the electron number",
              "the change of the peaks' skew with the electron number"),
}  # fmt: skip
_OF_A_SCORE = """
{channel} shape.{score}.mean {says}, in the mean of the pixels
{channel} shape.{score}.chi {what} deviates from the PCD pixel by pixel, with either sign
{channel} shape.{score}.cnt {what} stands out in single pixels
{channel} shape.{score}.slope {what} is the [higher|lower], the higher the exposure
"""
#: All others: channel, name, and what a large positive [or negative] value says. Those of ``both`` are one
#: for each of the charge and the readout, whose name and subject take the places of ``{}`` and ``{of}``.
_OTHERS = """
digital shape.goodness.mean histograms [deviate from the PCD|come nearer to the PCD than chance lets them], in
        the mean of the pixels
digital shape.goodness.chi histograms deviate from the PCD pixel by pixel
digital shape.goodness.cnt histograms deviate from the PCD strongly in single pixels
readout shape.peaks.mean the peaks of the histograms [deviate from the PCD|come nearer to the PCD than chance
        lets them], in the mean of the pixels
readout shape.peaks.chi the peaks of the histograms deviate from the PCD pixel by pixel
readout shape.peaks.cnt the peaks of the histograms deviate from the PCD strongly in single pixels
digital code.rough neighbouring codes deviate from the smooth expectation
digital code.alternating residuals of adjacent codes have [opposite signs|the same sign]
digital code.smooth residuals of the codes vary slowly along DN, beyond the pixels' own
digital code.period2 residuals of the codes have a period of 2 DN
digital code.period4 residuals of the codes have a period of 4 DN
digital code.period8 residuals of the codes have a period of 8 DN
digital code.period16 residuals of the codes have a period of 16 DN
digital code.largest one code stands out
digital code.top counts pile up at the highest code, and none lie beyond
digital code.bottom counts pile up at the lowest code, and none lie beyond
readout tail.low.count [samples below all that|too few samples lie at the low end of what] the PCD allows
readout tail.low.pixels pixels with samples below all that the PCD allows
charge  tail.high.count [samples above all that|too few samples lie at the high end of what] the PCD allows
charge  tail.high.pixels pixels with samples above all that the PCD allows
charge  tail.high.clusters such samples come next to each other in the same frame
both    time.lag1.{}.mean {of} of successive frames are [alike|opposite], in the mean of the pixels
both    time.lag2.{}.mean {of} of every second frame are [alike|opposite], in the mean of the pixels
both    time.lag3.{}.mean {of} of every third frame are [alike|opposite], in the mean of the pixels
both    time.lag1.{}.chi {of} of successive frames are correlated pixel by pixel, with either sign
both    time.lag1.{}.cnt {of} of successive frames are correlated strongly in single pixels
cross   time.cross.readout_charge residuals [follow|oppose] the charge of the frame before
cross   time.cross.readout_charge.chi residuals follow the charge of the frame before pixel by pixel, with
        either sign
cross   time.cross.charge_readout charge [follows|opposes] the residual of the frame before
digital time.nearer samples are [nearer to|farther from] the one before than [to|from] others
cross   time.follows.sample residuals follow the charge of another pixel one frame before
cross   time.follows.line residuals follow the charge of a row, column or frame one frame before
both    time.block.{}.chi block means of the {of} wander, each pixel by itself
both    time.block.{}.cnt block means of the {of} wander strongly in single pixels
both    frame.{}.variance frame means of the {of} scatter [more|less] than their pixels
both    frame.{}.lag1 frame means of the {of} [resemble|are opposite to] those of the frame before
both    frame.{}.slow frame means of the {of} wander slowly (means of blocks scatter)
both    frame.{}.trend frame means of the {of} [rise|fall] along the run
both    frame.{}.line frame means of the {of} hold a periodic component
both    frame.{}.alternating even and odd frames differ in the mean of the {of} ([even above odd|odd above
        even])
both    frame.{}.largest one frame's mean of the {of} stands out
both    frame.{}.quadrants quadrants wander apart slowly in the {of}
cross   frame.covariance frame means of charge and residual vary [together|against each other]
cross   frame.gain.slow the gain wanders slowly (blocks)
cross   frame.gain.trend the gain [rises|falls] along the run (residuals [follow|oppose] H)
readout frame.noise.variance [single frames are noisier than others|frames are too equally noisy]
readout frame.noise.slow the read noise wanders slowly (blocks)
digital frame.repeated frames repeat the one before exactly
digital frame.repeated_rows rows repeat those of the frame before exactly
both    space.row.{}.variance row means of the {of} scatter [from|too little from] frame to frame
both    space.row.{}.lag1 adjacent rows have [similar|opposite] means of the {of}
both    space.column.{}.variance column means of the {of} scatter [from|too little from] frame to frame
both    space.column.{}.lag1 adjacent columns have [similar|opposite] means of the {of}
readout space.row.readout.line the rows of a frame hold a periodic component
readout space.column.readout.line the columns of a frame hold a periodic component
readout space.sample.readout.line a wave runs across rows, columns and frames
readout space.sample.readout.spectrum samples of a frame resemble others at some distance
charge  space.x.kk electron numbers of neighbours are [correlated|anticorrelated], along x
readout space.x.rr residuals of neighbours are [correlated|anticorrelated], along x
cross   space.x.rk residuals [follow|oppose] the charge of the neighbour, along x
charge  space.y.kk electron numbers of neighbours are [correlated|anticorrelated], along y
readout space.y.rr residuals of neighbours are [correlated|anticorrelated], along y
cross   space.y.rk residuals [follow|oppose] the charge of the neighbour, along y
readout space.row.noise.variance [single rows of frames are noisier than others|rows of frames are too equally
        noisy]
readout space.column.noise.variance [single columns of frames are noisier than others|columns of frames are
        too equally noisy]
digital space.predicted.equal [samples|too few samples] equal what their neighbours predict
digital space.predicted.above [samples|too few samples] far exceed what their neighbours predict
digital space.equal.squares samples of squares of 2 x 2 pixels are all equal
digital space.x.bits samples follow bits of the sample read before
cross   space.follows.sample residuals follow the charge of another sample of the frame
cross   space.follows.line residuals follow the charge of a row, column or frame
digital space.misplaced.rows rows hold the samples of other pixels
digital space.misplaced.columns columns hold the samples of other pixels
digital space.repeated.rows rows repeat the one above exactly
digital space.repeated.columns columns repeat the one on the left exactly
"""
_SUBJECTS = {"charge": "electron numbers", "readout": "readout residuals"}


def _records() -> Iterator[str]:
    """Yield channel, name and sentence of every statistic, in the order of the vector."""
    for score in SCORES:
        channel, says, what = _SCORES[score]
        filled = _OF_A_SCORE.format(channel=channel, score=score, says=says, what=what)
        yield from filled.strip().splitlines()
    # indented lines go on with the one above
    for record in re.split(r"\n(?=\S)", _OTHERS.strip()):
        if record.startswith("both"):
            for channel, subject in _SUBJECTS.items():
                yield record.replace("both", channel, 1).format(channel, of=subject)
        else:
            yield record


def _statistic(record: str) -> Statistic:
    """Return a statistic of its record, whose opposite is empty where nothing depends on the sign."""
    channel, name, *words = record.split()
    more, less = (re.sub(r"\[(.*?)\|(.*?)\]", rf"\{sign}", " ".join(words)) for sign in (1, 2))
    return Statistic(name, cast(Channel, channel), more, "" if more == less else less)


class _Catalogue(dict[str, Statistic]):
    """Statistics by name; ``name@columns=30:40`` is the one of that name in a part of the sensor or run."""

    def __missing__(self, name: str) -> Statistic:
        """Return a statistic of a part; those are no members, since there are as many as there are parts."""
        whole, at, place = name.partition("@")
        if not at or whole not in self:
            raise KeyError(name)
        known = self[whole]
        words = ", ".join(each.words() for each in parse_place(place) if each is not None)
        more, less = (f"{known.says(sign)}, in {words}" for sign in (1.0, -1.0))
        return replace(known, name=name, sentence=more, opposite=less)


#: Every statistic by name, in the order of the vector.
STATISTICS: dict[str, Statistic] = _Catalogue((s.name, s) for s in map(_statistic, _records()))

#: Statistics that are exact tests, never positive by chance, and by how much each event raises them (rows
#: come by the dozen).
EXACT: dict[str, float] = {
    "frame.repeated": 10.0,
    "frame.repeated_rows": 160.0,
    "space.repeated.rows": 10.0,
    "space.repeated.columns": 10.0,
}
