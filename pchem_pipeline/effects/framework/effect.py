"""What an effect is, and the registry of our own.

An effect is one class in the module of its operator (:mod:`pchem_pipeline.effects.operators`): a frozen
settings class that is at once its YAML section, its documentation and its forward model. It is a function of
a block of frames and of random numbers keyed on position, so that the simulated frames do not depend on how
the work is divided:

- **independent samples** need nothing: return a new array of the same shape;
- **common modes** draw one number per frame, row, column or run: ``context.random.normal(("frame", "y"))``;
- **neighbours** declare ``halo``: the band is simulated with that many more rows on each side (as far as
  the sensor goes), and they are cut off afterwards. Columns are always complete;
- **short memory** declares ``history``: that many earlier frames are simulated too and cut off afterwards
  (frames before the run have negative numbers and are as good as any other);
- **long memory** (a drift, a Markov chain, a random walk) is a function of the frame number: computed from
  ``context.frames``, or replayed from frame 0 with the pixel's own ``context.random.generator(y=, x=)``,
  drawing dwell times rather than frames so that this stays cheap.

Halos and histories of several effects add up.

Any effect may have a place and a time (:attr:`~Effect.region`, :attr:`~Effect.when`): what it makes of the
samples is kept only there, without its knowing. Several entries of one effect in different regions have
strengths and random numbers of their own: so are taps described that differ.

The same class guesses its own parameters from what a stack shows (:meth:`~Effect.estimate`), changes the law
of a pixel's samples (:meth:`~Effect.sample_law`), so that the fit can run with it, finds the exposure that it
adds to single pixels (:meth:`~Effect.added_exposure`), and names the offset that many pixels share
(:meth:`~Effect.shared_offset`).
"""

from __future__ import annotations

import math
import re
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple, Self, get_args, get_origin

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.base.settings import Section
from pchem_pipeline.effects.framework.region import Region, Span, When
from pchem_pipeline.model.arithmetic.significance import CLEAR

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
    from pchem_pipeline.effects.framework.compose import AddedExposure
    from pchem_pipeline.effects.framework.context import EffectContext
    from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps
    from pchem_pipeline.model.law.sample_law import SampleLaw

#: Frames through which the samples that an effect without a name moves are followed.
DEPTH = 4
#: Parts of such an effect that are described in words.
MOST_TOLD = 4
# standard deviations by which an effect of typical strength moves its leading statistic, in so many samples
_USUAL, _USUAL_SAMPLES = 7.0, 1e6
#: Events in a simulation that shows what they do, where fewer are to be expected.
FEWEST_SHOWN = 8

_registered: dict[str, type[Effect]] = {}


class Plane(Enum):
    """Where in the signal chain an effect acts; iteration gives the order of the chain.

    What an effect receives and returns there, always with dims (frame, y, x):

    ========  =======================================================  ==============
    plane     values                                                   dtype
    ========  =======================================================  ==============
    EXPOSURE  mean number of electrons H_t, e-                         float64, >= 0
    CHARGE    number of electrons K, e-                                int64, >= 0
    ANALOG    input-referred signal with read noise K + R, e-          float64
    ADC       signal at the ADC before rounding, mu + (K + R) / g, DN  float64
    READOUT   digital number X, rounded and cut to the ADC's range     unsigned
    ========  =======================================================  ==============
    """

    EXPOSURE = "exposure"
    CHARGE = "charge"
    ANALOG = "analog"
    ADC = "adc"
    READOUT = "readout"


class Unit(NamedTuple):
    """Marks the type of a field with its unit."""

    name: str


#: Types of numbers with their unit, for the fields of effects.
Ratio = Annotated[float, Unit("none")]
Count = Annotated[int, Unit("none")]
Dn = Annotated[float, Unit("DN")]
Code = Annotated[int, Unit("DN")]
Lsb = Annotated[float, Unit("LSB")]
Electrons = Annotated[float, Unit("e-")]
ElectronsPerFrame = Annotated[float, Unit("e- per frame")]
ElectronsPerUm = Annotated[float, Unit("e-/um")]
PerElectron = Annotated[float, Unit("1/e-")]
Frames = Annotated[float, Unit("frames")]
PerFrame = Annotated[float, Unit("1/frame")]
Turns = Annotated[float, Unit("cycles")]
Radians = Annotated[float, Unit("rad")]
Micrometres = Annotated[float, Unit("um")]


class Factors(NamedTuple):
    """What an effect changes, which samples share one value of it, and how that varies, in words."""

    changes: str
    shared_by: str
    varies: str


class SharedOffset(NamedTuple):
    """An offset that pixels of a frame share: of a frame, row or column; of a wave or a readout.

    A wave has a sine and a cosine of its own in each frame, a readout noise of spectrum 1/f along pixels that
    are read one after the other. The variance is that of the offset, of sine and of cosine, in any frame of
    the camera; None: other frames have another one.
    """

    of: Literal["frame", "row", "column", "wave", "readout"]
    variance: float | None  # DN^2
    cycles_per_row: float = 0.0  # of a wave
    cycles_per_column: float = 0.0
    taps: int = 1  # column blocks read in parallel, row by row, each with noise of its own


class Replacement(NamedTuple):
    """A rule: of the samples that exceed a number by more than so much, that number comes out."""

    value: NDArray[np.integer[Any]]  # the number, DN, (frame, y, x)
    inside: BoolArray  # pixels for which the rule holds, (y, x)
    excess: int  # by how much, DN
    share: float  # of those samples that is replaced, no unit


class Effect(Section):
    """Base of all effects.

    A subclass gives, and one of this package is registered by its tag behind the base:

    Attributes:
        tag: name in the YAML and in verdicts; a ``Literal`` with one value, which is the default.
        plane: where in the signal chain it acts, and so what :meth:`apply` gets (see :class:`Plane`).
        along: the later the signal comes to it than to others of its plane, the larger: what adds to a
            voltage, then what bends it, then the steps of the converter, then its limits.
        title, source: its name in the literature, and where it is described.
        factors: what it changes, what shares it, how it varies; None of a description, which measures them.
        signature: the statistics (names in :mod:`pchem_pipeline.discrepancy.observe.catalogue`) that it moves
            first, the most telling one first.
        strength: the parameter that scales it; 0 is no effect (a clipping limit and its like have none: "").
        power: near zero the statistics grow like ``strength ** power``.
        separate: for each effect that it is confused with (tag), the measurement that tells them apart.
        random_realisation: whether its time profile is drawn anew in every simulation, so that a fingerprint
            is one of many and another effect outdoes it only by a clear margin.
        resample_pixels: whether the pixels to which it adds exposure are drawn anew in every simulation.
        untestable: why frames of one constant exposure cannot show it; empty for all that they can show.
        rough_law: whether :meth:`sample_law` is right for the pixels' parameters only, so that the histograms
            of a few pixels do not tell whether they have the effect.
        empirical: whether it is no hypothesis, but what is measured where all of those have failed.
        far_reaching: whether samples depend on others anywhere in their frame: a part does not show it.
        typical_values: parameters as met in practice, one set for each of its kinds (signs, patterns).
        may_be_at_bound: parameters that may well be at a limit, as half a cycle or a missing code. A
            fit that drives any other one there has taken another effect for this one.
        reach_rows, reach_frames: rows on either side, and frames before, that a sample depends on.
    """

    tag: str = ""
    plane: ClassVar[Plane]
    along: ClassVar[int] = 0
    title: ClassVar[str] = ""
    source: ClassVar[str] = ""
    factors: ClassVar[Factors | None] = None
    signature: ClassVar[tuple[str, ...]] = ()
    strength: ClassVar[str] = ""
    power: ClassVar[float] = 1.0
    separate: ClassVar[Mapping[str, str]] = {}
    random_realisation: ClassVar[bool] = False
    resample_pixels: ClassVar[bool] = False
    untestable: ClassVar[str] = ""
    rough_law: ClassVar[bool] = False
    empirical: ClassVar[bool] = False
    far_reaching: ClassVar[bool] = False
    typical_values: ClassVar[tuple[Mapping[str, Any], ...]] = ()
    may_be_at_bound: ClassVar[tuple[str, ...]] = ()
    reach_rows: ClassVar[int] = 0
    reach_frames: ClassVar[int] = 0
    region: Region | None = Field(default=None, description="region of the sensor; null: everywhere")
    when: When | None = Field(default=None, description="frames concerned; null: all")

    def __init_subclass__(cls, tag: str = "", **settings: Any) -> None:
        """Give a class of this package the field of its tag: ``class RowNoise(Effect, tag="row_noise")``."""
        super().__init_subclass__(**settings)
        if tag:
            cls.__annotations__ = {**cls.__annotations__, "tag": Literal[tag]}
            cls.tag = Field(default=tag, description="name of the effect")

    @classmethod
    def __pydantic_init_subclass__(cls, tag: str = "", **_: Any) -> None:
        """Register a class with such a tag; ConfigError: no plane, does nothing, or its tag is taken."""
        known = _registered.setdefault(tag_of(cls), cls) if tag else cls
        if known is not cls:
            raise ConfigError(
                f"effect tag {tag!r} of {cls.__module__} is taken by {known.__module__}; choose another tag"
            )

    @model_serializer(mode="wrap")
    def _without_defaults(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Write place and time only where there are any."""
        found: dict[str, Any] = handler(self)
        place = {name: found.pop(name, None) for name in ("region", "when")}
        return found | {name: value for name, value in place.items() if value is not None}

    @property
    def everywhere(self) -> bool:
        """Whether it acts on all pixels, in all frames."""
        return self.region is None and self.when is None

    @property
    def localised(self) -> bool:
        """Whether its own parameters say where it acts, so that a region would only cut it off."""
        return False

    @property
    def key(self) -> tuple[str, Region | None, When | None]:
        """What tells it from the other effects of a model: tag, part of the sensor, frames."""
        return self.tag, self.region, self.when

    @classmethod
    def unit(cls, name: str) -> str:
        """Return the unit with which a field is declared, "none" of a pure number; empty: without."""
        field = cls.model_fields[name]
        marks = [*field.metadata, *(m for part in get_args(field.annotation) for m in get_args(part))]
        return next((m.name for m in marks if isinstance(m, Unit)), "")

    @property
    def measured_parts(self) -> int:
        """How many of its forms are measured, not assumed."""
        return int(type(self).empirical)

    def at_place(self, region: Region | None, when: When | None = None) -> Self:
        """Return a copy with another place and time."""
        return self.model_copy(update={"region": region, "when": when})

    def to_window(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it as it acts on some rows and columns (ranges) that are taken for a sensor of their own.

        For effects with places among their parameters, or a pattern that begins at row or column 0; a region
        is cut elsewhere. ``shape``: rows and columns of the whole sensor.
        """
        return self

    def to_sensor(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return as an effect on the sensor what acts on some of its rows and columns; see `to_window`."""
        return self

    @abstractmethod
    def apply(self, values: NDArray[Any], context: EffectContext) -> NDArray[Any]:
        """Return what the plane becomes under this effect, a new array of the same shape and dtype.

        Args:
            values: (frame, y, x), unit and dtype of the plane; not to be changed.
            context: the block's frame numbers, rows, maps and random numbers.
        """

    @classmethod
    def typical(cls) -> Sequence[Self]:
        """Return it with each of its :attr:`typical_values`, for guesses and demonstrations."""
        return tuple(cls.model_validate(values) for values in cls.typical_values)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return hypotheses about its parameters, the likeliest first; none where nothing speaks for it.

        Only guesses of what it is like, of a strength right to a factor of some three: this is found by
        simulation, and a false one costs time and nothing else. The default is :meth:`typical_as_seen` by the
        two leading statistics of the signature; none where no statistic depends on the effect.
        """
        return () if cls.untestable else cls.typical_as_seen(evidence, *cls.signature[:2])

    @classmethod
    def typical_as_seen(cls, evidence: Evidence, *names: str) -> list[Self]:
        """Return what is typical, as strong as the named statistics, which it raises, stand out; else none.

        If its typical strengths have either sign, only the first statistic counts, which has that sign.
        """
        found = []
        typical = cls.typical()
        signs = [-1.0 if cls.strength and getattr(one, cls.strength) < 0 else 1.0 for one in typical]
        counted = names[:1] if -1.0 in signs else names
        samples = evidence.n_frames * max(int(evidence.maps.usable.sum()), 1)
        for one, sign in zip(typical, signs, strict=True):
            seen = max((sign * evidence.z.get(name, 0.0) for name in counted), default=0.0)
            if seen > CLEAR:
                times = seen / _USUAL * math.sqrt(_USUAL_SAMPLES / samples)
                found.append(one.scaled(times ** (1.0 / cls.power)) if cls.strength else one)
        return found

    def representative(self, frames: IntArray) -> tuple[Self, float]:
        """Return the effect as one simulation shows it best, and by what to multiply what it then shows.

        For rare events: by chance a stack of such frames (of increasing numbers) holds none, or too many.
        """
        return self, 1.0

    def _shown_at_least(self, name: str, share: float, most: float) -> tuple[Self, float]:
        """Return it with a chance of at least so much, and how much rarer what it makes then really is."""
        now, shown = getattr(self, name), min(share, most)
        if not now or now >= shown:
            return self, 1.0
        return self.model_copy(update={name: shown}), now / shown

    def details(self) -> tuple[str, ...]:
        """Return positive numbers beside the strength with which the statistics go smoothly.

        A search tunes them by simulation; those that the law of a sample tells, it takes from the histograms.
        """
        return ()

    def with_satellites(self, amplitude_e: FloatArray, weight: FloatArray, share: float) -> Self:
        """Return it with what free satellites of single pixels tell; by default as it is.

        They have levels of ``amplitude_e``, e-, and ``weight``, (n,), in this share of the pixels.
        """
        return self

    def scaled(self, factor: float) -> Self:
        """Return a copy of ``factor`` times the strength, within its limits; ConfigError: no strength."""
        if not self.strength:
            raise ConfigError(f"effect {self.tag!r} has no strength to scale")
        return self.times(self.strength, factor)

    def times(self, name: str, factor: float) -> Self:
        """Return a copy with ``factor`` times a number of it, kept within the limits of its field."""
        values = self.model_dump()
        values[name] = self.limited(name, values[name] * factor)
        return type(self).model_validate(values)

    @classmethod
    def limited(cls, name: str, value: float) -> float:
        """Return a value cut to the limits that its field states."""
        for limit in cls.model_fields[name].metadata:
            low, high = getattr(limit, "ge", None), getattr(limit, "le", None)
            value = value if low is None else max(value, low)
            value = value if high is None else min(value, high)
        return value

    @classmethod
    def short_title(cls) -> str:
        """Return the title without synonyms and abbreviations in brackets."""
        return re.sub(r" \(.*?\)", "", cls.title) or str(cls.model_fields["tag"].default)

    @classmethod
    def meaning(cls, name: str) -> str:
        """Return what a number is: the first words of its description, without case and unit; or a name."""
        field = cls.model_fields[name]
        if get_origin(field.annotation) is Literal:
            return name.replace("_", " ")
        words = re.split(r"[,;]| \(", field.description or name, maxsplit=1)[0]
        return words.rpartition(": ")[2].replace("`", "")

    def stuck_words(self) -> str:
        """State which parameters are at a limit; empty if none."""
        return " and ".join(f"its {name} is at the limit of {v:g}" for name, v in self.at_limits().items())

    def at_limits(self) -> dict[str, float]:
        """Return parameters at a limit of their field, by name; not defaults, nor `may_be_at_bound`."""
        found = {}
        for name, field in type(self).model_fields.items():
            value = getattr(self, name)
            limits = [getattr(limit, side, None) for limit in field.metadata for side in ("ge", "le")]
            chosen = isinstance(value, float) and value != field.default
            if chosen and name not in self.may_be_at_bound and value in limits:
                found[name] = value
        return found

    def describe(self) -> str:
        """Describe in a few words what is known of it."""
        return self.title or self.tag

    def by_law(self, shape: tuple[int, int]) -> Sequence[Effect]:
        """Return effects that together are this one on a sensor of ``shape``, each of one law."""
        return (self,)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law of the pixels' samples with this effect: its place in the fit.

        Args:
            model: the law so far, of n pixels; returned where the effect leaves a pixel's histogram as it is.
            maps: parameters of these pixels, each (n,) (what is known before the fit with the effect).
        """
        return model

    def added_exposure(
        self, frames: NDArray[np.unsignedinteger], numbers: IntArray, maps: PixelMaps
    ) -> AddedExposure | None:
        """Return what it adds to the exposure of each pixel: H is then the exposure without.

        For effects on single pixels, whose histograms show the mean exposure whatever it is made of; None
        where it adds nothing, or only in proportion to H.

        Args:
            frames: (frame, y, x), DN; not to be changed.
            numbers: their numbers in the run, increasing, shape (frame,).
            maps: plain fit of these pixels, (y, x) each.
        """
        return None

    def shared_offset(self) -> SharedOffset | None:
        """Return the offset that pixels of a frame share: calibrated frames are freed of it; or None."""
        return None

    def displaced(self) -> Mapping[Literal["rows", "columns"], FloatArray]:
        """Return the shares of lines that hold the samples of other pixels, by :data:`~.evidence.PLACES`.

        Of these no pixel's own histogram has a law: the search fits it without lines that are likely such.
        """
        return {}

    def replacement(self, frames: NDArray[np.unsignedinteger]) -> Replacement | None:
        """Return the rule by which it replaces samples by others of their frame; None where it does not.

        The law of a pixel then depends on others: the search learns the sensor by what stands in for each. Of
        codes (frame, y, x), DN, before any is replaced.
        """
        return None

    def added_scatter_e(self, exposure: FloatArray) -> FloatArray | None:
        """Return the scatter that it adds to electrons of these means, e- rms; None: it has no such size."""
        return None

    def halo(self) -> int:
        """Return how many rows on either side a row depends on, px."""
        return self.reach_rows

    def history(self) -> int:
        """Return how many frames before it a frame depends on: :attr:`reach_frames`."""
        return self.reach_frames


def registered_effects() -> dict[str, type[Effect]]:
    """Return the effects registered so far by tag (see ``registry.effect_classes`` for all there are)."""
    return dict(_registered)


def tag_of(effect: Any) -> str:
    """Return the tag of an effect class; ConfigError: it lacks a tag, a plane, a method or its strength."""
    where = f"{getattr(effect, '__module__', '?')}.{getattr(effect, '__qualname__', effect)}"
    if not (isinstance(effect, type) and issubclass(effect, Effect)):
        raise ConfigError(
            f"{where} is not an effect; derive it from pchem_pipeline.effects.framework.effect.Effect"
        )
    tag = effect.model_fields["tag"].default
    if not isinstance(tag, str) or not tag:
        raise ConfigError(f'{where} has no tag; add a field `tag: Literal["name"] = "name"`')
    if not isinstance(getattr(effect, "plane", None), Plane):
        raise ConfigError(f"{where} has no plane; add `plane: ClassVar[Plane] = Plane....`")
    if missing := sorted(effect.__abstractmethods__):
        raise ConfigError(f"{where} does nothing; give it the method {', '.join(missing)}")
    if effect.strength not in ("", *effect.model_fields):
        raise ConfigError(f"{where} has no field {effect.strength!r}; name the one that is its strength")
    return tag
