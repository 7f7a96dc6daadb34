import itertools
import json
from typing import get_args

import pytest
import yaml
from helpers.places import ROOT
from pydantic import BaseModel

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.config.load import (
    dump_config,
    effects_file,
    load_config,
    parse_config,
    setting_of,
    write_config,
    write_model,
)
from pchem_pipeline.config.template import commented_config, json_schema
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.effects.framework.registry import effect_classes
from pchem_pipeline.effects.framework.settings import ModelSettings

CONFIGS = sorted((ROOT / "configs").glob("*.yaml"))


@pytest.mark.parametrize("simulated", [False, True])
def test_the_template_is_the_defaults_and_explains_every_setting(simulated):
    text = commented_config("c.yaml", files=["a.tif"], simulated=simulated)
    short = "run: {store: c.zarr}\ninput: {files: [a.tif]}\n"
    short += "simulate: {output: c-frames}\n" if simulated else ""
    assert parse_config(text) == parse_config(short)
    keys = [line for line in text.splitlines() if ":" in line and not line.lstrip().startswith("#")]
    comments = [line for line in text.splitlines() if line.lstrip().startswith("#")]
    assert len(comments) >= len(keys) > 30


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.name)
def test_shipped_configs_are_valid(path):
    load_config(path)


def test_simulated_input_is_what_is_simulated_and_files_may_be_one_place():
    found = parse_config("simulate: {output: cam, format: fits, bit_depth: 12, integration_time: 2.5}").input
    assert (found.files, found.format, found.bit_depth, found.integration_time) == (("cam",), "fits", 12, 2.5)
    assert parse_config("input: {files: 'frames/*.tif'}").input.files == ("frames/*.tif",)
    files = json.loads(json_schema())["$defs"]["InputSettings"]["properties"]["files"]
    assert {kind["type"] for kind in files["anyOf"]} == {"string", "array"}


def bomb(start):
    """Return lines in which nine aliases a line stand for a billion values."""
    names = "abcdefghij"
    lines = [f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]" for a, b in itertools.pairwise(names)]
    return "\n".join(["a: &a [x, x, x, x, x, x, x, x, x]", *lines, start])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("input: {files: 3}", "input.files: Input should be a list"),
        ("input: {files: [a]}\nfit: {algoritm: em}", "fit.algoritm: unknown key; did you mean algorithm?"),
        ("input: {files: [a]}\nrun: {bias: 1}", "run.bias: unknown key; the keys here are store, title"),
        ("input: {files: [a], integration_time: .nan}", "input.integration_time"),
        ("input: {files: [a], integration_time: 0}", "greater than 0"),
        ("input: {files: [a], integration_time: -1}", "input.integration_time"),
        ("input: {files: [a]}\nrun: {tile: 50}", "run.tile"),
        ("input: {files: [a]}\ninput: {files: [b]}", "'input' is given twice"),
        ("input: {files: [a]", "not valid YAML"),
        ("run:\n\tstore: x.zarr", "indent with spaces, not with tabs"),
        ("- a", "no settings"),
        ("", "no settings"),
        ("run: {tile: 64}", "no input"),
        ("simulate: {shape: [0, 4]}", "simulate"),
        ("simulate: {n_frames: many}", "simulate.n_frames"),
        # hostile ones
        ("input: " + "[" * 5000, "not valid YAML"),
        ("input: " + "{a: " * 5000, "not valid YAML"),
        (bomb("input: {files: *j}"), "write the settings out"),
        ("run: &a {store: *a}", "write the settings out"),
        ("input: !!python/object/apply:os.mkdir [trace]", "not valid YAML"),
        ("run: {tile: " + "9" * 5000 + "}", "not valid YAML"),
        ("run: {store: a\0b}", "not valid YAML"),
        ("nothing: 1\nrun: {store: '" + "µ日本" * 100_000 + "'}", "nothing: unknown key"),
        ("run: {" + ", ".join(f"k{i}: 1" for i in range(500)) + "}", "and 480 more"),
        ("run: {tile: [" + "x, " * 50_000 + "]}", "run.tile"),
        ("? [1, 2]\n: x", "a key is a list or a mapping"),
        ("run: {tile: 0x" + "f" * 5000 + "}", "a number of 5002 digits"),
        ('run: {store: "a\\0b"}', "a text is no valid name"),
        ("\n".join(f"k{i}: 1" for i in range(30_000)), "a section of 30000 keys"),
        ("input: {files: [a], integration_time: 1.0e-300}", "integration_time must be at least 1e-12 s"),
        ('run: {"\\e[31m": 1}', "run.\\x1b[31m: unknown key"),
    ],
)
def test_wrong_and_hostile_settings_say_what_and_where_in_one_short_line(text, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError) as caught:
        parse_config(text, "c.yaml")
    said = str(caught.value)
    assert said.startswith("c.yaml: ")
    assert words in said
    assert said.isprintable()
    assert len(said) < 4100
    assert not (tmp_path / "trace").exists()


def test_missing_and_undecodable_files(tmp_path):
    with pytest.raises(ConfigError, match="pchem init"):
        load_config(tmp_path / "none.yaml")
    (tmp_path / "bad.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="cannot be read"):
        load_config(tmp_path / "bad.yaml")


def test_settings_are_read_by_dotted_name():
    config = parse_config("input: {files: [a], roi: [0, 8, 0, 9]}")
    assert setting_of(config, "input.roi") == [0, 8, 0, 9]
    assert setting_of(config, "run.tile") == "auto"
    assert yaml.safe_dump(setting_of(config, "fit"))


@pytest.mark.parametrize(
    "url",
    [
        "s3://key:SECRET@bucket/*.tif",
        "HTTPS://lab:SECRET@camera.example/a.tif",
        "https://b.s3.amazonaws.com/a.tif?X-Amz-Credential=k&X-Amz-Signature=SECRET",
        "https://example.org/a.tif?access_token=SECRET",
    ],
)
@pytest.mark.parametrize("text", ["input: {{files: ['{}']}}", "run: {{store: '{}'}}"])
def test_a_url_with_a_secret_is_refused_and_not_repeated_and_others_are_taken(text, url):
    with pytest.raises(ConfigError, match="a password, key or signature") as caught:
        parse_config(text.format(url))
    assert "SECRET" not in str(caught.value)
    for url in ("s3://bucket/a@b:c/*.tif", "https://host:8080/a.tif?raw=1", "C:/a@b.tif", "a:b@c"):
        assert parse_config(f"input: {{files: ['{url}']}}").input.files == (url,)


def test_many_scripts_and_keys_of_earlier_versions_are_read():
    text = "Ελληνικά кириллица 日本語 한국어 عربى עברית हिन्दी ไทย ქართული አማርኛ 😀"
    config = parse_config(f"run: {{store: '{text}.zarr'}}\ninput: {{files: ['{text}.npy']}}")
    assert parse_config(dump_config(config)) == config
    assert text in dump_config(config)
    text = "input: {files: [a.npy]}\nreport: {figure_formats: [svg], dpi: 72, map_stretch: linear}\n"
    assert parse_config(text) == parse_config("input: {files: [a.npy]}\n")


ROW = {"tag": "row_noise", "row_noise_dn": 1.2}
TEXT = """# mine
input: {files: ['a.npy']}   # "here"
model:
  effects: [{tag: row_noise, row_noise_dn: 0.7}]  # found by hand
"""


def model(*effects, aside=()):
    return ModelSettings.model_validate({"effects": list(effects), "set_aside_e": aside})


def test_a_model_beside_the_yaml_counts_until_the_yaml_has_it_again(tmp_path):
    path, link = tmp_path / "run.yaml", tmp_path / "link" / "run.yaml"
    path.write_text(TEXT)
    link.parent.mkdir()
    link.symlink_to(path)
    wanted = model(ROW, {"tag": "clipping", "high": 900}, aside=[[None, 0.5]])
    assert write_model(link, wanted) == effects_file(path) == tmp_path / "run.effects.yaml"
    assert load_config(path).model == load_config(link).model == wanted
    assert load_config(path).input == parse_config(TEXT).input
    path.write_text(TEXT.replace("found by hand", "a comment") + "fit: {gap_threshold: 4}\n")
    assert load_config(path).model == wanted
    assert write_model(path, parse_config(TEXT).model) == path
    assert not effects_file(path).exists()
    assert path.read_text() == TEXT.replace("found by hand", "a comment") + "fit: {gap_threshold: 4}\n"


def test_a_model_of_the_yaml_that_was_changed_meanwhile_is_refused(tmp_path):
    path = tmp_path / "run.yaml"
    path.write_text(TEXT)
    write_model(path, model(ROW))
    path.write_text(TEXT.replace("0.7", "0.8"))
    words = r"run\.yaml: the section model was changed.* delete run\.effects\.yaml"
    with pytest.raises(ConfigError, match=words):
        load_config(path)
    with pytest.raises(ConfigError, match=r"holds the model of run\.yaml; give that file"):
        load_config(effects_file(path))
    effects_file(path).unlink()
    assert load_config(path).model == model({**ROW, "row_noise_dn": 0.8})
    write_model(path, model())
    write_config(path, TEXT)  # a new YAML has its own model
    assert load_config(path) == parse_config(TEXT)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("model: [", "not valid YAML"),
        ("model: {}", r"instead_of: Field required"),
        ("{model: {effects: [{tag: row_noise, row_noise_dn: -1}]}, instead_of: {}}", "model.effects.0"),
        ("{model: {effect: []}, instead_of: {}}", r"did you mean effects\?"),
    ],
)
def test_a_damaged_file_beside_the_yaml_is_refused_by_name(tmp_path, text, words):
    path = tmp_path / "run.yaml"
    path.write_text(TEXT)
    effects_file(path).write_text(text)
    with pytest.raises(ConfigError, match=rf"run\.effects\.yaml: .*{words}"):
        load_config(path)


def test_every_effect_can_be_written(tmp_path):
    path = tmp_path / "run.yaml"
    path.write_text(TEXT)
    shared = {"of": "row", "share": 1.0, "changes": "gain", "signal_dn": 7.5, "burst": 0.1}
    measured = {"tag": "empirical_noise", "noise_dn": 1.5, "modes": [shared], "region": {"columns": [[3, 9]]}}
    typical = [effect for kind in effect_classes().values() for effect in kind.typical()]
    for effect in (*typical, *model(measured).effects):
        wanted = ModelSettings(effects=(effect,))
        write_model(path, wanted)
        assert load_config(path).model == wanted, effect.tag


def test_no_setting_is_called_what_yaml_takes_for_true_or_false():
    def models(annotation):
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            return {annotation}
        return {part for inner in get_args(annotation) for part in models(inner)}

    kinds, looked = {RunConfig, *effect_classes().values()}, set()
    while kinds - looked:
        kind = (kinds - looked).pop()
        looked.add(kind)
        for name, field in kind.model_fields.items():
            assert yaml.safe_load(name) == name, (kind, name)
            kinds |= models(field.annotation)
