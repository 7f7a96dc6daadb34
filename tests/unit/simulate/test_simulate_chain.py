"""The forward chain: its planes, its ADC, and what it says when an effect misbehaves."""

from dataclasses import fields, replace
from functools import partial
from typing import Any, ClassVar, Literal

import numpy as np
import pytest
from helpers.small_sensors import a_uniform_sensor

from pchem_pipeline.base.errors import ConfigError, PchEmError
from pchem_pipeline.effects.framework.effect import Effect, Plane
from pchem_pipeline.simulate.chain import dn_dtype, frames_per_block, simulate_block
from pchem_pipeline.simulate.maps import draw_truth
from pchem_pipeline.simulate.settings import SimulateSettings

NOTHING = [
    {"tag": "exposure_drift", "drift": 0.0},
    {"tag": "row_noise", "row_noise_dn": 0.0},
    {"tag": "clipping", "low": 0},
]


class Probe(Effect):
    """Calls a function, for tests."""

    tag: Literal["probe"] = "probe"
    plane: ClassVar[Plane] = Plane.ANALOG
    model_config: ClassVar[Any] = {"arbitrary_types_allowed": True}
    function: Any

    def apply(self, values, context):
        return self.function(values, context)


def probe_at(plane, function):
    kind = type("Probe", (Probe,), {"plane": plane, "__module__": __name__})
    return kind(function=function)


def sensor(**changes):
    return SimulateSettings.model_validate({"shape": [6, 7], "n_frames": 20, "seed": 11, **changes})


def constant_truth(shape=(6, 7), *, exposure=2.0, gain=0.1, bias=100.0, noise=0.3):
    return a_uniform_sensor(shape, float(exposure), gain, float(bias), noise)


def test_long_tables_of_hot_pixels_are_searched_right():
    truth = constant_truth(exposure=3000.0, noise=0.0, gain=1.0, bias=0.0)
    dn, electrons = simulate_block(truth, sensor(bit_depth=24), (0, 20))
    planes, same = simulate_block(truth, sensor(bit_depth=24, effects=NOTHING), (0, 20))
    for other in (electrons, planes, same):
        np.testing.assert_array_equal(dn, other)


def test_without_noise_the_numbers_are_the_formula():
    dn, electrons = simulate_block(constant_truth(gain=0.08, bias=100.3, noise=0.0), sensor(), (0, 20))
    np.testing.assert_array_equal(dn, np.rint(electrons / 0.08 + 100.3))


@pytest.mark.parametrize(("bits", "dtype"), [(1, np.uint8), (8, np.uint8), (9, np.uint16), (17, np.uint32)])
@pytest.mark.parametrize("effects", [[], NOTHING])
def test_the_adc_ends_at_zero_and_at_its_top(bits, dtype, effects):
    settings = sensor(bit_depth=bits, effects=effects)
    assert dn_dtype(bits) == dtype
    top = 2**bits - 1
    for bias, end in ((-1e4, 0), (top + 1e4, top)):
        dn, _ = simulate_block(constant_truth(bias=bias), settings, (0, 3))
        assert dn.dtype == dtype
        assert (dn == end).all()


def test_electron_numbers_only_as_far_as_wanted():
    settings = sensor()
    truth = draw_truth(settings)
    for given in (settings, sensor(effects=NOTHING)):
        dn, electrons = simulate_block(truth, given, (4, 12), electron_frames=3)
        assert (len(dn), len(electrons)) == (8, 3)
        assert len(simulate_block(truth, given, (4, 12), electron_frames=0)[1]) == 0
        np.testing.assert_array_equal(electrons, simulate_block(truth, settings, (4, 7))[1])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"exposure": np.nan}, "quanta_exposure is impossible in 42 pixels"),
        ({"exposure": -1.0}, "quanta_exposure"),
        ({"exposure": 1e8}, "quanta_exposure"),
        ({"gain": 0.0}, "conversion_gain"),
        ({"bias": np.inf}, "bias"),
        ({"noise": -0.1}, "analog_read_noise_e.*-0.1 at y=0, x=0"),
    ],
)
def test_an_impossible_truth_is_refused(change, words):
    with pytest.raises(ConfigError, match=words):
        constant_truth(**change)


def test_a_truth_of_unequal_maps_or_of_another_shape_is_refused():
    truth = constant_truth()
    with pytest.raises(ConfigError, match="make them equal"):
        replace(truth, conversion_gain=truth.conversion_gain[:2])
    with pytest.raises(ConfigError, match="make them equal"):
        simulate_block(constant_truth((3, 3)), sensor(), (0, 1))


def test_effects_meet_the_signal_in_the_order_of_the_planes():
    seen = []

    def note(values, context, name):
        known = [n for n in ("exposure", "charge", "read_noise") if getattr(context, n) is not None]
        seen.append((name, f"{values.dtype} {','.join(known)}"))
        return values.copy()

    effects = [probe_at(plane, partial(note, name=plane.name)) for plane in reversed(Plane)]
    settings = sensor().model_copy(update={"effects": tuple(effects)})
    simulate_block(draw_truth(settings), settings, (0, 2))
    assert seen == [
        ("EXPOSURE", "float64 "),
        ("CHARGE", "int64 exposure"),
        ("ANALOG", "float64 exposure,charge,read_noise"),
        ("ADC", "float64 exposure,charge,read_noise"),
        ("READOUT", "uint16 exposure,charge,read_noise"),
    ]


def test_effects_know_where_they_are_and_cannot_change_what_they_see():
    def look(values, context):
        assert context.frames.tolist() == [3, 4]
        assert context.rows.tolist() == [2, 3, 4]
        assert (context.n_frames, context.shape, context.bit_depth) == (20, (6, 7), 14)
        assert context.integration_time == 4.87
        for name in ("quanta_exposure", "conversion_gain", "bias", "analog_read_noise_e"):
            assert context.truth[name].shape == (3, 7)
        arrays = [values, *context.truth.values()]
        arrays += [getattr(context, f.name) for f in fields(context) if f.name != "truth"]
        for array in arrays:
            assert not (isinstance(array, np.ndarray) and array.flags.writeable)
        return values + 0.0

    settings = sensor().model_copy(update={"effects": (probe_at(Plane.ANALOG, look),)})
    dn, _ = simulate_block(draw_truth(settings), settings, (3, 5), (2, 5))
    assert dn.shape == (2, 3, 7)


def fails(values, context):
    raise KeyError("temperature")


@pytest.mark.parametrize(
    ("plane", "function", "words"),
    [
        (Plane.ANALOG, fails, "'probe'.*failed: KeyError.*leave it out"),
        (Plane.ANALOG, lambda v, c: v[:1], r"returned float64\(1, 6, 7\) instead of float64\(2, 6, 7\)"),
        (Plane.READOUT, lambda v, c: v.astype(float), "returned float64.* instead of uint16"),
        (Plane.ADC, lambda v, c: None, "returned NoneType"),
        (Plane.ADC, lambda v, c: v * np.nan, "NaN or infinity"),
        (Plane.EXPOSURE, lambda v, c: v - 100, "negative number of electrons"),
        (Plane.CHARGE, lambda v, c: v - 100, "negative number of electrons"),
        (Plane.READOUT, lambda v, c: v + np.uint16(20000), "above the ADC's 16383"),
    ],
)
def test_a_misbehaving_effect_is_named(plane, function, words):
    settings = sensor().model_copy(update={"effects": (probe_at(plane, function),)})
    with pytest.raises(PchEmError, match=words):
        simulate_block(draw_truth(settings), settings, (0, 2))


def test_two_effects_of_one_tag_draw_different_numbers():
    truth = constant_truth(noise=0.0, exposure=0.0, bias=1000.0)
    single, double = (
        simulate_block(truth, sensor(effects=n * [{"tag": "row_noise", "row_noise_dn": 30.0}]), (0, 20))[0]
        - 1000.0
        for n in (1, 2)
    )
    assert (np.abs(double - 2 * single) > 2).any()


def test_block_size_follows_the_budget():
    assert frames_per_block(sensor(), 6, 8 * 42 * 10) == 10
    assert frames_per_block(sensor(), 6, 1) == 1
