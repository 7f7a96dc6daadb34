"""The door for effects: our files, others' entry points, and what is refused."""

import logging
from importlib.metadata import EntryPoint
from typing import ClassVar, Literal

import pytest
from pydantic import Field, ValidationError

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.effects.framework import registry
from pchem_pipeline.effects.framework.effect import Effect, Plane, registered_effects, tag_of
from pchem_pipeline.simulate.settings import SimulateSettings


class Shine(Effect):
    """An effect of somebody else."""

    tag: Literal["shine"] = "shine"
    plane: ClassVar[Plane] = Plane.EXPOSURE
    extra: float = 0.5

    def apply(self, values, context):
        return values + self.extra


class Impostor(Shine):
    """With a tag of ours."""

    tag: Literal["row_noise"] = "row_noise"


class Tagless(Effect):
    plane: ClassVar[Plane] = Plane.ANALOG

    def apply(self, values, context):
        return values


class Planeless(Effect):
    tag: Literal["planeless"] = "planeless"

    def apply(self, values, context):
        return values


class Idle(Effect):
    tag: Literal["idle"] = "idle"
    plane: ClassVar[Plane] = Plane.ANALOG


class Strengthless(Shine):
    strength: ClassVar[str] = "brightness"


class OutOfBounds(Shine):
    typical_values: ClassVar = ({"extra": 0.2},)
    extra: float = Field(ge=1.0, le=0.0)


NOT_AN_EFFECT = 3


def entry(name, value=None):
    return EntryPoint(name, value or f"{__name__}:{name}", registry.ENTRY_POINT_GROUP)


@pytest.fixture
def installed(monkeypatch):
    """Pretend that packages with these entry points are installed."""

    def install(*points):
        monkeypatch.setattr(registry, "entry_points", lambda group: points)
        registry._discover.cache_clear()

    yield install
    registry._discover.cache_clear()


def test_a_plugin_is_found_and_used(installed):
    installed(entry("Shine"))
    assert registry.effect_class("shine") is Shine
    settings = SimulateSettings(effects=[{"tag": "shine", "extra": 0.25}])
    assert settings.effects == (Shine(extra=0.25),)
    assert settings.model_dump(mode="json")["effects"] == [{"tag": "shine", "extra": 0.25}]
    with pytest.raises(ValidationError, match="extar"):
        SimulateSettings(effects=[{"tag": "shine", "extar": 0.25}])


@pytest.mark.parametrize(
    ("point", "reason"),
    [
        (entry("Impostor"), "taken by pchem_pipeline.effects.operators.offsets"),
        (entry("Missing"), "AttributeError"),
        (entry("gone", "package_that_is_not_there:Effect"), "ModuleNotFoundError"),
        (entry("NOT_AN_EFFECT"), "is not an effect"),
        (entry("Tagless"), "has no tag"),
        (entry("Planeless"), "has no plane"),
        (entry("Idle"), "does nothing; give it the method apply"),
        (entry("Strengthless"), "has no field 'brightness'"),
        (entry("OutOfBounds"), "OutOfBounds: extra: Input should be less than or equal to 0"),
    ],
)
def test_a_broken_plugin_is_named_and_left_out(installed, caplog, point, reason):
    installed(point, entry("Shine"))
    with caplog.at_level(logging.WARNING):
        assert registry.effect_class("shine") is Shine
    assert list(registry._discover()[1]) == [point.name]
    assert reason in registry._discover()[1][point.name]
    assert point.name in caplog.text
    assert registry.effect_class("row_noise") is not Impostor


def test_of_two_plugins_with_one_tag_the_first_counts_and_a_broken_one_that_is_asked_for_is_told(installed):
    gone = entry("gone", "package_that_is_not_there:Effect")
    installed(entry("Shine"), entry("other", f"{__name__}:Shine"), gone)
    assert registry.effect_class("shine") is Shine
    assert "taken" in registry._discover()[1]["other"]
    with pytest.raises(ConfigError, match="left out: package_that_is_not_there"):
        registry.effect_class("gone")


def test_our_own_tags_cannot_be_taken_twice():
    before = registered_effects()
    with pytest.raises(ConfigError, match=r"'row_noise' of .* is taken"):

        class Second(Impostor, tag="row_noise"):
            pass

    assert registered_effects() == before


def test_effects_are_frozen_and_have_no_reach_by_default():
    shine = Shine()
    assert (shine.halo(), shine.history(), tag_of(Shine)) == (0, 0, "shine")
    with pytest.raises(ValidationError):
        shine.extra = 2.0


def test_parameters_at_a_limit_are_told_and_defaults_are_not():
    """A search that drives a parameter to its limit may have taken one effect for another."""
    kind = registry.effect_class("interpixel_capacitance")
    stuck = kind.model_validate({"coupling": 0.008, "anisotropy": -1.0})
    assert stuck.at_limits() == {"anisotropy": -1.0}
    assert stuck.model_copy(update={"anisotropy": -0.99}).at_limits() == {}
    assert kind.model_validate({"coupling": 0.0}).at_limits() == {"coupling": 0.0}  # its strength, gone
    # half a cycle per row is a frequency like others
    pickup = registry.effect_class("periodic_pickup")
    assert pickup(amplitude_dn=0.3, cycles_per_row=0.5).at_limits() == {}
    every = [kind for kind in registry.effect_classes().values() if kind.may_be_at_bound]
    assert every
    assert all(set(kind.may_be_at_bound) <= set(kind.model_fields) for kind in every)
