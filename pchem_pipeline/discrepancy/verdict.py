"""The verdict of a search for missing effects: the content of ``discrepancy.json``, written and read here.

The keys of the JSON are the names of the fields; a number that is not known is ``null`` there and NaN here.
Whoever adds a key adds it here, and nowhere else; one that older files lack has a default, or raises
:data:`SCHEMA_VERSION`, and files of another schema are refused.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, PlainSerializer, ValidationError

from pchem_pipeline.base.errors import StoreError
from pchem_pipeline.base.units import per_cent
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.effects.framework.added_exposure import AddedExposure
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps
from pchem_pipeline.effects.framework.region import Region, When

#: As the field ``schema_version`` of :class:`Verdict` has it.
SCHEMA_VERSION = 3
#: Share of the samples below which the size of an effect is that of the samples that it changes.
RARE = 0.5
_TIMES = 2.0  # the read noise, from which on a size is no longer told in per cent
#: Share of what an effect closes, from which on an unrelated one that closes as much weakens its name.
CONVINCING_PLACEBO = 0.25
#: Statistics whose pulls before and after are told and drawn.
MOST_PULLS = 12
#: File of the verdict in the folder of a run.
VERDICT_FILE = "discrepancy.json"

State = Literal[
    "named", "named_in_part", "ambiguous", "described", "unexplained", "consistent", "cannot_tell"
]

_NAN = float("nan")


def _number(value: Any) -> Any:
    return _NAN if value is None else value


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _two_digits(value: float) -> str:
    """Return a number to two digits, in full: 0.035, 21, 2,000."""
    return f"{value:.2g}" if abs(value) < 99.5 else f"{float(f'{value:.2g}'):,.0f}"


Number = Annotated[float, BeforeValidator(_number), PlainSerializer(_finite, when_used="json")]
Interval = tuple[Number, Number]


class _Part(BaseModel):
    """A frozen part of the verdict; unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Measured(_Part):
    """A number of an effect with its standard error; NaN for one that was not fitted."""

    value: Number
    stderr: Number = _NAN
    unit: str = ""


class Candidate(_Part):
    """An effect that was compared, and how well it explains samples that it was not fitted to.

    Attributes:
        effect: its tag.
        score: held-out log score against the chosen one, nats (0 for the chosen one).
        stderr: of that difference, nats.
        probability: among all candidates.
        parameters: the fields of the effect.
    """

    effect: str
    score: Number
    stderr: Number
    probability: Number
    parameters: dict[str, Any] = {}

    @classmethod
    def of(cls, effect: Effect, score: float, stderr: float, probability: float) -> Candidate:
        """Return an effect with its score."""
        return cls(
            effect=effect.tag,
            score=score,
            stderr=stderr,
            probability=probability,
            parameters=effect.model_dump(mode="json", exclude={"tag"}),
        )


class Size(_Part):
    """By how much an effect changes the samples, about a pixel's mean change; a rare one those that it does.

    Attributes:
        electrons: e-.
        dn: DN.
        of_read_noise: share of the median read noise.
        samples: share of the samples that it changes, where and when it acts.
    """

    electrons: Number
    dn: Number
    of_read_noise: Number
    samples: Number = 1.0

    def words(self) -> str:
        """Return it for people."""
        most = f"{_two_digits(self.dn)} DN rms ({_two_digits(self.electrons)} e-, {self.beside_noise()})"
        return most if self.samples >= RARE else f"{most} in {per_cent(self.samples)} of the samples"

    def beside_noise(self) -> str:
        """Return it as a share of the read noise, or how many times as large it is."""
        share = self.of_read_noise
        times = f"{per_cent(share)} of" if share < _TIMES else f"{_two_digits(share)} times"
        return f"{times} the read noise"


class Rival(_Part):
    """Another effect added in the place of the named one, fitted in the same way.

    Attributes:
        effect: its tag.
        gap_after: the gap that it leaves, nats per sample.
        behind: log score behind the chosen one, nats; NaN where it was not scored.
        why: what it leaves of the data, or why it could not decide.
    """

    effect: str
    gap_after: Number
    behind: Number = _NAN
    why: str = ""


class Moved(_Part):
    """Change of the median of a delivered parameter, in its unit and in standard errors of a pixel."""

    median: Number
    in_stderr: Number
    unit: str = ""


class Pull(_Part):
    """A statistic before and after effects were added, in standard deviations of chance."""

    statistic: str
    sentence: str
    before: Number
    after: Number


class Place(_Part):
    """A disagreement of data and model: a statistic, and the pixels, codes or frames that carry it.

    Attributes:
        statistic: its name in the catalogue.
        sentence: what it says.
        channel: charge, readout, ...
        direction: "+" or "-".
        z: deviation from what the model gives, standard deviations.
        p: probability of any statistic deviating so much by chance.
        pixels: (y, x) on the sensor, where it is a matter of few pixels.
        dn: first and last code, where it is a matter of codes.
        frames: frame numbers, where it is a matter of few frames.
        seen, expected: samples in these codes, where they were counted.
        share_of_gap: share of the gap that is left, where it was measured.
        region: where on the sensor its map stands out from the rest, as ``model.effects`` takes a region;
            None: everywhere alike, or it has no map.
        region_p: probability of such a place by chance, anywhere.
        region_share: share of the region's pixels that deviate, at least (at 95 %).
        when: frames in which its series stands out, as ``model.effects`` takes them; None: always alike.
        when_p: probability of such frames by chance.
    """

    statistic: str
    sentence: str = ""
    channel: str = ""
    direction: str = ""
    z: Number = _NAN
    p: Number = _NAN
    pixels: tuple[tuple[int, int], ...] = ()
    dn: tuple[int, int] | None = None
    frames: tuple[int, ...] = ()
    seen: Number = _NAN
    expected: Number = _NAN
    share_of_gap: Number = _NAN
    region: dict[str, Any] | None = None
    region_p: Number = _NAN
    region_share: Number = _NAN
    when: dict[str, Any] | None = None
    when_p: Number = _NAN

    @classmethod
    def of(cls, statistic: str, z: float, **more: Any) -> Place:
        """Return a place with the sentence and the channel that the catalogue has for its statistic."""
        known = STATISTICS[statistic]
        words = {"sentence": known.says(z), "channel": known.channel, "direction": "+" if z > 0 else "-"}
        return cls(statistic=statistic, z=z, **{**words, **more})

    def spot(self) -> str:
        """Return region and frames in words; empty where it is everywhere and always alike."""
        # pixels that are listed one by one are told by :attr:`pixels`
        listed = self.region is None or ("pixels" in self.region and self.pixels)
        parts = [] if listed else [Region.model_validate(self.region).describe()]
        parts += [] if self.when is None else [When.model_validate(self.when).describe()]
        # a statistic of a part has only that; another one may be there elsewhere, too, and weaker
        most = "most in " if parts and "@" not in self.statistic else ""
        return f"{most}{', '.join(parts)}"

    def shifted(self, shape: tuple[int, int], rows: tuple[int, int], columns: tuple[int, int]) -> Place:
        """Return it with its region counted from the corner of a sensor of some shape."""
        # a statistic of a part is told on the sensor
        if self.region is None or "@" in self.statistic or (rows, columns) == ((0, shape[0]), (0, shape[1])):
            return self
        mask = np.zeros(shape, np.bool_)
        inside = mask[slice(*rows), slice(*columns)]
        inside[...] = Region.model_validate(self.region).mask(inside.shape)
        return self.model_copy(update={"region": Region.of_mask(mask).numbers()})


class Families(_Part):
    """The contribution of each family of statistics to the gap before and after, nats per sample."""

    before: dict[str, Number] = {}
    after: dict[str, Number] = {}


#: What the families of statistics are of.
_FAMILIES = {
    "shape": "the shape of the histograms",
    "code": "the codes",
    "tail": "the tails",
    "time": "the order in time",
    "frame": "the frames",
    "space": "neighbours and lines",
}


def closed_share(before: float, after: float) -> float:
    """Return the share of a gap that is closed, 0 to 1; 0 where there is none or it grew."""
    return min(max(1.0 - max(after, 0.0) / before, 0.0), 1.0) if before > 0.0 else 0.0


def families_words(families: Sequence[str]) -> str:
    """Return in words what families of statistics are of."""
    return " and ".join(_FAMILIES.get(family, family) for family in families)


class GapChange(_Part):
    """The gap of the model on samples that no fit has seen, before and after effects were added.

    Attributes:
        unit: of all but the share.
        before, after: without and with the effects.
        floor: what chance makes at most in 19 of 20 cases.
        closed_fraction: share that is closed, 0 to 1.
        interval_before, interval_after: 95 % intervals.
        standing_out: families of statistics that are beyond chance by themselves with the effects.
    """

    unit: str = "nats/sample"
    before: Number
    after: Number
    floor: Number
    closed_fraction: Number
    interval_before: Interval = (_NAN, _NAN)
    interval_after: Interval = (_NAN, _NAN)
    standing_out: tuple[str, ...] = ()

    @property
    def within_chance(self) -> bool:
        """Whether chance alone makes as much before anything is added: no share of that is closed."""
        return self.before <= self.floor


class Change(_Part):
    """A number before and after effects were added."""

    before: Number
    after: Number


class Surveyed(_Part):
    """A part of the sensor where a map of all pixels, from all frames, stands out.

    Attributes:
        map: next_x or next_y (covariance with the next pixel), lag (with the frame before), spread (means
            over blocks of frames scatter), score.* and goodness (shape of the histograms), pairs.row.readout
            and so on (pixels that share a row, a column or a frame move together), unfitted (pixels without
            a fit to be relied upon).
        region: as ``model.effects`` takes a region.
        p: probability of such a place by chance, anywhere.
    """

    map: str
    region: dict[str, Any]
    p: Number


class Elsewhere(_Part):
    """Whether the model that was found holds in another window of the sensor.

    Attributes:
        rows, columns: of that, first and end.
        deviates: what does not agree with it there, beyond doubt; empty: nothing.
    """

    rows: tuple[int, int]
    columns: tuple[int, int]
    deviates: str = ""

    def words(self) -> str:
        """Return where that is."""
        return (
            f"rows {self.rows[0]} to {self.rows[1] - 1}, columns {self.columns[0]} to {self.columns[1] - 1}"
        )

    def says(self) -> str:
        """Return where the model was looked at again, and what came of it."""
        found = f"it does not hold: {self.deviates}" if self.deviates else "it holds"
        return f"looked at again in {self.words()}: {found}"


class Examined(_Part):
    """What was looked at.

    Attributes:
        frames: number of them; of histograms the samples of the fullest.
        rows, columns: first, and end, on the sensor.
        train, test, final: frames (of histograms: samples) to find with, to score on, and for the last gap.
        histograms: number of those compared, where frames are not known; of several samples all count.
        share: of the run's samples that were compared with simulations.
        surveyed: of the run's samples that were looked at in every way of ``surveyed_by``, or compared.
        surveyed_by: share of the run's samples by what was looked at, over the whole sensor: neighbours and
            successive frames, shapes of the histograms, pairs of pixels in rows, columns and frames.
        places: where those stand out.
        unfitted: pixels that are not compared, since they have no fit to be relied upon.
        elsewhere: where the model that was found was looked at again; None: nowhere.
        left_out: frames that are empty or far from the others.
    """

    frames: int
    rows: tuple[int, int]
    columns: tuple[int, int]
    train: int
    test: int
    final: int
    histograms: int | None = None
    share: Number = _NAN
    surveyed: Number = _NAN
    surveyed_by: dict[str, Number] = {}
    places: tuple[Surveyed, ...] = ()
    unfitted: int = 0
    elsewhere: Elsewhere | None = None
    left_out: tuple[int, ...] = ()

    @property
    def origin(self) -> tuple[int, int]:
        """First row and column."""
        return self.rows[0], self.columns[0]


class Step(_Part):
    """An effect added to the model, or several that could not be told apart.

    Attributes:
        effect: tag of the named effect; None where it is ambiguous or does not fit.
        verdict: of this step alone.
        candidates: those compared, the likeliest first.
        parameters: numbers of the named or the likeliest effect.
        form: what else its fields say that is not their default, in words.
        place: where and when it acts, in words; empty: everywhere, always.
        gap_before, gap_after, gap_floor: on the final samples without and with it, nats per sample.
        gap_interval_after: 95 % interval of the gap with it.
        size: by how much it changes the samples; None where that is not known.
        families: the gap by family of statistics.
        rivals: the next best candidates, the best first, each fitted in its place.
        placebo: the best of those that have nothing to do with it, fitted in its place; None where none of
            them would close anything.
        moved: change of each parameter map by its refit with the effect.
        separate: by effect, the measurement that would tell it apart.
        pulls: the statistics that it moves most.
    """

    effect: str | None
    verdict: State
    candidates: tuple[Candidate, ...]
    parameters: dict[str, Measured]
    form: dict[str, str] = {}
    place: str = ""
    gap_before: Number
    gap_after: Number
    gap_floor: Number
    gap_interval_after: Interval = (_NAN, _NAN)
    size: Size | None = None
    families: Families = Families()
    rivals: tuple[Rival, ...] = ()
    placebo: Rival | None = None
    moved: dict[str, Moved] = {}
    separate: dict[str, str] = {}
    pulls: tuple[Pull, ...] = ()

    @property
    def within_chance(self) -> bool:
        """Whether chance alone makes as much of a gap without it: no share of that is closed."""
        return self.gap_before <= self.gap_floor

    @property
    def closed(self) -> float:
        """Share of the gap before this step that it closes."""
        return closed_share(self.gap_before, self.gap_after)

    @property
    def runner_up(self) -> Rival | None:
        """The best of the rivals."""
        return self.rivals[0] if self.rivals else None

    def closed_by(self, rival: Rival) -> float:
        """Return the share of the gap before this step that a rival closes in its place."""
        return closed_share(self.gap_before, rival.gap_after)

    @property
    def likeliest(self) -> str:
        """Tag of the named effect, else of the likeliest candidate; empty without any."""
        return self.effect or next((c.effect for c in self.candidates), "")


class Verdict(_Part):
    """The content of ``discrepancy.json``.

    Attributes:
        verdict: named (the gap that is left is at its floor), named_in_part (``gap.closed_fraction`` of it is
            closed), ambiguous, described (measured, not understood), unexplained, consistent, or cannot_tell:
            nothing is found that does not rest on the pixels' parameters, and those are not identified.
        doubt: why the pixels are not identified, and what would help; empty where they are.
        limit: where the search ended at its limit of work, and what was not tried; empty where it did not.
        sentence: the same for people.
        effects: tags of the named effects.
        model_effects: all effects that the model has afterwards, as the YAML holds them.
        proposed: effects that describe what none explains but leave something; they are not in the model.
        steps: what was added, in order of weight.
        gap: with no new effect, and with all.
        where: the disagreements with the model as it was.
        unexplained: those that are left.
        set_aside: codes that the fit leaves out, by their place on a pixel's comb: intervals, e-; None: no
            limit.
        untestable: effects that such data cannot show, and why.
        defects: candidates that could not be compared because of an error in them, and which.
        examined: what was looked at.
        p_global: chance of the largest deviation.
        replicates: simulated stacks or histograms in all.
        work: CPU seconds by count, on a core of about 2020: the same on any machine.
        versions: of what a verdict depends on.
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
        """Return the content of ``discrepancy.json``."""
        return self.model_dump_json(indent=1)

    @classmethod
    def from_json(cls, text: str, source: str = VERDICT_FILE) -> Verdict:
        """Read the content of ``discrepancy.json``.

        Args:
            text: the content.
            source: where it comes from, for the message.

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
            first = error.errors()[0]
            place = ".".join(str(part) for part in first["loc"])
            raise StoreError(f"{source} is damaged ({place}: {first['msg']}); {cure}") from error

    @property
    def closed_in_model(self) -> float:
        """Share of the gap that the effects close which the model has afterwards."""
        named = [step for step in self.steps if step.verdict != "described"]
        if not self.proposed:
            return self.gap.closed_fraction
        return closed_share(self.gap.before, named[-1].gap_after) if named else 0.0

    def part_of_model(self, step: Step) -> bool:
        """Tell whether the effect of a step is in the model: named, or a description of all that was left."""
        return step.effect is not None or (step.verdict == "described" and not self.proposed)

    @property
    def word(self) -> str:
        """The verdict in a word or three."""
        return self.verdict.replace("_", " ")

    def __repr__(self) -> str:
        return f"<Verdict {self.word}: {self.sentence}>"

    def _repr_html_(self) -> str:
        """Return verdict and disagreements, for a notebook."""
        rows = [
            f"<li>{escape(place.sentence or place.statistic)} ({place.z:+.1f} sd)</li>"
            for place in self.where
        ]
        return (
            f"<p><b>{escape(self.word.capitalize())}</b>. {escape(self.sentence)}</p><ul>{''.join(rows)}</ul>"
        )

    def added(self, step: Step) -> str:
        """Return what a step added to the model for its gap: an effect, or the likeliest of several."""
        if step.effect:
            return step.effect
        rivals = list(dict.fromkeys(c.effect for c in step.candidates))[:3]
        if not rivals or self.verdict in ("consistent", "cannot_tell"):
            return ""
        return f"nearest: {rivals[0]}" if step.verdict == "unexplained" else " or ".join(rivals)

    def costing(self, work: float) -> Verdict:
        """Return it with the CPU seconds, by count, of all that led to it."""
        return self.model_copy(update={"work": round(work, 1)})

    def checked(self, elsewhere: Elsewhere) -> Verdict:
        """Return it with what another window of the sensor says of the model that was found."""
        changes: dict[str, Any] = {"examined": self.examined.model_copy(update={"elsewhere": elsewhere})}
        if elsewhere.deviates:
            not_there = f"; it does not hold in {elsewhere.words()}, where {elsewhere.deviates}."
            changes["sentence"] = self.sentence.removesuffix(".") + not_there
            if self.verdict == "named":
                changes["verdict"] = "named_in_part"
        return self.model_copy(update=changes)

    def on_sensor(
        self,
        shape: tuple[int, int],
        rows: tuple[int, int],
        columns: tuple[int, int],
        pixel: Callable[[int, int], tuple[int, int]],
    ) -> Verdict:
        """Return it with pixels counted from the corner of the sensor.

        Args:
            shape: of the sensor.
            rows: that were looked at, first and end.
            columns: likewise.
            pixel: from the place (y, x) of a pixel among those looked at to that on the sensor.
        """

        def moved(place: Place) -> Place:
            pixels = tuple(dict.fromkeys(pixel(y, x) for y, x in place.pixels))
            return place.shifted(shape, rows, columns).model_copy(update={"pixels": pixels})

        examined = self.examined.model_copy(update={"rows": rows, "columns": columns})
        where = tuple(moved(place) for place in self.where)
        return self.model_copy(update={"examined": examined, "where": where})


def micronats(gap: float) -> str:
    """Return a gap, nats per sample, in millionths; less than nothing is chance, and shown as nothing."""
    value = 1e6 * max(gap, 0.0)
    return "not known" if not math.isfinite(gap) else f"{value:,.0f}" if value >= 100.0 else f"{value:.3g}"


def read_verdict(folder: Path) -> Verdict | None:
    """Read the verdict of a run, or return None where there is none.

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


def parameters_of(effect: Effect, stderr: float) -> dict[str, Measured]:
    """Return the numbers of an effect; only its strength was fitted and has a standard error.

    Args:
        effect: with its fitted parameters.
        stderr: of its strength; NaN where there is none.
    """
    errors = {effect.strength: stderr}
    return {
        name: Measured(
            value=value, stderr=errors.get(name, _NAN), unit=effect.unit(name).removeprefix("none")
        )
        for name, value in effect.model_dump(exclude={"tag"}).items()
        if isinstance(value, int | float) and not isinstance(value, bool)
    }


def form_of(effect: Effect) -> dict[str, str]:
    """Return the words in an effect's fields, such as the shape of a drift, that are not the default."""
    fields = type(effect).model_fields
    return {
        name: value
        for name, value in effect.model_dump(exclude={"tag"}).items()
        if isinstance(value, str) and value != fields[name].default
    }


@dataclass(frozen=True)
class Discrepancy:
    """A verdict with what it rests on.

    Attributes:
        verdict: what ``discrepancy.json`` holds.
        model: effects that the model has now, those it had before included.
        maps: parameters of the pixels examined, under the final model.
        evidence: of the train samples.
        statistics: names, and deviations before and after, for pictures.
        code_extended: samples expected at each code of ``evidence.code`` from the final model; None where
            nothing was added or the model gives no law.
        added: exposure that the effects add to single pixels on top of the H of ``maps``; None: nothing.
    """

    verdict: Verdict
    model: tuple[Effect, ...]
    maps: PixelMaps
    evidence: Evidence
    statistics: tuple[tuple[str, ...], NDArray[np.float64], NDArray[np.float64]]
    code_extended: NDArray[np.float64] | None = None
    added: AddedExposure | None = None
