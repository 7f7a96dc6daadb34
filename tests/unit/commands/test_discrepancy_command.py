"""What ``pchem discrepancy`` prints once the run is fitted with the new model."""

from pchem_pipeline.commands.discrepancy import _changed_medians


def test_medians_before_and_after_have_their_errors_and_units():
    before = {"read_noise_e": (0.3512, 0.0011), "bias": (100.2, 0.11), "charge_rate": (1.0, 0.1)}
    after = {"read_noise_e": (0.2508, 0.0005), "bias": (100.17, 0.11)}
    lines = _changed_medians(before, after)
    assert lines[:2] == ["", "fitted with the new model:"]
    assert [" ".join(line.split()) for line in lines[2:]] == [
        "median read noise 0.3512 ± 0.0011 → 0.25080 ± 0.00050 e⁻",
        "median bias 100.20 ± 0.11 → 100.17 ± 0.11 DN",
    ]
    assert _changed_medians({}, after) == []
