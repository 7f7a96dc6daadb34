"""The section simulate: what it accepts, what it refuses and with which words."""

import pytest
from pydantic import ValidationError

from pchem_pipeline.config.load import parse_config
from pchem_pipeline.config.template import commented_config
from pchem_pipeline.simulate.settings import ParameterSettings, SimulateSettings

CONSTANT = {"kind": "constant", "value": 0.1}


def test_giving_the_second_way_replaces_the_first():
    parameters = ParameterSettings(dark_current=CONSTANT, conversion_gain=CONSTANT)
    assert list(parameters.given()) == ["dark_current", "conversion_gain", "bias", "analog_read_noise_e"]
    assert ParameterSettings.model_validate_json(parameters.model_dump_json()) == parameters


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"n_frames": 0}, "greater than or equal to 1"),
        ({"shape": [0, 4]}, "no pixels"),
        ({"shape": [4, 70000]}, "larger than 65535"),
        ({"integration_time": 0}, "greater than 0"),
        ({"integration_time": float("nan")}, "finite"),
        ({"format": "gif"}, "tiff"),
        ({"frame_count": 5}, "Extra inputs"),
        ({"parameters": {"quanta_exposure": CONSTANT, "dark_current": CONSTANT}}, "exactly one of"),
        ({"parameters": {"dn_per_electron": None}}, "exactly one of"),
        ({"parameters": {"bias": {"kind": "normal", "mean": 1, "std": 0}}}, "greater than 0"),
        ({"parameters": {"bias": {"kind": "uniform", "low": 2, "high": 1}}}, "not below"),
        ({"parameters": {"bias": {"kind": "loguniform", "low": 2, "high": 1}}}, "not below"),
        ({"parameters": {"bias": {**CONSTANT, "minimum": 2, "maximum": 1}}}, "not below"),
        ({"parameters": {"bias": {"kind": "cauchy"}}}, "cauchy"),
        ({"parameters": {"dead_fraction": 0.6, "stuck_fraction": 0.6}}, "above 1"),
        ({"effects": ["earthquake"]}, "unknown; known are"),
        ({"effects": ["rownoise"]}, "unknown; did you mean row_noise.; known are"),
        ({"effects": [{"row_noise_dn": 1}]}, "needs a tag"),
        ({"effects": [{"tag": "row_noise", "row_noise": 1}]}, "row_noise_dn"),
    ],
)
def test_what_is_refused(change, words):
    with pytest.raises(ValidationError, match=words):
        SimulateSettings.model_validate(change)


def correlated(*pairs):
    correlations = [{"between": [a, b], "rank": rank} for a, b, rank in pairs]
    return ParameterSettings.model_validate({"correlations": correlations})


BOTH = [("bias", "quanta_exposure", 0.9), ("bias", "dn_per_electron", 0.9)]


@pytest.mark.parametrize(
    ("pairs", "words"),
    [
        ([("bias", "bias", 0.5)], "with itself"),
        ([("bias", "quanta_exposure", 1.5)], "less than 1"),
        ([("bias", "dark_current", 0.5)], "unknown parameter"),
        ([("bias", "quanta_exposure", 0.5), ("quanta_exposure", "bias", 0.4)], "given twice"),
        ([*BOTH, ("quanta_exposure", "dn_per_electron", -0.9)], "contradict"),
    ],
)
def test_impossible_correlations_are_refused_and_strong_but_possible_ones_are_not(pairs, words):
    with pytest.raises(ValidationError, match=words):
        correlated(*pairs)
    assert len(correlated(*BOTH, ("quanta_exposure", "dn_per_electron", 0.8)).correlations) == 3


def test_the_commented_yaml_of_a_simulated_run_gives_the_defaults():
    text = commented_config("config.yaml", files=[], simulated=True)
    assert parse_config(text).simulate == SimulateSettings(output="config-frames")
    assert "loguniform (low, high)" in " ".join(text.replace("#", " ").split())
