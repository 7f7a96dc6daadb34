"""The statistics: every name, its family, its channel, where it shows, and a sentence.

Each is approximately N(0, 1) under the PCD; the order is that of the vector. ``VERSION`` is raised when a
statistic changes its definition, since vectors of different versions are not comparable.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.effects.framework.evidence import SCORES
from pchem_pipeline.effects.framework.region import parse_place

VERSION = 4

#: Families of statistics, in words.
FAMILIES = {
    "shape": "the shape of the histograms",
    "code": "the codes",
    "tail": "the tails",
    "time": "the order in time",
    "frame": "the frames",
    "space": "neighbours and lines",
}


@dataclass(frozen=True)
class Statistic:
    """One component of the vector."""

    name: str  # ``family.what``
    channel: str  # charge (electron numbers), readout (residuals), cross (their products) or digital (codes)
    sentence: str  # meaning of a large positive value
    opposite: str = ""  # meaning of a large negative value; empty: less than by chance
    map: str = ""  # of the evidence in which it shows its place (:mod:`~..where`); empty: none
    series: str = ""  # of the evidence in which it shows its frames; empty: none

    @property
    def family(self) -> str:
        """The part of the name before the first dot."""
        return self.name.partition(".")[0]

    def says(self, z: float) -> str:
        """Return the meaning of a value of this sign."""
        if not z < 0.0:
            return self.sentence
        return self.opposite or f"{self.sentence}, less than by chance"


#: Of each score its channel, the meaning of a positive [or negative] value, and of either.
_SCORES: dict[str, tuple[str, str, str]] = {
    "C2": ("charge", "electron numbers vary [more|less] than the model predicts",
           "the variance of electron numbers deviates from the model"),
    "C3": ("charge", "electron numbers are [more|less] skewed than the model predicts",
           "the skewness of electron numbers deviates from the model"),
    "He3": ("readout", "readout residuals are skewed to [high|low] DN",
            "readout residuals are skewed"),
    "He4": ("readout", "readout residuals have [heavy tails|lighter tails than a Gaussian]",
            "the tails of the readout residuals are not Gaussian"),
    "He2C1": ("cross", "peaks [widen|narrow] with electron number",
              "peak width changes with electron number"),
    "He1C2": ("cross", "peak spacing [grows|shrinks] with electron number",
              "peak spacing changes with electron number"),
    "He2C2": ("cross", "peak width grows [faster|slower] at high electron numbers",
              "peak width changes nonlinearly with electron number"),
    "He3C1": ("cross", "peak skewness [grows|falls] with electron number",
              "peak skewness changes with electron number"),
}  # fmt: skip
_OF_A_SCORE = """
{channel} shape.{score}.mean map=score.{score} {says} (mean over pixels)
{channel} shape.{score}.chi map=score.{score} {either} (sum of squares over pixels)
{channel} shape.{score}.cnt map=score.{score} {either}, in [more|fewer] pixels than by chance
{channel} shape.{score}.slope map=score.{score} {says}, increasingly with exposure
"""
#: All others: channel, name, map and series, and the meaning of a large positive [or negative] value. Those
#: of ``both`` are one for each of the charge and the readout, whose name, pairs and subject take the places
#: of ``{c}``, ``{p}`` and ``{of}``.
_OTHERS = """
digital shape.goodness.mean map=goodness histograms [deviate from the model|are closer to the model than
        sampling noise] (mean over pixels)
digital shape.goodness.chi map=goodness histograms deviate from the model (sum of squares over pixels)
digital shape.goodness.cnt map=goodness histograms deviate strongly from the model, in [more|fewer]
        pixels than by chance
readout shape.peaks.mean map=peaks the peaks of the histograms [deviate from the model|are closer to the
        model than sampling noise] (mean over pixels)
readout shape.peaks.chi map=peaks the peaks of the histograms deviate from the model (sum of squares over
        pixels)
readout shape.peaks.cnt map=peaks the peaks of the histograms deviate strongly from the model, in
        [more|fewer] pixels than by chance
digital code.rough counts deviate from the model from code to code
digital code.alternating counts of adjacent codes deviate from the model with [opposite signs|the same sign]
digital code.smooth counts deviate from the model smoothly along DN
digital code.period2 counts deviate from the model with a period of 2 DN
digital code.period4 counts deviate from the model with a period of 4 DN
digital code.period8 counts deviate from the model with a period of 8 DN
digital code.period16 counts deviate from the model with a period of 16 DN
digital code.largest the count of one code is an outlier
digital code.top samples pile up at the highest code (saturation)
digital code.bottom samples pile up at the lowest code (clipping)
readout tail.low.count too [many samples below the range|few samples at the low end] of the model
readout tail.low.pixels too [many|few] pixels with samples below the range of the model
charge  tail.high.count too [many samples above the range|few samples at the high end] of the model
charge  tail.high.pixels too [many|few] pixels with samples above the range of the model
charge  tail.high.clusters samples above the range of the model are adjacent in a frame
both    time.lag1.{c}.mean map=lag.{c} {of} of successive frames are [correlated|anticorrelated] (mean over
        pixels)
both    time.lag2.{c}.mean map=lag.{c} {of} of frames two apart are [correlated|anticorrelated] (mean over
        pixels)
both    time.lag3.{c}.mean {of} of frames three apart are [correlated|anticorrelated] (mean over pixels)
both    time.lag1.{c}.chi map=lag.{c} {of} of successive frames are correlated (sum of squares over
        pixels)
both    time.lag1.{c}.cnt map=lag.{c} {of} of successive frames are strongly correlated, in [more|fewer]
        pixels than by chance
cross   time.cross.readout_charge map=lag.cross residuals [rise|fall] with the charge of the frame before
cross   time.cross.readout_charge.chi map=lag.cross residuals change with the charge of the frame before
        (sum of squares over pixels)
cross   time.cross.charge_readout charge [rises|falls] with the residual of the frame before
digital time.nearer samples are [closer to|farther from] the previous sample than [to|from] others
cross   time.follows.sample residuals change with the charge of another pixel one frame before
cross   time.follows.line residuals change with the charge of a row, column or frame one frame before
both    time.block.{c}.chi map=spread.{c} block means of the {of} vary (sum of squares over pixels)
both    time.block.{c}.cnt map=spread.{c} block means of the {of} vary strongly, in [more|fewer]
        pixels than by chance
both    frame.{c}.variance map=x.{p} series=scatter.{c} frame means of the {of} scatter [more|less] than
        independent pixels
both    frame.{c}.lag1 series=frame.{c} frame means of the {of} are [correlated|anticorrelated] with the frame
        before
both    frame.{c}.slow map=spread.{c} series=frame.{c} frame means of the {of} drift
both    frame.{c}.trend map=trend.{c} series=frame.{c} frame means of the {of} [rise|fall] along the run
both    frame.{c}.line series=frame.{c} the largest power in the spectrum of the frame
        means of the {of} is [above|below] that of the model
both    frame.{c}.alternating series=frame.{c} frame means of the {of} are higher in [even|odd] frames
both    frame.{c}.largest series=frame.{c} one frame mean of the {of} is an outlier
both    frame.{c}.quadrants map=trend.{c} series=frame.{c} quadrants vary differently along the run in
        the {of}
cross   frame.covariance series=scatter.charge frame means of charge and residual are
        [correlated|anticorrelated]
cross   frame.follows.line series=scatter.readout frame means of the residuals change with the charge of a row
        or column
cross   frame.gain.slow the gain drifts
cross   frame.gain.trend the gain [rises|falls] along the run
readout frame.noise.variance series=frame.noise read noise varies [more|less] from frame to frame than
        sampling noise
readout frame.noise.slow series=frame.noise the read noise drifts
digital frame.repeated frames are exact copies of the frame before
digital frame.repeated_rows rows are exact copies of the frame before
both    space.row.{c}.variance map=x.{p} series=row.{c} row means of the {of} scatter [more|less] than
        independent pixels
both    space.row.{c}.lag1 map=x.{p} series=row.{c} row means of the {of} are [correlated|anticorrelated]
        with the adjacent row
both    space.row.{c}.halves map=x.{p} series=row.{c} means of both halves of a row of the {of} are
        [correlated|anticorrelated]
both    space.column.{c}.variance map=y.{p} series=column.{c} column means of the {of} scatter [more|less]
        than independent pixels
both    space.column.{c}.lag1 map=y.{p} series=column.{c} column means of the {of} are
        [correlated|anticorrelated] with the adjacent column
readout space.row.readout.line map=x.rr series=row.readout the largest power in the
        spectrum of the row means of the readout residuals is [above|below] that of the model
readout space.column.readout.line map=y.rr series=column.readout the largest power in the
        spectrum of the column means of the readout residuals is [above|below] that of the model
readout space.sample.readout.line readout residuals have a periodic part along rows, columns or frames
readout space.sample.readout.spectrum readout residuals of a frame are correlated at some distance
charge  space.x.kk map=x.kk series=row.charge electron numbers of neighbours are
        [correlated|anticorrelated], along x
readout space.x.rr map=x.rr series=row.readout residuals of neighbours are [correlated|anticorrelated],
        along x
cross   space.x.rk map=x.rk residuals [rise|fall] with the charge of the neighbour, along x
charge  space.y.kk map=y.kk series=column.charge electron numbers of neighbours are
        [correlated|anticorrelated], along y
readout space.y.rr map=y.rr series=column.readout residuals of neighbours are [correlated|anticorrelated],
        along y
cross   space.y.rk map=y.rk residuals [rise|fall] with the charge of the neighbour, along y
readout space.row.noise.variance series=frame.noise read noise varies [more|less] between the rows of a
        frame than sampling noise
readout space.column.noise.variance series=frame.noise read noise varies [more|less] between the columns of
        a frame than sampling noise
digital space.predicted.equal too [many|few] samples equal the prediction from their neighbours
digital space.predicted.above too [many|few] samples far exceed the prediction from their neighbours
digital space.equal.squares samples of squares of 2 x 2 pixels are all equal
digital space.x.bits samples depend on bits of the previous sample of the row
cross   space.follows.sample residuals change with the charge of another sample of the frame
cross   space.follows.line residuals change with the charge of a row, column or frame
digital space.misplaced.rows rows contain samples of other pixels
digital space.misplaced.columns columns contain samples of other pixels
digital space.repeated.rows rows are exact copies of the row above
digital space.repeated.columns columns are exact copies of the column on the left
"""
_SUBJECTS = {"charge": ("electron numbers", "kk"), "readout": ("readout residuals", "rr")}


def _records() -> Iterator[str]:
    """Yield channel, name and sentence of every statistic, in the order of the vector."""
    for score in SCORES:
        channel, says, either = _SCORES[score]
        filled = _OF_A_SCORE.format(channel=channel, score=score, says=says, either=either)
        yield from filled.strip().splitlines()
    # indented lines go on with the one above
    for record in re.split(r"\n(?=\S)", _OTHERS.strip()):
        if record.startswith("both"):
            for channel, (subject, pair) in _SUBJECTS.items():
                yield record.replace("both", channel, 1).format(c=channel, of=subject, p=pair)
        else:
            yield record


def _statistic(record: str) -> Statistic:
    """Make a statistic from its record; without brackets its opposite is empty."""
    channel, name, *words = record.split()
    shown = dict(words.pop(0).split("=") for _ in range(2) if words[0].startswith(("map=", "series=")))
    more, less = (re.sub(r"\[(.*?)\|(.*?)\]", rf"\{sign}", " ".join(words)) for sign in (1, 2))
    return Statistic(name, channel, more, "" if more == less else less, **shown)


class _Catalogue(dict[str, Statistic]):
    """Statistics by name; ``name@columns=30:40`` is the same in a part of the sensor or run."""

    def __missing__(self, name: str) -> Statistic:
        """Make the statistic of a part; there are too many parts to be members."""
        whole, at, place = name.partition("@")
        if not at or whole not in self:
            raise KeyError(name)
        known = self[whole]
        words = ", ".join(each.describe() for each in parse_place(place) if each is not None)
        more, less = (f"{known.says(sign)}, in {words}" for sign in (1.0, -1.0))
        return replace(known, name=name, sentence=more, opposite=less)


#: Every statistic by name, in the order of the vector.
STATISTICS: dict[str, Statistic] = _Catalogue((s.name, s) for s in map(_statistic, _records()))


def check_signature(signature: Sequence[str]) -> None:
    """Raise ConfigError where the signature of an effect names what is no statistic."""
    if unknown := [name for name in signature if name not in STATISTICS]:
        raise ConfigError(
            f"its signature names no statistics: {', '.join(unknown)}; they are listed in "
            "pchem_pipeline/discrepancy/observe/catalogue.py"
        )


#: Exact tests without false positives, and the increase by each event (rows come by the dozen).
EXACT: dict[str, float] = {
    "frame.repeated": 10.0,
    "frame.repeated_rows": 160.0,
    "space.repeated.rows": 10.0,
    "space.repeated.columns": 10.0,
}
