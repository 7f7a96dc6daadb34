"""Where the tests find what lies in the repository."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TESTS = ROOT / "tests"
SIPM = TESTS / "data" / "sipm"
