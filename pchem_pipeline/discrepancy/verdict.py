"""The verdict of a search for missing effects: the content of ``discrepancy.json``, written and read here.

The keys of the JSON are the names of the fields; an unknown number is ``null`` there and NaN here. A new key
either has a default for older files or raises :data:`SCHEMA_VERSION`; files of another schema are refused.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, PlainSerializer, ValidationError

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.errors import StoreError, error_words
from pchem_pipeline.base.wording import count, measured, percent, short
from pchem_pipeline.discrepancy.observe.catalogue import FAMILIES, STATISTICS
from pchem_pipeline.effects.framework.compose import AddedExposure
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps
from pchem_pipeline.effects.framework.region import Region, When

#: Value of the field ``schema_version`` of :class:`Verdict`.
SCHEMA_VERSION = 3
#: Share of changed samples below which the size of an effect is its rms over the changed samples only.
RARE = 0.5
_TIMES = 2.0  # read noises from which a size is given as a multiple instead of in per cent
#: Largest number of statistics whose pulls before and after are stored and drawn.
MOST_PULLS = 12
#: Factors of an effect in words.
FACTORS = {"changes": "what changes", "shared_by": "what shares it", "varies": "how it varies"}
#: File of the verdict in the folder of a run.
VERDICT_FILE = "discrepancy.json"

State = Literal[
    "named", "named_in_part", "ambiguous", "described", "unexplained", "consistent", "cannot_tell"
]

_NAN = float("nan")
Number = Annotated[
    float,
    BeforeValidator(lambda value: _NAN if value is None else value),
    PlainSerializer(lambda value: value if math.isfinite(value) else None, when_used="json"),
]
Interval = tuple[Number, Number]


class _Part(BaseModel):
    """A frozen part of the verdict; unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Measured(_Part):
    """A parameter of an effect with its standard error, NaN if it was not fitted."""

    value: Number
    stderr: Number = _NAN
    unit: str = ""


class Candidate(_Part):
    """An effect that was compared, by its tag and fields, with its posterior probability among all of them.

    The score is the held-out log-likelihood minus that of the best effect, nats, with its standard error.
    """

    effect: str
    score: Number
    stderr: Number
    probability: Number
    parameters: dict[str, Any] = {}

    @classmethod
    def of(cls, effect: Effect, score: float, stderr: float, probability: float) -> Candidate:
        """Make the entry of an effect from its score."""
        return cls(
            effect=effect.tag,
            score=score,
            stderr=stderr,
            probability=probability,
            parameters=effect.model_dump(mode="json", exclude={"tag"}),
        )


class Size(_Part):
    """Root mean square change of the samples by an effect, around each pixel's mean change.

    It is given in e-, in DN and over the median read noise. The average is over the changed samples only if
    their share ``samples`` within the effect's region and frames is below :data:`RARE`.
    """

    electrons: Number
    dn: Number
    of_read_noise: Number
    samples: Number = 1.0

    def words(self) -> str:
        """Describe the size: ``samples change by 0.5 DN rms, 22 % of the median read noise``."""
        rare = f"{percent(self.samples)} of the samples in its region and frames"
        which, share = "samples" if self.samples >= RARE else rare, self.of_read_noise
        times = f"{percent(share)} of" if share < _TIMES else f"{short(share, 2)} times"
        return f"{which} change by {short(self.dn, 2)} DN rms, {times} the median read noise"


class Rival(_Part):
    """Another effect (its tag) fitted instead of the named one, in the same way, and why it is rejected.

    ``gap_after`` is the remaining gap, nats per sample, ``behind`` the log-likelihood minus that of the named
    one, nats; NaN if it was not scored.
    """

    effect: str
    gap_after: Number
    behind: Number = _NAN
    why: str = ""


class Moved(_Part):
    """Change of the median of a parameter map, in its unit and in standard errors per pixel."""

    median: Number
    in_stderr: Number
    unit: str = ""


class Pull(_Part):
    """A statistic before and after effects were added, in standard deviations under the model (sigma)."""

    statistic: str
    sentence: str
    before: Number
    after: Number


class Place(_Part):
    """A disagreement of data and model: a statistic, and its pixels, codes or frames."""

    statistic: str  # its name, words and channel in the catalogue
    sentence: str = ""
    channel: str = ""
    direction: str = ""  # "+" or "-"
    z: Number = _NAN  # deviation from the expectation under the model, standard deviations
    p: Number = _NAN  # p-value, corrected for the number of statistics
    pixels: tuple[tuple[int, int], ...] = ()  # (y, x) on the sensor, if few pixels deviate
    dn: tuple[int, int] | None = None  # first and last code, if codes deviate
    frames: tuple[int, ...] = ()  # frame numbers, if few frames deviate
    seen: Number = _NAN  # number of samples in these codes, if counted
    expected: Number = _NAN  # the same under the model
    share_of_gap: Number = _NAN  # share of the remaining gap, if measured
    region: dict[str, Any] | None = None  # part of the sensor where its map deviates; None: uniform
    region_p: Number = _NAN  # p-value of the region, corrected for the number of regions searched
    region_share: Number = _NAN  # lower 95 % limit of the share of deviating pixels in the region
    when: dict[str, Any] | None = None  # frames where its series deviates; None: uniform
    when_p: Number = _NAN  # p-value of these frames, corrected in the same way

    @classmethod
    def of(cls, statistic: str, z: float, **more: Any) -> Place:
        """Make a place with the sentence and channel of its statistic in the catalogue."""
        known = STATISTICS[statistic]
        words = {"sentence": known.says(z), "channel": known.channel, "direction": "+" if z > 0 else "-"}
        return cls(statistic=statistic, z=z, **(words | more))

    def spot(self) -> str:
        """Describe region and frames; empty if uniform."""
        # pixels listed one by one are in :attr:`pixels`
        listed = self.region is None or ("pixels" in self.region and self.pixels)
        parts = [] if listed else [Region.model_validate(self.region).describe()]
        parts += [] if self.when is None else [When.model_validate(self.when).describe()]
        # other statistics than those of a part may deviate elsewhere, too, and less
        most = "mainly in " if parts and "@" not in self.statistic else ""
        return f"{most}{', '.join(parts)}"

    def shifted(self, shape: tuple[int, int], rows: tuple[int, int], columns: tuple[int, int]) -> Place:
        """Return a copy with its region in coordinates of the sensor."""
        # statistics of a part have sensor coordinates already
        if self.region is None or "@" in self.statistic or (rows, columns) == ((0, shape[0]), (0, shape[1])):
            return self
        mask = np.zeros(shape, np.bool_)
        inside = mask[slice(*rows), slice(*columns)]
        inside[...] = Region.model_validate(self.region).mask(inside.shape)
        return self.model_copy(update={"region": Region.of_mask(mask).numbers()})


class Families(_Part):
    """Contribution of each family of statistics to the gap before and after, nats per sample."""

    before: dict[str, Number] = {}
    after: dict[str, Number] = {}


def closed_share(before: float, after: float) -> float:
    """Compute ``1 - after / before``, limited to 0 ... 1; 0 without a gap before."""
    return min(max(1.0 - max(after, 0.0) / before, 0.0), 1.0) if before > 0.0 else 0.0


def families_words(families: Sequence[str]) -> str:
    """Describe families of statistics."""
    return " and ".join(FAMILIES.get(family, family) for family in families)


class GapChange(_Part):
    """The gap on held-out samples, before and after effects were added; see :mod:`.gap`."""

    unit: str = "nats/sample"  # unit of all numbers except ``closed_fraction`` (:func:`closed_share`)
    before: Number
    after: Number
    floor: Number  # 95 % quantile of sampling noise under the model
    closed_fraction: Number
    interval_before: Interval = (_NAN, _NAN)  # 95 % interval
    interval_after: Interval = (_NAN, _NAN)  # 95 % interval
    standing_out: tuple[str, ...] = ()  # families that are significant by themselves with the effects

    @property
    def after_text(self) -> str:
        """The gap with the effects, micronats: ``< 13`` where it is within sampling noise of up to 13."""
        reached = self.after <= self.floor < self.before
        return f"< {micronats(self.floor)}" if reached else micronats(self.after, self.interval_after)


class Change(_Part):
    """A p-value before and after effects were added."""

    before: Number
    after: Number


class Surveyed(_Part):
    """A part of the sensor in which a map of all pixels, from all frames, deviates.

    Attributes:
        map: next_x or next_y (covariance with the next pixel), lag (covariance with the frame before), spread
            (scatter of block means), score.* and goodness (shape of the histograms), pairs.row.readout and so
            on (covariance of pixels in a row, column or frame), unfitted (pixels without a reliable fit).
        region: as in ``model.effects``.
        p: p-value, corrected for the number of regions searched.
    """

    map: str
    region: dict[str, Any]
    p: Number


def _window(rows: tuple[int, int], columns: tuple[int, int]) -> str:
    """Describe a window, first and end of each."""
    return f"rows {rows[0]} to {rows[1] - 1}, columns {columns[0]} to {columns[1] - 1}"


class Elsewhere(_Part):
    """Test of the final model in another window (first and end); ``deviates`` says what disagrees there."""

    rows: tuple[int, int]
    columns: tuple[int, int]
    deviates: str = ""

    def words(self) -> str:
        """Describe the window."""
        return _window(self.rows, self.columns)

    def says(self) -> str:
        """Describe the window and the result."""
        found = f"the model does not hold: {self.deviates}" if self.deviates else "the model holds"
        return f"tested again in {self.words()}: {found}"


class Examined(_Part):
    """The samples that were examined."""

    frames: int  # number of frames; of histograms the largest number of samples
    rows: tuple[int, int]  # first and end on the sensor
    columns: tuple[int, int]  # first and end on the sensor
    train: int  # frames (of histograms: samples) to fit
    test: int  # those to score
    final: int  # those to measure the final gap
    histograms: int | None = None  # number of histograms, if frames are unknown; those of all exposures count
    share: Number = _NAN  # share of the run's samples compared with simulations
    surveyed: Number = _NAN  # share of the run's samples in every survey of ``surveyed_by``, or compared
    surveyed_by: dict[str, Number] = {}  # share of the run's samples by survey of the whole sensor
    places: tuple[Surveyed, ...] = ()  # deviating parts of the sensor in these surveys
    unfitted: int = 0  # number of pixels left out for lack of a reliable fit
    elsewhere: Elsewhere | None = None  # test of the model in another window; None: not done
    left_out: tuple[int, ...] = ()  # empty, repeated, outlying and moved frames
    compared: int = 0  # number of effects compared with them

    @property
    def origin(self) -> tuple[int, int]:
        """First row and column."""
        return self.rows[0], self.columns[0]

    def words(self) -> str:
        """Describe the samples, what became of the others, and how many effects were compared."""
        effects = f"; {self.compared} of the known effects compared" if self.compared else ""
        dealt = f"{self.train:,} for training, {self.test:,} for testing, {self.final:,} for the gap"
        if self.histograms is not None:
            return f"{count(self.histograms, 'histogram')}, samples split at random: {dealt}{effects}."
        share = f" ({percent(self.share)} of the run's samples)" if self.share < 1.0 else ""
        place = _window(self.rows, self.columns)
        rest = self.frames - self.train - self.test - self.final
        over = f"; {rest} unused" if rest > 0 else ""
        words = f"{count(self.frames, 'frame')} of {place}{share}: {dealt}{over}{effects}."
        if self.elsewhere is not None:
            words += f" The final model was {self.elsewhere.says()}."
        if self.unfitted:
            spot = next((place for place in self.places if place.map == "unfitted"), None)
            where = "" if spot is None else f", clustered in {Region.model_validate(spot.region).describe()}"
            words += f" Not compared: {count(self.unfitted, 'pixel')} without a reliable fit{where}."
        return words


class Step(_Part):
    """An effect added to the model, or several between which the data do not decide."""

    # a key that only older files have is left out
    model_config = ConfigDict(extra="ignore")

    effect: str | None  # tag of the named effect; None if ambiguous or rejected
    verdict: State  # verdict of this step alone
    why: str = ""  # reason of its rejection; empty if it is not rejected
    candidates: tuple[Candidate, ...]  # effects compared, the likeliest first
    parameters: dict[str, Measured]  # parameters of the named or the likeliest effect
    form: dict[str, str] = {}  # its text fields that differ from their default
    factors: dict[str, tuple[str, ...]] = {}  # all values among the candidates; one is certain
    place: str = ""  # region and frames in words; empty: everywhere, always
    gap_before: Number  # gap on the final samples without it, nats per sample
    gap_after: Number  # the same with it
    gap_floor: Number  # its floor
    gap_interval_after: Interval = (_NAN, _NAN)  # 95 % interval of the gap with it
    size: Size | None = None  # size of the effect; None if unknown
    families: Families = Families()  # the gap by family of statistics
    rivals: tuple[Rival, ...] = ()  # the next best effects, the best first, each fitted instead of it
    moved: dict[str, Moved] = {}  # change of each parameter map by the refit with the effect
    separate: dict[str, str] = {}  # by effect, the measurement that would distinguish it
    pulls: tuple[Pull, ...] = ()  # the statistics that change most

    @property
    def runner_up(self) -> Rival | None:
        """The next best effect."""
        return self.rivals[0] if self.rivals else None

    @property
    def likeliest(self) -> str:
        """Tag of the named effect, else of the likeliest candidate; empty if there is none."""
        return self.effect or next((c.effect for c in self.candidates), "")


class Verdict(_Part):
    """The content of ``discrepancy.json``.

    Attributes:
        verdict: named (the remaining gap is within sampling noise), named_in_part (reduced by
            ``gap.closed_fraction``), ambiguous, described (an empirical description without a cause),
            unexplained, consistent, or cannot_tell (the pixels' parameters are not identified, and no
            statistic that is independent of them deviates).
        doubt: why the pixels' parameters are not identified, and the cure; empty if they are.
        limit: what was not tried when the search had used its budget; empty if it finished.
        sentence: the verdict in one sentence.
        effects: tags of the named effects.
        model_effects: all effects of the model afterwards, as in the YAML.
        proposed: empirical effects that do not explain everything; not in the model.
        steps: added effects, the largest first.
        gap: without new effects and with all.
        where: disagreements with the model before the search.
        unexplained: remaining disagreements.
        set_aside: intervals of (x - bias) * gain, e-, whose codes the fit leaves out; None: no limit.
        untestable: effects that such data cannot show, and why.
        defects: candidates that failed, and their errors.
        examined: the samples that were examined.
        p_global: p-value of the largest deviation.
        replicates: number of simulated stacks or histograms.
        work: counted work, CPU seconds of a core of about 2020: the same on any machine.
        versions: versions on which the verdict depends.
    """

    schema_version: Literal[3] = 3
    verdict: State
    sentence: str
    doubt: str = ""
    limit: str = ""
    effects: tuple[str, ...]
    model_effects: tuple[dict[str, Any], ...]
    proposed: tuple[dict[str, Any], ...] = ()
    steps: tuple[Step, ...]
    gap: GapChange
    where: tuple[Place, ...]
    unexplained: tuple[Place, ...]
    set_aside: tuple[tuple[float | None, float | None], ...] = ()
    untestable: dict[str, str]
    defects: dict[str, str]
    examined: Examined
    p_global: Change
    replicates: int
    work: Number = _NAN
    versions: dict[str, int | str]

    def to_json(self) -> str:
        """Write the content of ``discrepancy.json``."""
        return self.model_dump_json(indent=1)

    @classmethod
    def from_json(cls, text: str, source: str = VERDICT_FILE) -> Verdict:
        """Read the content of ``discrepancy.json``; the message of an error names its ``source``.

        Raises:
            StoreError: it is damaged, or of another schema.
        """
        cure = "run pchem discrepancy with --force"
        try:
            content = json.loads(text)
        except ValueError as error:
            raise StoreError(f"{source} is damaged ({error}); {cure}") from error
        if not isinstance(content, dict):
            raise StoreError(f"{source} holds no verdict; {cure}")
        version = content.get("schema_version", content.get("schema"))
        if isinstance(version, int) and version != SCHEMA_VERSION:
            raise StoreError(
                f"{source} holds a verdict of schema {version}, this program reads schema {SCHEMA_VERSION}; "
                f"use the version that wrote it, or {cure}"
            )
        try:
            return cls.model_validate(content)
        except ValidationError as error:
            raise StoreError(f"{source} is damaged ({error_words(error)}); {cure}") from error

    @property
    def closed_in_model(self) -> float:
        """Relative reduction of the gap by the effects in the final model."""
        if not self.proposed:
            return self.gap.closed_fraction
        named = [step for step in self.steps if step.verdict != "described"]
        return closed_share(self.gap.before, named[-1].gap_after) if named else 0.0

    def part_of_model(self, step: Step) -> bool:
        """Return whether the effect of a step is in the final model: named, or a complete description."""
        return step.effect is not None or (step.verdict == "described" and not self.proposed)

    @property
    def closed_by(self) -> str:
        """The effects, by tag, that close most of a gap though they are rejected; empty if they are not."""
        names = " + ".join(step.likeliest for step in self.steps)
        return f" by {names}, rejected" if self.verdict == "unexplained" else ""

    @property
    def word(self) -> str:
        """The verdict with spaces."""
        return self.verdict.replace("_", " ")

    def __repr__(self) -> str:
        return f"<Verdict {self.word}: {self.sentence}>"

    def _repr_html_(self) -> str:
        """Return verdict and disagreements as HTML for a notebook."""
        rows = "".join(
            f"<li>{escape(place.sentence or place.statistic)} ({sigma_text(place.z)})</li>"
            for place in self.where
        )
        return f"<p><b>{escape(self.word.capitalize())}</b>. {escape(self.sentence)}</p><ul>{rows}</ul>"

    def added(self, step: Step) -> str:
        """Return the effect that a step added, or the likeliest of several."""
        if step.effect:
            return step.effect
        rivals = list(dict.fromkeys(c.effect for c in step.candidates))[:3]
        if not rivals or self.verdict in ("consistent", "cannot_tell"):
            return ""
        return f"nearest: {rivals[0]}" if step.verdict == "unexplained" else " or ".join(rivals)

    def costing(self, work: float) -> Verdict:
        """Return a copy with the counted work of the whole search, CPU seconds."""
        return self.model_copy(update={"work": round(work, 1)})

    def checked(self, elsewhere: Elsewhere) -> Verdict:
        """Return a copy with the test of the model in another window of the sensor."""
        changes: dict[str, Any] = {"examined": self.examined.model_copy(update={"elsewhere": elsewhere})}
        if elsewhere.deviates:
            not_there = f"; it does not hold in {elsewhere.words()}, where {elsewhere.deviates}."
            changes["sentence"] = self.sentence.removesuffix(".") + not_there
            if self.verdict == "named":
                changes["verdict"] = "named_in_part"
        return self.model_copy(update=changes)

    def in_hertz(self, line_time: float) -> Verdict:
        """Return a copy with the frequency of what is periodic along rows that are ``line_time`` s apart."""

        def timed(step: Step) -> Step:
            cycles = step.parameters.get("cycles_per_row")
            if cycles is None:
                return step
            hertz, error = abs(cycles.value) / line_time, cycles.stderr / line_time
            frequency = Measured(value=hertz, stderr=error, unit="Hz")
            return step.model_copy(update={"parameters": {**step.parameters, "frequency": frequency}})

        return self.model_copy(update={"steps": tuple(map(timed, self.steps))})

    def on_sensor(
        self,
        shape: tuple[int, int],
        rows: tuple[int, int],
        columns: tuple[int, int],
        pixel: Callable[[int, int], tuple[int, int]],
    ) -> Verdict:
        """Return a copy in coordinates of a sensor of this shape, of which these rows, columns were examined.

        ``pixel`` maps (y, x) in the examined window to (y, x) on the sensor.
        """

        def moved(place: Place) -> Place:
            pixels = tuple(dict.fromkeys(pixel(y, x) for y, x in place.pixels))
            return place.shifted(shape, rows, columns).model_copy(update={"pixels": pixels})

        examined = self.examined.model_copy(update={"rows": rows, "columns": columns})
        where = tuple(moved(place) for place in self.where)
        return self.model_copy(update={"examined": examined, "where": where})


def micronats(gap: float, interval: Interval = (_NAN, _NAN)) -> str:
    """Format a gap in micronats, with a standard error if its 95 % interval is known; else not below 0."""
    error = 1e6 * (interval[1] - interval[0]) / 3.92
    if math.isfinite(gap) and error > 0.0:
        large = f"{1e6 * gap:,.0f} ± {error:,.0f}".replace("-", "−")
        return large if 9.95 <= error < math.inf else measured(1e6 * gap, error)
    value = 1e6 * max(gap, 0.0)
    return "not known" if not math.isfinite(gap) else f"{value:,.0f}" if value >= 100.0 else f"{value:.2g}"


def sigma_text(z: float) -> str:
    """Format the size of a deviation in standard deviations; its direction is in the sentence beside it."""
    return f"{abs(z):.{1 if abs(z) < 9.95 else 0}f} sigma" if math.isfinite(z) else "sigma not known"


def read_verdict(folder: Path) -> Verdict | None:
    """Read the verdict of a run, or return None if there is none.

    Raises:
        StoreError: it cannot be read.
    """
    path = folder / VERDICT_FILE
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise StoreError(f"{path} is damaged ({error}); run pchem discrepancy with --force") from error
    return Verdict.from_json(text, str(path))


def parameters_of(effect: Effect, errors: Mapping[str, float]) -> dict[str, Measured]:
    """Return the fitted or chosen parameters of an effect, its strength first, with their standard errors.

    Those at their default say nothing, or have no meaning in this form of the effect.
    """
    fields = type(effect).model_fields
    numbers = effect.model_dump(exclude={"tag"})
    return {
        name: Measured(
            value=value, stderr=errors.get(name, _NAN), unit=effect.unit(name).removeprefix("none")
        )
        for name, value in sorted(numbers.items(), key=lambda item: item[0] != effect.strength)
        if isinstance(value, int | float) and not isinstance(value, bool)
        if name in (*errors, effect.strength) or value != fields[name].default
    }


def form_of(effect: Effect) -> dict[str, str]:
    """Return the text fields of an effect, such as the shape of a drift, that differ from their default."""
    fields = type(effect).model_fields
    return {
        name: value
        for name, value in effect.model_dump(exclude={"tag"}).items()
        if isinstance(value, str) and value != fields[name].default
    }


@dataclass(frozen=True)
class Discrepancy:
    """A verdict with its evidence.

    Attributes:
        model: effects of the final model, earlier ones included.
        maps: parameters of the examined pixels under the final model.
        evidence: statistics of the train samples.
        statistics: names, and deviations before and after, for figures.
        code_extended: samples expected at each code of ``evidence.code`` under the final model; None if
            nothing was added or the model has no pmf.
        added: exposure that effects add to single pixels on top of the H of ``maps``; None: nothing.
    """

    verdict: Verdict
    model: tuple[Effect, ...]
    maps: PixelMaps
    evidence: Evidence
    statistics: tuple[tuple[str, ...], FloatArray, FloatArray]
    code_extended: FloatArray | None = None
    added: AddedExposure | None = None
