"""The documentation is built with warnings as errors, and names what there is."""

import ast
import re
import subprocess
import sys

import pytest
from helpers.places import ROOT

from pchem_pipeline.base.variables import VARIABLES
from pchem_pipeline.cli.app import app
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.effects.framework.registry import effect_classes


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", ROOT / "docs", folder]
    result = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    return folder


def text_of(page):
    return re.sub(r"<[^>]+>", "", page.read_text(encoding="utf-8"))


def test_every_command_setting_array_and_effect_is_there(site):
    reference = {name: text_of(site / "reference" / f"{name}.html") for name in
                 ("commands", "settings", "store", "effects")}  # fmt: skip
    for command in app.registered_commands:
        assert f"pchem {command.name or command.callback.__name__}" in reference["commands"]
    for section in RunConfig.model_fields:
        assert re.search(rf"^\s*{section}\b", reference["settings"], re.M), section
    for variable in VARIABLES.values():
        assert variable.long_name.split("$")[0][:40] in reference["store"].replace("&#39;", "'"), (
            variable.path
        )
    own = [tag for tag, c in effect_classes().items() if c.__module__.startswith("pchem_pipeline.")]
    for tag in own:
        assert tag in reference["effects"]


def _texts():
    """Yield every text of the package, with … for what is filled in."""
    for path in (ROOT / "pchem_pipeline").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            parts = node.values if isinstance(node, ast.JoinedStr) else [node]
            words = [part.value if isinstance(part, ast.Constant) else "…" for part in parts]
            if all(isinstance(word, str) for word in words):
                yield "".join(words)


def test_the_messages_that_are_explained_are_those_of_the_program():
    page = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    messages = re.findall(r"^\*\*`(.+)`\*\*$", page, re.M)
    assert len(messages) == len(set(messages)) >= 20
    texts = [text for text in _texts() if len(text) > 10]
    for message in messages:
        assert any(message in text for text in texts), message
    for section, key in re.findall(r"`(\w+)\.(\w+)(?:: \w+)?`", page):
        if section in RunConfig.model_fields and key not in ("yaml", "zarr"):
            assert key in RunConfig.model_fields[section].annotation.model_fields, key
