"""What estimators guess where nothing is, or a relative, and of frames without an order in time: nothing."""

import functools
from dataclasses import replace

import pytest
from helpers.small_sensors import drawn_truth, seen, taken

from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence
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


@functools.cache
def evidence_of(hidden: str, seed: int = 22) -> Evidence:
    effects: tuple[Effect, ...] = ()
    if hidden:
        effects = (effect_class(hidden).model_validate({"tag": hidden, **RELATIVES[hidden]}),)
    return seen(taken(drawn_truth((24, 24)), *effects, n_frames=1200, seed=seed))


CASES = [(tag, hidden) for tag, relatives in SILENT.items() for hidden in ("", *relatives)]


@pytest.mark.parametrize(("tag", "hidden"), CASES)
def test_nothing_is_guessed_of_a_relative(tag, hidden):
    assert list(effect_class(tag).estimate(evidence_of(hidden))) == []


@pytest.mark.parametrize("tag", SILENT)
@pytest.mark.parametrize("seed", [6, 7])
def test_nothing_is_guessed_where_nothing_is(tag, seed):
    assert list(effect_class(tag).estimate(evidence_of("", seed))) == []


@pytest.mark.parametrize("tag", effect_classes())
def test_samples_without_an_order_in_time_do_no_harm(tag):
    kind, evidence = effect_class(tag), evidence_of("row_noise")
    z = {name: value for name, value in evidence.z.items() if not name.startswith(IN_TIME)}
    guesses = kind.estimate(replace(evidence, time=None, z=z))
    assert all(isinstance(guess, kind) for guess in guesses)
    # what the histograms of pixels and the counts per code tell is told without it
    in_time = all(name.startswith(IN_TIME) for name in kind.signature)
    assert not guesses or not (tag in SILENT or in_time)
