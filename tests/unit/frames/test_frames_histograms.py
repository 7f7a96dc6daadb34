"""Ready-made histograms: layouts, refusals, and the measured SiPM spectra."""

import numpy as np
import pytest

from pchem_pipeline.base.errors import ConfigError, InputError
from pchem_pipeline.frames.histogram_files import is_histogram_input, read_histograms
from pchem_pipeline.frames.identity import content_identity
from pchem_pipeline.frames.settings import InputSettings

DN = np.array([100, 101, 102, 104])
COUNTS = np.array([3, 0, 7, 2])
WANTED = [3, 0, 7, 0, 2]


def read(folder, *files, **settings):
    return read_histograms(InputSettings(files=files, format="histogram", **settings), folder)


@pytest.mark.parametrize(
    "text",
    [
        "DN,count\n100,3\n101,0\n102,7\n104,2\n",
        "Energy,Count\n100,3\n101,0\n102,7\n104,2",
        "100,3\n101,0\n102,7\n104,2\n",
        "# a remark\n\n100.0, 3.0\r\n101.0, 0\r\n102, 7\r\n104, 2\r\n",
        "DN;count\n100;3\n101;0\n102;7\n104;2\n",
        "100\t3\n101\t0\n102\t7\n104\t2\n",
        "dn count\n100 3\n101 0\n102 7\n104 2\n",
        "\ufeffDN,count\n98,0\n100,3\n102,7\n104,2\n250,0\n",
        "DN,count,\n100,3,\n102,7,\n104,2,\n",
    ],
)
def test_csv(tmp_path, text):
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    found = read(tmp_path, "a.csv")
    assert found.counts.dtype == np.uint32
    assert found.counts.tolist() == [[WANTED]]
    assert found.origin.tolist() == [[100]]
    assert (found.names, found.origin.shape) == (("a",), (1, 1))
    assert any("are taken as 0" in note for note in found.notes)


def test_several_columns_are_several_channels(tmp_path):
    (tmp_path / "a.csv").write_text("DN,left,right\n10,1,0\n11,2,0\n12,0,5\n")
    found = read(tmp_path, "a.csv")
    assert found.names == ("a:left", "a:right")
    assert found.origin.tolist() == [[10, 12]]
    assert found.counts[0].tolist() == [[1, 2], [5, 0]]
    assert found.notes == ()


def test_numpy_files(tmp_path):
    np.save(tmp_path / "columns.npy", np.stack([DN, COUNTS], axis=1))
    np.save(tmp_path / "line.npy", np.array(WANTED, np.uint64))
    np.save(tmp_path / "channels.npy", np.array([WANTED, [0, 0, 0, 0, 9]]))
    np.savez(tmp_path / "one.npz", dn=DN, counts=COUNTS)
    np.savez(tmp_path / "two.npz", dn=DN, counts=np.stack([COUNTS, COUNTS[::-1]]))
    for name, counts, origin in (
        ("columns.npy", [WANTED], [100]),
        ("line.npy", [WANTED], [0]),
        ("one.npz", [WANTED], [100]),
        ("channels.npy", [WANTED, [9, 0, 0, 0, 0]], [0, 4]),
        ("two.npz", [WANTED, [2, 7, 0, 0, 3]], [100, 100]),
    ):
        found = read(tmp_path, name)
        assert (found.counts[0].tolist(), found.origin.tolist()) == (counts, [origin])
    assert found.names == ("two:0", "two:1")


def test_several_files_and_large_counts(tmp_path):
    (tmp_path / "c2.csv").write_text("0,1\n1,2\n")
    (tmp_path / "c10.csv").write_text(f"-5,{2**40}\n-4,1\n-3,1\n")
    found = read(tmp_path, "c*.csv")
    assert found.names == ("c2", "c10")
    assert found.counts.dtype == np.uint64
    assert found.counts[0].tolist() == [[1, 2, 0], [2**40, 1, 1]]
    assert found.origin.tolist() == [[0, -5]]
    assert [file["name"] for file in content_identity(found.paths)["files"]] == ["c2.csv", "c10.csv"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1,2\n2,-3\n", r"negative counts \(first at DN 2\)"),
        ("1,2\n2,2.5\n", "count 2.5 is not a whole number"),
        ("1.5,2\n", "DN 1.5 is not a whole number"),
        ("1,2\n2,nan\n", "count column has NaN"),
        ("inf,2\n", "DN column has NaN or infinity"),
        ("1,2\n1,3\n", "DN 1 occurs twice"),
        ("2,2\n1,3\n", r"not in increasing order \(at DN 1\); sort"),
        ("1,0\n2,0\n", "all counts are zero"),
        ("DN,count\n", "no bins"),
        ("", "no histogram"),
        ("1\n2\n", "needs two or more columns"),
        ("1,2\n2,x\n", r"row 2 \(2,x\) is not 2 numbers"),
        ("1,2\n2,3,4\n", "row 2"),
        ("0,1\n999999999,1\n", "more than any ADC"),
        ("1,1e300\n2,1\n", "too large to be exact"),
        ("DN,count\n1," + "9" * 131_073, "no table of numbers"),
        ("DN,count\n1,1_0\n2,5", r"row 2 \(1,1_0\) is not 2 numbers"),
        (f"DN{',c' * 1000}\n0{',1' * 1000}\n16000000{',1' * 1000}", "span more than 134217728 DN in total"),
    ],
)
def test_refusals(tmp_path, text, words):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        read(tmp_path, "a.csv")
    assert str(caught.value).startswith(str(tmp_path / "a.csv"))
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 4


@pytest.mark.parametrize(
    ("name", "arrays", "words"),
    [
        ("o.npy", np.array([{1: 2}], dtype=object), "pickles are never opened"),
        ("d.npy", np.zeros((2, 3, 4)), r"an array of shape \(2, 3, 4\)"),
        ("t.npy", np.array(["a", "b"]), "numbers are needed"),
        ("n.npz", {"dn": DN, "count": COUNTS}, "needs arrays dn and counts, has count, dn"),
        ("s.npz", {"dn": DN, "counts": COUNTS[:2]}, "do not match"),
        ("e.npy", b"", r"e\.npy: "),
        ("b.npz", b"PK\x03\x04\x14\0\0\0", r"b\.npz: "),
        ("x.csv", b"\xff\xfe\x00\x01", "not a text file"),
        ("x.dat", b"1,2", "give histograms as"),
    ],
)
def test_refusals_of_other_files(tmp_path, name, arrays, words):
    if isinstance(arrays, bytes):
        (tmp_path / name).write_bytes(arrays)
    elif isinstance(arrays, dict):
        np.savez(tmp_path / name, **arrays)
    else:
        np.save(tmp_path / name, arrays, allow_pickle=True)
    with pytest.raises(InputError, match=words):
        read(tmp_path, name)


def test_all_bad_files_in_one_message(tmp_path):
    for name, text in (("a", "1,2\n2,3\n"), ("b", "1,-2\n"), ("c", "")):
        (tmp_path / f"{name}.csv").write_text(text)
    with pytest.raises(InputError, match=r"b\.csv: negative.*c\.csv: no hist.*input\.on_bad_file: skip"):
        read(tmp_path, "*.csv")
    found = read(tmp_path, "*.csv", on_bad_file="skip")
    assert found.names == ("a",)
    assert found.notes[0].startswith("2 of 3 input files cannot be used: ")
    with pytest.raises(InputError, match="listed twice"):
        read(tmp_path, "a.csv", "a.csv")
    with pytest.raises(ConfigError, match="empty"):
        read(tmp_path)


def test_what_is_a_histogram_input(tmp_path):
    (tmp_path / "a.csv").write_text("1,2\n2,3\n")
    np.save(tmp_path / "a.npy", np.zeros((2, 3, 4), np.uint8))
    given = [("a.csv", "auto"), ("*.csv", "auto"), ("a.npy", "histogram")]
    other = [("a.csv", "raw"), ("a.npy", "auto"), (".", "auto")]
    for name, format in (*given, *other):
        found = is_histogram_input(InputSettings(files=(name,), format=format), tmp_path)
        assert found == ((name, format) in given)
    with pytest.raises(InputError, match="mixed"):
        is_histogram_input(InputSettings(files=("a.csv", "a.npy")), tmp_path)
