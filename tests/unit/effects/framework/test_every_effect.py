"""Properties of every effect: described, neutral at no strength, the same frames in any division."""

import itertools

import numpy as np
import pytest
from helpers.small_sensors import a_sensor, make, simulated
from pydantic import ValidationError

from pchem_pipeline.discrepancy.by_simulation.candidates.candidates import candidate_classes
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.registry import effect_classes
from pchem_pipeline.simulate import chain

KINDS = effect_classes()
JUMPS = (((0, 1.0), (5, -2.0), (9, 0.0)), ((3, 1.0),), (), ((2, 0.5), (11, 4.0)))
UNTESTABLE = {"charge_lag", "charge_diffusion", "spurious_charge"}
SHAPE, N_FRAMES = (8, 7), 40
# strong enough to be seen in 40 small frames
STRONG: list[Effect] = [
    make("analog_memory", memory=0.4),
    make("flicker_noise", share=0.9, correlation_frames=7.0),
    make("flicker_noise", share=0.9, correlation_frames=0.4),
    make("flicker_noise", share=0.9, correlation_frames=90.0, spectrum="one_over_f"),
    make("gain_drift", drift=0.4),
    make("gain_drift", drift=0.4, shape="path", path=(-0.5, 0.5, -0.5)),
    make("gain_drift", drift=0.4, shape="settling"),
    make("heavy_tailed_noise", share=0.3, factor=4.0),
    make("interpixel_capacitance", coupling=0.1, anisotropy=0.3),
    make("noise_skew", share=-0.9),
    make("nonlinearity", step_change=0.1),
    make("nonlinearity", step_change=0.1, noise="bent"),
    make("rts_noise", fraction=0.5, amplitude_e=2.0, probability=0.7),
    make("rts_noise", fraction=0.5, amplitude_e=2.0, probability=0.7, samples=4, spread="exponential"),
    make("rts_noise", fraction=0.5, amplitude_e=2.0, sampling="single", correlation_frames=11.0),
    make("rts_noise", fraction=0.5, amplitude_e=2.0, sampling="single", spread="lognormal", times_spread=0.9),
    make("signal_dependent_noise", noise_e=0.5),
    make("signal_dependent_noise", noise_e=0.5, growth="linear"),
    make("bias_drift", drift_dn=9),
    make("bias_drift", drift_dn=9, shape="path", path=(1.0, 5.0, -3.0)),
    make("bias_drift", drift_dn=9, shape="walk"),
    make("bias_drift", drift_dn=9, shape="settling"),
    make("bias_jumps", amplitude_dn=9, rate=0.2, levels=4),
    make("bias_jumps", amplitude_dn=9, path=JUMPS),
    make("bias_jumps", amplitude_dn=9, rate=0.2, parts="left_right"),
    make("frame_noise", frame_noise_dn=9),
    make("row_noise", row_noise_dn=9),
    make("column_noise", column_noise_dn=9),
    make("periodic_pickup", amplitude_dn=9, cycles_per_row=0.1, cycles_per_frame=-0.3, cycles_per_column=0.2),
    make("periodic_pickup", amplitude_dn=9, cycles_per_row=0.1, random_phase=True),
    make("readout_alternation", alternation_dn=-9),
    make("adc_dnl", dnl_lsb=0.9),
    make("adc_dnl", dnl_lsb=0.9, per_column=True),
    make("adc_dnl", dnl_lsb=-0.9, pattern="bit", bit=2),
    make("adc_inl", inl_lsb=3, period_dn=50),
    make("clipping", low=98, high=140),
    make("repeated_frames", probability=0.4),
    make("repeated_frames", frames=(1, 2, 3, 7, 13, 18, 19), rows=(1, 4)),
    make("adc_dnl", dnl_lsb=0.9, pattern="edges", first_code=104, edges=(1.0, -1.0)),
]
EVERY: list[Effect] = [
    *STRONG,
    *(effect for kind in KINDS.values() for effect in kind.typical()),
    make("exposure_drift", drift=0.5, path=(0.0, 3.0, 1.0)),
    make("persistence", peak_e=1.0, decay_frames=9.0, slow_decay_frames=50.0, image=((1.0, 0.0), (0.5, 0.2))),
    make("dark_current_rts", fraction=0.4, steps="exponential", dwell_low_frames=3.0, dwell_high_frames=2.0),
    make("cosmic_rays", tracks_per_frame=0.7),
    make("cosmic_rays", tracks_per_frame=0.7, cloud_share=0.5, cloud_range=0.4),
    make("overdispersed_counts", relative_variance=0.3),
    make("overdispersed_counts", relative_variance=0.3, exposures="lognormal"),
    make("branching_counts", branching=0.3),
    *(make("misplaced_lines", share=0.3, move=move) for move in ("early", "sample_twice", "line_lost")),
    *(make("misplaced_lines", share=0.3, move=move, lines="columns") for move in ("swapped", "line_twice")),
    make("black_clamp", follow=1.0, rows=(0, 2)),
    make("read_order_noise", noise_dn=1.0, taps=2),
    make("empirical", share=0.4, moves=[{"towards": (-1, 0, 0), "part": 0.5}, {"towards": (0, 1, 0)}]),
    make(
        "empirical_noise",
        noise_dn=3.0,
        modes=[
            {"of": "sample", "share": 0.5, "lags": [(1, 1, 0), (0, 0, 1)], "correlation": [0.2, 0.2]},
            {"of": "row", "share": 0.5, "lags": [(0, 2, 0)], "correlation": [-0.4]},
        ],
    ),
    make(
        "empirical_electrons",
        chance=0.1,
        modes=[{"fate": "followed", "place": place} for place in ((1, 0, 0), (0, 1, 0))]
        + [{"fate": "moved", "place": (0, 1, 0)}],
    ),
]
# a list of frames stays what it is at any strength
SCALED = [effect for effect in EVERY if effect.strength and getattr(effect, effect.strength)]


def frames(*effects, shape=SHAPE, n=N_FRAMES, **part):
    """Return frames and electron numbers of a sensor with effects."""
    return simulated(a_sensor(shape), *effects, n_frames=n, seed=8, **part)


@pytest.mark.parametrize("tag", sorted(KINDS))
def test_every_effect_is_described(tag):
    kind = KINDS[tag]
    assert kind.title
    assert kind.source
    assert (kind.factors is None) == tag.startswith("empirical")
    assert kind.power > 0
    assert kind.strength in kind.model_fields or tag == "clipping"
    assert bool(kind.untestable) == (tag in UNTESTABLE)
    # empirical effects have estimators of their own, no rivals, and compete with nothing
    competes = tag not in UNTESTABLE and not tag.startswith("empirical")
    assert (tag in candidate_classes(DiscrepancySettings())) == competes
    assert bool(kind.signature) == bool(kind.separate) == competes
    assert set(kind.signature) <= set(STATISTICS)
    assert set(kind.separate) <= KINDS.keys() - {tag}
    assert all(kind.separate.values())
    assert bool(kind.typical()) == (tag != "clipping")
    for effect in kind.typical():
        assert isinstance(effect, kind)
        assert getattr(effect, kind.strength) != 0
        twice = getattr(effect.scaled(2.0), kind.strength)
        # all of the samples is the most that a correction can replace
        largest = 1.0 if tag == "pixel_correction" else np.inf
        assert twice == pytest.approx(min(2 * getattr(effect, kind.strength), largest))
        assert kind.model_validate(effect.model_dump(mode="json")) == effect


@pytest.mark.parametrize("effect", SCALED, ids=repr)
def test_no_strength_is_no_effect_to_the_bit(effect):
    for with_it, plain in zip(frames(effect.scaled(0.0)), frames(), strict=True):
        np.testing.assert_array_equal(with_it, plain)


@pytest.mark.parametrize("effect", STRONG, ids=repr)
def test_strength_is_seen(effect):
    assert (frames(effect)[0] != frames()[0]).mean() > (0.05 if effect.plane.value == "analog" else 0)


@pytest.mark.parametrize("effect", EVERY, ids=repr)
def test_every_division_gives_the_same_frames(effect, monkeypatch):
    effects = (effect, make("optical_crosstalk", probability=0.2), make("charge_lag", fraction=0.2))
    whole = frames(*effects)
    monkeypatch.setattr(chain, "_SAMPLES_AT_ONCE", 1)
    for t, y in itertools.product([(0, 1), (1, 18), (18, 40)], [(0, 3), (3, 4), (4, 8)]):
        for a, b in zip(frames(*effects, frames=t, rows=y), whole, strict=True):
            np.testing.assert_array_equal(a, b[slice(*t), slice(*y)])


@pytest.mark.parametrize("effect", SCALED, ids=repr)
def test_the_largest_strengths_work(effect):
    truth = a_sensor((4, 4), exposure=(20.0, 50.0))
    assert simulated(truth, effect.scaled(1e9), n_frames=5)[1].max() < 2**31


@pytest.mark.parametrize("effect", EVERY, ids=repr)
def test_a_run_of_one_frame_and_a_sensor_of_one_pixel(effect):
    assert frames(effect, shape=(1, 1), n=1)[0].shape == (1, 1, 1)


def beyond_limits():
    """Yield for every limit of every field a value beyond it."""
    for tag, kind in KINDS.items():
        for name, field in kind.model_fields.items():
            for limit in field.metadata:
                for bound, step in (("ge", -1), ("gt", 0), ("lt", 0), ("le", 1)):
                    if (value := getattr(limit, bound, None)) is not None:
                        yield pytest.param(tag, {name: value + step}, name, id=f"{tag}.{name} {bound}")
            if kind.unit(name) and "float" in str(field.annotation):
                yield pytest.param(tag, {name: float("nan")}, name, id=f"{tag}.{name} finite")


@pytest.mark.parametrize(("tag", "values", "name"), list(beyond_limits()))
def test_numbers_beyond_their_limits_are_refused_by_name(tag, values, name):
    effect = next(iter(KINDS[tag].typical()), None)
    given = {"tag": tag, "low": 3} if effect is None else effect.model_dump()
    with pytest.raises(ValidationError, match=rf"(?s){name}.*(greater|less|finite|at least|at most)"):
        KINDS[tag].model_validate(given | values)


@pytest.mark.parametrize(
    ("tag", "values", "words"),
    [
        ("adc_dnl", {"dnl_lsb": 0.1, "pattern": "edges"}, "belong together"),
        ("adc_dnl", {"dnl_lsb": 0.1, "edges": [0.1]}, "belong together"),
        ("adc_dnl", {"dnl_lsb": 0.1, "pattern": "bit", "per_column": True}, "is for pattern random"),
        ("adc_inl", {"inl_lsb": 20, "period_dn": 50}, "turns the curve back"),
        ("adc_inl", {"inl_lsb": 20, "form": "curve", "curve": [0, 1, 0, -1]}, "turns the curve back"),
        ("adc_inl", {"inl_lsb": 1, "form": "curve"}, "belong together"),
        ("adc_inl", {"inl_lsb": 1, "curve": [0, 1, 0, -1]}, "belong together"),
        ("adc_inl", {"inl_lsb": 1, "form": "curve", "curve": [0, 1]}, "at least 4 values, got 2"),
        ("bias_drift", {"drift_dn": 1, "shape": "path"}, "needs `path` with 2 values"),
        ("bias_drift", {"drift_dn": 1, "path": [1, 2]}, "leave one of them out"),
        ("bias_jumps", {"amplitude_dn": 1, "path": [[[0, 1]]]}, "each of 4 quadrants, got 1"),
        ("bias_jumps", {"amplitude_dn": 1, "path": [[[5, 1], [2, 0]], [], [], []]}, "must increase"),
        ("bias_jumps", {"amplitude_dn": 1, "parts": "top_bottom", "path": [[]] * 4}, "2 top_bottom, got 4"),
        ("binary_offset", {"offset_dn": 1.0, "bits": (0.0, 0.0)}, "all 0"),
        ("black_clamp", {"follow": 0.1, "rows": (3, 3)}, "holds no line"),
        ("clipping", {}, "does nothing"),
        ("clipping", {"low": 5, "high": 5}, "not below"),
        ("exposure_drift", {"drift": 0.1, "path": (1.0, 1.0)}, "two different values"),
        ("exposure_drift", {"drift": 0.1, "path": (1.0, 2.0), "settling_fraction": 0.1}, "give one of them"),
        ("exposure_drift", {"drift": 0.1, "path": (1.0, np.nan)}, "finite"),
        ("exposure_flicker", {"rms": 0.1, "period_frames": 5.0, "correlation_frames": 2.0}, "leave one"),
        ("exposure_flicker", {"rms": 0.1, "levels": (1, 2), "period_frames": 3.0}, "a sine has no levels"),
        ("exposure_flicker", {"rms": 0.1, "levels": (1.0, 1.0)}, "two different"),
        ("exposure_flicker", {"rms": 0.1, "levels": (1, 2), "shares": (0.5,)}, "1 shares for 2 levels"),
        ("exposure_flicker", {"rms": 0.1, "levels": (1, 2), "shares": (0.5, 0.6)}, "sum to 1"),
        ("gain_drift", {"drift": 0.1, "shape": "path"}, "needs `path`"),
        ("gain_drift", {"drift": 0.1, "path": (0.0, 1.0)}, "leave one of them out"),
        ("gain_drift", {"drift": 0.5, "shape": "path", "path": (0.0, 0.0, 10.0)}, "gain to zero"),
        ("persistence", {"peak_e": 1, "decay_frames": 1, "image": ((1.0,), (1.0, 2.0))}, "different lengths"),
        ("persistence", {"peak_e": 1, "decay_frames": 1, "image": ((-1.0, 1.0),)}, "numbers >= 0"),
        ("repeated_frames", {"frames": [0]}, "frame 0 is the first"),
        ("repeated_frames", {"rows": [3, 3]}, "hold none"),
        ("row_noise", {}, "row_noise_dn"),
        ("row_noise", {"row_noise_dn": "much"}, "valid number"),
    ],
)
def test_parameters_that_contradict_each_other_are_refused(tag, values, words):
    with pytest.raises(ValidationError, match=words):
        KINDS[tag].model_validate({"tag": tag, **values})
