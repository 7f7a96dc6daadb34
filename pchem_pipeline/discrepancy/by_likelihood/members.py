"""Effects as parameters of a likelihood: which change a pixel's histogram, and their free parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.errors import error_words
from pchem_pipeline.effects.framework.compose import pixel_maps, sample_law
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence
from pchem_pipeline.model.fit.shared import Samples
from pchem_pipeline.model.law.sample_law import SampleLaw

#: Why effects in time and space cannot be looked for.
NO_ORDER = "ready-made histograms have no frame order and no neighbours"
_SAME_LAW = "it changes at most the width of the read noise in a pixel's histogram"
_FEW_PIXELS = "only many pixels of different bias distinguish it from the peaks of a histogram"
_FAMILIES = ("shape", "code", "tail")  # of statistics that histograms have
_MOST_EXTRA = 2
_MOST_STARTS = 6  # of one effect
_UNLIMITED = {True: 10.0, False: 1e4}  # of a strength, of another field
FARTHEST = 4.0  # factor by which other fields than the strength may move
_LONGEST_LIST = 8
_LONGEST_STEP = 50.0  # times the strength of the start


@dataclass(frozen=True)
class Coordinate:
    """A fitted field ``sign(c) |c| ** (1 / power)`` of an effect: small effects are linear in c."""

    name: str
    power: float
    bounds: tuple[float, float]

    def value(self, coordinate: float) -> float:
        """Return the field of a coordinate."""
        return float(np.sign(coordinate) * abs(coordinate) ** (1.0 / self.power))

    def coordinate(self, value: float) -> float:
        """Return the coordinate of a field."""
        return float(np.sign(value) * abs(value) ** self.power)

    def stderr(self, coordinate: float, stderr: float) -> float:
        """Return the standard error of the field from that of its coordinate."""
        at = abs(coordinate)
        return float(stderr * at ** (1.0 / self.power - 1.0) / self.power) if at else stderr


@dataclass(frozen=True)
class Member:
    """A candidate at a start, and its fitted coordinates, that of the strength first if it has one."""

    effect: Effect
    coordinates: tuple[Coordinate, ...]

    @classmethod
    def of(cls, effect: Effect) -> Member:
        """Find the fields to fit: the strength, and other real numbers with limits."""
        names = [effect.strength] if effect.strength else []
        for name, value in effect.model_dump().items():
            more = isinstance(value, float) and name not in names and 0 < len(names) <= _MOST_EXTRA
            if more and np.isfinite(_limits(effect, name)).all():
                names.append(name)
        found = []
        for name in names:
            power = effect.power if name == effect.strength else 1.0
            limits = _limits(effect, name)
            if name != effect.strength and limits[0] > 0:
                value = float(getattr(effect, name))
                limits = max(limits[0], value / FARTHEST), min(limits[1], value * FARTHEST)
            bounds = [np.sign(b) * min(abs(b), _UNLIMITED[name == effect.strength]) ** power for b in limits]
            found.append(Coordinate(name, power, (float(bounds[0]), float(bounds[1]))))
        return cls(effect, tuple(found))

    @property
    def tag(self) -> str:
        """Tag of the effect."""
        return self.effect.tag

    @property
    def kind(self) -> str:
        """The effect without what is fitted."""
        return str(self.effect.model_dump(mode="json", exclude={c.name for c in self.coordinates}))

    @property
    def start(self) -> FloatArray:
        """Coordinates of the start."""
        return np.array([c.coordinate(float(getattr(self.effect, c.name))) for c in self.coordinates])

    @property
    def scale(self) -> FloatArray:
        """Natural scale of the coordinates."""
        return np.maximum(np.abs(self.start), 1e-6)

    @property
    def tabulated(self) -> bool:
        """Whether it is a table of numbers read off the residuals, which mimics any cause."""
        return any(isinstance(v, tuple | list) and len(v) > _LONGEST_LIST for _, v in self.effect)

    @property
    def law(self) -> SampleLaw:
        """The law of the samples of some pixel with the effect alone."""
        return self.effect.sample_law(SampleLaw(), _ONE_PIXEL)

    @property
    def at_limit(self) -> bool:
        """Whether a fitted field is at a limit of its range: it mimics another effect."""
        reached = np.isclose(self.start[:, None], [c.bounds for c in self.coordinates], rtol=1e-6, atol=0.0)
        return bool(reached.any()) if self.coordinates else False

    def at(self, coordinates: FloatArray) -> Effect:
        """Return the effect at coordinates.

        Raises:
            pydantic.ValidationError: the effect refuses them.
        """
        values = self.effect.model_dump()
        for c, value in zip(self.coordinates, coordinates, strict=True):
            values[c.name] = c.value(float(value))
        return type(self.effect).model_validate(values)

    def moved(self, coordinates: FloatArray) -> Member:
        """Return the member with another start."""
        return Member(self.at(coordinates), self.coordinates)

    def placed(self, strength: float) -> Member:
        """Return the member with another coordinate of its strength, as far as its limits allow."""
        start = self.start
        low, high = (0.5 * b for b in self.coordinates[0].bounds)
        reach = _LONGEST_STEP * abs(start[0])
        start[0] = float(np.clip(strength, max(low, -reach), min(high, reach)))
        try:
            return self.moved(start)
        except ValueError:
            return self

    def excludes(self, other: Member) -> bool:
        """Return whether both cannot be in one model: one effect, or two laws of the electron number."""
        return self.tag == other.tag or "poisson" not in (self.law.law, other.law.law)


_ONE_PIXEL = pixel_maps([np.array([v]) for v in (2.0, 0.1, 100.0, 3.0)], np.ones(1, np.bool_))


def split_coordinates(members: Sequence[Member], values: FloatArray) -> list[FloatArray]:
    """Split concatenated values into those of each member."""
    return np.split(values, np.cumsum([len(m.coordinates) for m in members]))[:-1]


def law_of(
    present: Sequence[Effect],
    members: Sequence[Member],
    shared: FloatArray,
    own: FloatArray,
    samples: Samples,
) -> SampleLaw:
    """Return the law of rows of histograms with the effects present and the members at their coordinates.

    The coordinates ``shared`` are those of all members, concatenated; ``own`` are (H, g, mu, sigma) of the
    rows, (n, 4). Samples without electrons get none from effects either.
    """
    parts = split_coordinates(members, shared)
    effects = [*present, *(m.at(part) for m, part in zip(members, parts, strict=True))]
    law = sample_law(effects, pixel_maps(list(own.T), np.ones(own.shape[0], np.bool_)))
    if any(samples.dark) and law.added_exposure.any():
        some = samples.illuminated(own.shape[0])[:, None]
        law = replace(law, added_exposure=np.where(some, law.added_exposure, 0.0))
    return law


def leads_in_histograms(effect: type[Effect]) -> bool:
    """Return whether the statistic that an effect moves most is one that histograms have."""
    return not effect.signature or effect.signature[0].partition(".")[0] in _FAMILIES


def find_members(
    classes: Mapping[str, type[Effect]], evidence: Evidence, present: Sequence[Effect], failed: dict[str, str]
) -> tuple[list[Member], dict[str, str]]:
    """Return the candidates that change a pixel's own histogram, and why the others do not.

    Some estimate their starts from the evidence. ``failed`` gets those that failed, and why.
    """
    members: list[Member] = []
    untestable: dict[str, str] = {}
    have = {effect.tag for effect in present}
    for tag, effect in classes.items():
        if tag in have:
            continue
        if not leads_in_histograms(effect):
            untestable[tag] = NO_ORDER
            continue
        if effect.rough_law:
            untestable[tag] = _FEW_PIXELS
            continue
        # an effect of a plug-in may raise anything: the others are compared all the same
        try:
            starts = _distinct([*effect.typical(), *effect.estimate(evidence)])
            found = [Member.of(start) for start in starts]
            found = [m for m in found if not (m.law.neutral or m.law.free_satellites)]
        except Exception as error:
            failed[tag] = error_words(error)
            continue
        if starts and not found:
            untestable[tag] = f"{NO_ORDER}: {_SAME_LAW}"
        members += found[:_MOST_STARTS]
    return members, untestable


def _distinct(effects: Sequence[Effect]) -> list[Effect]:
    """Leave out starts that differ in their absolute strength only."""
    kept: dict[tuple[str, float], Effect] = {}
    for effect in effects:
        sign = float(np.sign(getattr(effect, effect.strength, 0.0)))
        kept.setdefault((effect.model_dump_json(exclude={effect.strength}), sign), effect)
    return list(kept.values())


def _limits(effect: Effect, name: str) -> tuple[float, float]:
    """Return the limits that a field states, infinite where it states none."""
    return effect.limited(name, -np.inf), effect.limited(name, np.inf)
