"""What estimators guess of nothing, of a relative, and of frames without an order in time or few pixels."""

import functools
from dataclasses import replace

import numpy as np
import pytest
from helpers.small_sensors import drawn_truth, make, seen, taken

from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.registry import effect_class, effect_classes

RELATIVES = {
    "interpixel_capacitance": {"coupling": 0.01},
    "row_noise": {"row_noise_dn": 1.0},
    "frame_noise": {"frame_noise_dn": 2.0},
    "exposure_flicker": {"rms": 0.05},
    "optical_crosstalk": {"probability": 0.02},
    "signal_dependent_noise": {"noise_e": 0.03},
}
#: Effects, and those of the relatives that they are most easily confused with.
SILENT = {
    "binary_offset": ("interpixel_capacitance", "row_noise"),
    "bit_errors": (),
    "black_clamp": ("frame_noise", "exposure_flicker"),
    "gain_stitch": ("signal_dependent_noise",),
    "glow": ("exposure_flicker", "optical_crosstalk"),
    "misplaced_lines": ("row_noise", "interpixel_capacitance"),
    "pixel_correction": ("row_noise", "frame_noise"),
    "read_order_noise": ("row_noise",),  # coupled neighbours may well be taken for it, and the search decides
    "repeated_frames": ("row_noise", "frame_noise"),
    "repeated_lines": ("row_noise", "interpixel_capacitance"),
}
IN_TIME = ("frame.", "time.", "space.")
EVERY = effect_classes()


@functools.cache
def evidence_of(hidden, seed=22):
    effects: tuple[Effect, ...] = ()
    if hidden:
        effects = (effect_class(hidden).model_validate({"tag": hidden, **RELATIVES[hidden]}),)
    return seen(taken(drawn_truth((24, 24)), *effects, n_frames=1200, seed=seed))


CASES = [(tag, hidden) for tag, relatives in SILENT.items() for hidden in ("", *relatives)]


@pytest.mark.parametrize(("tag", "hidden"), CASES)
def test_nothing_is_guessed_of_a_relative(tag, hidden):
    assert list(effect_class(tag).estimate(evidence_of(hidden))) == []


def test_nothing_is_guessed_where_nothing_is():
    # some are guessed by chance in 2 to 5 % of stacks
    fired = [tag for seed in range(10, 16) for tag in EVERY if EVERY[tag].estimate(evidence_of("", seed))]
    assert len(fired) <= 7, fired
    assert not set(fired) & SILENT.keys()


@pytest.mark.parametrize("tag", EVERY)
def test_samples_without_an_order_in_time_do_no_harm(tag):
    kind, evidence = effect_class(tag), evidence_of("row_noise")
    z = {name: value for name, value in evidence.z.items() if not name.startswith(IN_TIME)}
    guesses = kind.estimate(replace(evidence, time=None, z=z))
    assert all(isinstance(guess, kind) for guess in guesses)
    # what the histograms of pixels and the counts per code tell is told without it
    in_time = all(name.startswith(IN_TIME) for name in kind.signature)
    assert not guesses or not (tag in SILENT or in_time)


@pytest.mark.parametrize("shape", [(1, 1), (1, 4), (3, 1), (1, 30), (30, 1), (2, 5)])
def test_few_pixels_do_no_harm(shape):
    hidden = (make("exposure_drift", drift=0.9), make("dark_current_rts", fraction=0.5, step_e=0.5))
    evidence = seen(taken(drawn_truth(shape), *hidden, n_frames=1000))
    found = {tag: kind.estimate(evidence) for tag, kind in EVERY.items()}
    assert all(len(guesses) <= 6 for guesses in found.values())
    assert np.prod(shape) < 10 or abs(found["exposure_drift"][0].drift - 0.9) < 0.3


def test_a_sensor_without_a_usable_pixel_does_no_harm():
    evidence = evidence_of("exposure_flicker")
    maps = replace(evidence.maps, usable=np.zeros_like(evidence.maps.usable))
    # the counts per code and the tracks of particles are there without it
    for tag in EVERY.keys() - {"cosmic_rays"}:
        assert len(EVERY[tag].estimate(replace(evidence, maps=maps, z={}))) == 0, tag
