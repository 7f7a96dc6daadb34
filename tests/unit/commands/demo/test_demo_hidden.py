"""The demonstration with a hidden effect: what is hidden, where its key lies, and the comparison."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.discrepancy_material import step, verdict_of
from typer.testing import CliRunner

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.cli.app import app
from pchem_pipeline.commands.demo import hidden
from pchem_pipeline.commands.demo.comparison import COMPARED, compare, judgement
from pchem_pipeline.commands.demo.hidden import (
    SEALED_KEY,
    hidden_effect,
    run_hidden_demo,
)
from pchem_pipeline.effects.framework.region import Region, When
from pchem_pipeline.effects.framework.registry import effect_class, effect_classes
from pchem_pipeline.simulate.maps import draw_truth
from pchem_pipeline.simulate.settings import SimulateSettings

SETTINGS = SimulateSettings.model_validate({"shape": [12, 12], "n_frames": 60, "seed": 3})


def test_unknown_tags_are_refused_with_those_known(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"'rownoise'.*choose one of: adc_dnl, .*row_noise"):
        run_hidden_demo(tmp_path / "x", hidden="rownoise", size=8, n_frames=60, seed=1)
    assert not (tmp_path / "x").exists()


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").touch()
    with pytest.raises(ConfigError, match="is not empty; choose another folder"):
        run_hidden_demo(tmp_path, hidden="row_noise", size=8, n_frames=60, seed=1)
    (tmp_path / "hidden.json").write_text(json.dumps({"hidden": "row_noise", "size": 16}))
    with pytest.raises(ConfigError, match="another demonstration"):
        run_hidden_demo(tmp_path, hidden="row_noise", size=8, n_frames=60, seed=1)


@pytest.mark.parametrize("tag", sorted(effect_classes()))
def test_every_effect_can_be_hidden(tag: str) -> None:
    effect = hidden_effect(tag, SETTINGS, draw_truth(SETTINGS))
    assert effect.tag == tag
    hidden._check_tag(tag)


def test_an_effect_can_be_hidden_in_a_place() -> None:
    effect = hidden_effect("row_noise@columns=2:5,frames=10:20", SETTINGS, draw_truth(SETTINGS))
    assert effect.tag == "row_noise"
    everywhere = hidden_effect("row_noise", SETTINGS, draw_truth(SETTINGS)).model_dump()["row_noise_dn"]
    assert effect.model_dump()["row_noise_dn"] == pytest.approx(everywhere * (4 * 6) ** 0.5)
    assert effect.region == Region(columns=((2, 5),))
    assert effect.when == When(range=((10, 20),))
    with pytest.raises(ConfigError, match="columns=A:B"):
        hidden._check_tag("row_noise@colums=2:5")
    with pytest.raises(ConfigError, match="no such effect"):
        hidden._check_tag("rownoise@columns=2:5")
    with pytest.raises(ConfigError, match="the sensor has"):
        hidden_effect("row_noise@columns=2:9000", SETTINGS, draw_truth(SETTINGS))


def test_a_hidden_limit_cuts_few_samples_but_some() -> None:
    from pchem_pipeline.simulate.chain import simulate_block

    settings = SETTINGS.model_copy(update={"n_frames": 2000})
    truth = draw_truth(settings)
    low = hidden_effect("clipping", settings, truth).model_dump()["low"]
    share = (simulate_block(truth, settings, (0, 2000), electron_frames=0)[0] < low).mean()
    assert 0 < share <= 5e-5


def test_only_the_sealed_key_knows(tmp_path: Path) -> None:
    hidden._hide(tmp_path, "row_noise", 12, 60, 5)
    key = tmp_path / SEALED_KEY
    content = hidden._unpacked(key)
    assert json.loads(str(content["effect"]))["tag"] == "row_noise"
    assert set(content) == {*COMPARED, "effect"}
    for path in tmp_path.rglob("*"):
        if path.is_file() and path != key:
            assert b"row_noise" not in path.read_bytes(), path
            assert "truth" not in path.name
    text = (tmp_path / "hidden.yaml").read_text()
    assert "simulate:" not in text
    # nor does another effect show in what lies beside the frames
    other = tmp_path / "other"
    hidden._hide(other, "bias_drift", 12, 60, 5)
    assert (other / "hidden.yaml").read_text() == text


@pytest.mark.parametrize(
    ("verdict", "tag", "words"),
    [
        ("named", "row_noise", "named, and bias_drift besides, which is not there"),
        ("named", "bias_drift", "named, and row_noise besides, which is not there"),
        ("named", "adc_dnl", "not named, and row_noise, bias_drift besides, which is not there"),
        ("named", "charge_lag", "wrongly named: row_noise, bias_drift"),
        ("consistent", "charge_lag", "nothing was named, which is right"),
        ("consistent", "row_noise", "not named"),
        ("ambiguous", "periodic_pickup", "among the 3 that these frames leave open"),
        ("ambiguous", "adc_dnl", "not named"),
        ("named_in_part", "periodic_pickup", "not named, and row_noise besides, which is not there"),
    ],
)
def test_the_judgement(verdict: str, tag: str, words: str) -> None:
    hidden = hidden_effect(tag, SETTINGS, draw_truth(SETTINGS))
    assert judgement(verdict_of(verdict), hidden) == words


def test_a_candidate_alone_is_not_confirmed_and_has_its_errors() -> None:
    alone = step(None, "ambiguous", 120.0, 120.0)
    alone["candidates"] = alone["candidates"][:1]
    found = verdict_of("ambiguous", steps=[alone])
    hidden = effect_class("row_noise").model_validate({"row_noise_dn": 0.35})
    assert judgement(found, hidden) == "the only candidate, which these frames do not confirm"
    truth = dict.fromkeys(COMPARED, np.full((8, 8), 2.0))
    text = compare(found, hidden, truth, maps({}), maps({}, 3))
    assert "0.3512" in text
    assert "0.0041" in text


def test_named_alone_is_said_so() -> None:
    alone = verdict_of("named", effects=["row_noise"])
    hidden = effect_class("row_noise").model_validate({"row_noise_dn": 0.35})
    assert judgement(alone, hidden) == "named, and nothing else"


def maps(shift: dict[str, float], seed: int = 2) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    found: dict[str, Any] = {"quality": np.zeros((8, 8), np.uint8)}
    found["quality"][0, :3] = 2
    for name in COMPARED:
        values = 2.0 + shift.get(name, 0.0) + 0.01 * rng.standard_normal((8, 8))
        found[name] = np.where(found["quality"] == 2, np.nan, values)
        found[f"{name}_stderr"] = np.full((8, 8), 0.01)
    return found


def test_the_comparison_tells_parameters_and_biases() -> None:
    truth = dict.fromkeys(COMPARED, np.full((8, 8), 2.0))
    hidden = effect_class("row_noise").model_validate({"row_noise_dn": 0.36})
    text = compare(verdict_of("named"), hidden, truth, maps({"read_noise_e": 0.5}), maps({}, 3))
    rows = {line.split()[0]: line.split()[1:] for line in text.splitlines() if line.strip()}
    assert rows["row_noise_dn"] == ["0.36", "0.3512", "0.0041"]
    true, before, after, known, error = (float(word) for word in rows["read_noise_e,"][1:])
    assert (true, error) == (2.0, 0.01)
    # medians of 61 pixels: five standard errors
    assert before == pytest.approx(0.5, abs=5 * 1.2533 * 0.01 / 61**0.5)
    assert abs(after) < 5 * known
    assert known == pytest.approx(1.2533 * 0.01 / 61**0.5, rel=0.5)
    assert "medians over the 61 of 64 pixels" in text
    assert text.isascii()


def test_an_effect_that_cannot_be_shown_says_why() -> None:
    truth = dict.fromkeys(COMPARED, np.full((8, 8), 2.0))
    hidden = effect_class("charge_lag").typical()[0]
    text = compare(verdict_of("consistent"), hidden, truth, maps({}), maps({}))
    assert "nothing was named, which is right" in text
    assert "such frames cannot show it: Poisson electrons" in text


def test_without_good_pixels_there_are_no_biases() -> None:
    nothing = {**maps({}), "quality": np.full((8, 8), 2)}
    hidden = effect_class("row_noise").model_validate({"row_noise_dn": 0.36})
    truth = dict.fromkeys(COMPARED, np.full((8, 8), 2.0))
    assert "no biases" in compare(verdict_of("consistent"), hidden, truth, nothing, nothing)


@pytest.mark.parametrize(("options", "seed"), [([], None), (["--seed", "7"], 7)])
def test_the_command_line_passes_on(
    monkeypatch: pytest.MonkeyPatch, options: list[str], seed: int | None
) -> None:
    seen: list[Any] = []

    def run(output: Path, **given: Any) -> str:
        seen.append((output, given))
        return "told"

    monkeypatch.setattr(hidden, "run_hidden_demo", run)
    outcome = CliRunner().invoke(app, ["demo", "--hidden", "row_noise", "-o", "out", "-q", *options])
    assert outcome.stdout == "told\n"
    given = {"hidden": "row_noise", "size": 64, "n_frames": 4000, "seed": seed, "quiet": True}
    assert seen == [(Path("out"), given)]


def test_a_demonstration_that_was_stopped_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames, key and the maps of the plain model are made once."""
    calls: list[list[str]] = []
    monkeypatch.setattr(hidden, "run_stages", lambda target, stages, command: calls.append([*stages]))
    monkeypatch.setattr(hidden, "adopt_verdict", lambda target: (calls.append(["adopt"]), (target, None))[1])
    monkeypatch.setattr(hidden, "_maps", lambda target: {"quality": np.zeros(1)})
    monkeypatch.setattr(hidden, "_text", lambda output, target: "told")
    given: dict[str, Any] = {"hidden": "row_noise", "size": 8, "n_frames": 60, "seed": None}
    assert run_hidden_demo(tmp_path / "x", **given) == "told"
    key = (tmp_path / "x" / SEALED_KEY).read_bytes()
    plain = ["ingest", "histogram", "fit", "maps", "ensemble"]
    again = [["discrepancy"], ["adopt"], [*plain, "report"]]
    assert calls == [plain, *again]
    run_hidden_demo(tmp_path / "x", **given)
    assert calls[4:] == again
    assert (tmp_path / "x" / SEALED_KEY).read_bytes() == key
