"""What an effect is, and the registry of our own.

An effect is one file in the folder of its plane: a frozen settings class that is at once its YAML
section, its documentation and its forward model. It is a function of a block of frames and of random
numbers keyed on position, so that the simulated frames do not depend on how the work is divided:

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
"""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from pchem_pipeline.effects.plane import Plane
from pchem_pipeline.errors import ConfigError
from pchem_pipeline.settings import Section

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pchem_pipeline.effects.context import EffectContext

__all__ = ["Effect", "Plane", "register_effect", "registered_effects"]

_registered: dict[str, type[Effect]] = {}


class Effect(Section):
    """Base of all effects.

    A subclass is registered under the default of its ``tag`` and gives:

    Attributes:
        tag: name in the YAML and in verdicts; a ``Literal`` with one value, which is the default.
        plane: where in the signal chain it acts, and so what :meth:`apply` gets (see :class:`Plane`).
    """

    tag: str
    plane: ClassVar[Plane]

    @abstractmethod
    def apply(self, values: NDArray[Any], context: EffectContext) -> NDArray[Any]:
        """Return what the plane becomes under this effect.

        Args:
            values: (frame, y, x), unit and dtype of the plane; not to be changed.
            context: the block's frame numbers, rows, maps and random numbers.

        Returns:
            A new array of the same shape and dtype.
        """

    def halo(self) -> int:
        """Return how many rows on either side a row depends on, px."""
        return 0

    def history(self) -> int:
        """Return how many frames before it a frame depends on."""
        return 0


EffectClass = TypeVar("EffectClass", bound=type[Effect])


def register_effect(effect: EffectClass) -> EffectClass:
    """Register an effect of this package under its tag (class decorator).

    Raises:
        ConfigError: if it has no tag or plane, or another class has the tag.
    """
    tag = tag_of(effect)
    known = _registered.get(tag)
    if known is not None and known.__qualname__ + known.__module__ != effect.__qualname__ + effect.__module__:
        raise ConfigError(
            f"effect tag {tag!r} of {effect.__module__} is taken by {known.__module__}; choose another tag"
        )
    _registered[tag] = effect
    return effect


def registered_effects() -> dict[str, type[Effect]]:
    """Return the effects registered so far by tag (see ``registry.effect_classes`` for all there are)."""
    return dict(_registered)


def tag_of(effect: type[Effect]) -> str:
    """Return the tag of an effect class.

    Raises:
        ConfigError: if the class is not an :class:`Effect` with a tag, a plane and its own ``apply``.
    """
    where = f"{getattr(effect, '__module__', '?')}.{getattr(effect, '__qualname__', effect)}"
    if not (isinstance(effect, type) and issubclass(effect, Effect)):
        raise ConfigError(f"{where} is not an effect; derive it from pchem_pipeline.effects.base.Effect")
    tag = effect.model_fields["tag"].default
    if not isinstance(tag, str) or not tag:
        raise ConfigError(f'{where} has no tag; add a field `tag: Literal["name"] = "name"`')
    if not isinstance(getattr(effect, "plane", None), Plane):
        raise ConfigError(f"{where} has no plane; add `plane: ClassVar[Plane] = Plane....`")
    if effect.apply is Effect.apply:
        raise ConfigError(f"{where} does nothing; give it a method apply(self, values, context)")
    return tag
