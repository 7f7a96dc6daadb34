"""The demonstration with a hidden effect from start to end: found, added, told beside the truth."""

import json

import pytest

GAIN = 0.0909  # e-/DN, of the simulated sensor


@pytest.mark.long
def test_a_hidden_effect_is_found_and_told(shell):
    told = shell.ok(
        "demo", "--hidden", "row_noise", "--output", "out", "--size", "32", "--frames", "3000", "--quiet"
    ).stdout
    assert told.startswith("NAMED: ")
    assert "hidden effect: row_noise" in told
    run = shell.folder / "out" / "demo.zarr"
    result = json.loads((run / "discrepancy.json").read_text())
    plain, extended = (
        next(line for line in part.splitlines() if line.startswith("read_noise_e")).split()
        for part in told.split("with the plain model:")[1].split("with the model found:")
    )
    # row noise counts as read noise until the model has it; columns: name, unit, true, estimated
    found = result["steps"][0]["parameters"]["row_noise_dn"]["value"]
    true, hidden = float(plain[2]), found * GAIN
    excess = (true**2 + hidden**2) ** 0.5 - true
    assert float(plain[3]) - float(extended[3]) == pytest.approx(excess, rel=0.3)
    assert result["effects"] == ["row_noise"]
    assert "tag: row_noise" in (shell.folder / "out" / "demo.effects.yaml").read_text()
    assert "What the model is missing" in (run / "discrepancy.html").read_text(encoding="utf-8")
