"""The demonstration with a hidden effect from start to end: found, added, told beside the truth."""

import json

import pytest


@pytest.mark.long
def test_a_hidden_effect_is_found_and_told(shell):
    told = shell.ok(
        "demo", "--hidden", "row_noise", "--output", "out", "--size", "32", "--frames", "3000", "--quiet"
    ).stdout
    assert told.startswith("NAMED: ")
    assert "hidden was: row_noise" in told
    assert "named, and nothing else" in told
    run = shell.folder / "out" / "hidden.zarr"
    result = json.loads((run / "discrepancy.json").read_text())
    assert result["effects"] == ["row_noise"]
    assert "tag: row_noise" in (shell.folder / "out" / "hidden.yaml").read_text()
    page = (run / "discrepancy.html").read_text(encoding="utf-8")
    assert "What the model is missing" in page
    for name in ("maps", "codes", "frames", "lines", "gap", "pulls"):
        assert f'id="figure-discrepancy_{name}"' in page
