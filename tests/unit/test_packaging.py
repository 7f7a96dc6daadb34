"""What is told of the package in other files: extras, systems, papers."""

import re
import tomllib
from collections import Counter
from pathlib import Path

import yaml

from pchem_pipeline import __version__
from pchem_pipeline.base.errors import EXTRAS, install_hint
from pchem_pipeline.compute import environment

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_messages_install_what_the_extras_are():
    told = {name: tuple(PROJECT["optional-dependencies"][name]) for name in EXTRAS}
    assert told == EXTRAS
    [everything] = PROJECT["optional-dependencies"]["all"]
    assert set(re.split(r"[\[\],]", everything)[1:-1]) == set(EXTRAS)
    assert install_hint("fits") == "pip install 'astropy>=6.1'"


def test_the_citation_is_of_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == __version__ == PROJECT["version"]
    assert {each["url"].rsplit("/", 1)[1] for each in citation["references"]} == {"2302.14654", "2403.04498"}


def test_memory_and_workers_of_this_process_are_known():
    assert environment.peak_rss_bytes() > 0
    assert environment.available_workers() >= 1


def test_no_folder_has_more_than_twenty_files_and_no_module_more_than_800_lines():
    modules = [*(ROOT / "pchem_pipeline").rglob("*.py")]
    assert not [path for path in modules if len(path.read_text(encoding="utf-8").splitlines()) > 800]
    assert not [path for path, n in Counter(path.parent for path in modules).items() if n > 20]
