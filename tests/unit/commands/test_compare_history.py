"""The history file: a line for each run, and what it refuses."""

import subprocess
import sys
from pathlib import Path

import pytest

from pchem_pipeline.base.errors import StoreError
from pchem_pipeline.commands.compare.history import append_history, read_history


def row(name, **more):
    first = {"label": "", "date": "", "run": f"{name}.zarr", "bias_median": "1.5"}
    return {**first, **more, "id": name, "reference": "a"}


def test_lines_are_added_and_those_there_stay(tmp_path):
    path = tmp_path / "mein Labor µ" / "history.csv"
    assert read_history(path) == []
    append_history(path, [row("a"), row("b")])
    first = path.read_bytes()
    append_history(path, [row("c", hot_pixels="3")])  # a column of a later version
    assert path.read_bytes() == first + b",,c.zarr,1.5,c,a\n"
    assert [each["id"] for each in read_history(path)] == ["a", "b", "c"]
    assert read_history(path)[2]["hot_pixels"] == ""
    # of an editor or a spreadsheet: no end of line, a mark at the beginning
    path.write_bytes(b"\xef\xbb\xbf" + first.rstrip(b"\n"))
    append_history(path, [row("c")])
    assert [each["id"] for each in read_history(path)] == ["a", "b", "c"]


def test_two_processes_add_a_line_once(tmp_path):
    path = tmp_path / "history.csv"
    code = "import sys; sys.path.insert(0, sys.argv[1]); from test_compare_history import *\n"
    code += "for name in 'abcdefgh': append_history(Path(sys.argv[2]), [row(name), row(name + sys.argv[3])])"
    here = str(Path(__file__).parent)
    started = [subprocess.Popen([sys.executable, "-c", code, here, path, one]) for one in "12"]
    assert [each.wait() for each in started] == [0, 0]
    expected = [name + one for name in "abcdefgh" for one in ("", "1", "2")]
    assert sorted(each["id"] for each in read_history(path)) == expected


def test_an_interrupted_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "history.csv"
    append_history(path, [row("a")])
    before = path.read_bytes()

    def half(place, data):
        place.write_bytes(data[: len(data) - 5])
        raise KeyboardInterrupt

    monkeypatch.setattr("pchem_pipeline.store.disk.write", half)
    with pytest.raises(KeyboardInterrupt):
        append_history(path, [row("b")])
    assert path.read_bytes() == before
    assert sorted(each.name for each in tmp_path.iterdir()) == [".pchem", "history.csv"]


HEAD = "label,date,run,bias_median,id,reference"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("label;date;run\n", "is no history of this version; move it away"),
        ("label,date,run,bias_median\n", "is no history of this version; move it away"),
        (f"{HEAD}\n,,a.zarr,1.5,a,a\n,,b.zarr,1|5,b,a\n", "row 3: damaged .*1|5"),
        (f"{HEAD}\n,yesterday,a.zarr,1.5,a,a\n", "row 2: damaged .*yesterday"),
        (f"{HEAD}\n,,a.zarr,1.5,a,a,a\n", "row 2: damaged"),
        (f"{HEAD}\n,,a.z\udcff", "cannot be read"),
    ],
)
def test_a_damaged_history_is_refused(tmp_path, text, said):
    path = tmp_path / "history.csv"
    path.write_text(text, encoding="utf-8", errors="surrogateescape")
    with pytest.raises(StoreError, match=said):
        read_history(path)
