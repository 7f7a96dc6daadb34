"""Defects of a sensor: planted ones are found, and table, regions and mask say the same of them."""

import csv
import json
import re

import numpy as np
import pytest
from astropy.io import fits
from helpers.commands import Shell
from helpers.small_sensors import drawn_truth, taken
from tifffile import imread

from pchem_pipeline import open_run
from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.model.maps.defects import Defect
from pchem_pipeline.store.run_store import RunStore

SHAPE = (40, 36)
# exposure and read noise of planted pixels, e-; more noise than 0.4 e- hides the gain from the fit
HOT, ORDINARY, STUCK = ("hot", (40.0, 0.25)), ("", (2.0, 0.25)), ("stuck", (0.0, 0.0))
PLANTED = [
    *[HOT] * 12,
    *[("dead", (0.0, 0.25))] * 12,
    *[("noisy", (2.0, 0.42)), ("noisy", (2.0, 2.5))] * 6,
    *[STUCK] * 12,
    *[("saturated", (3000.0, 0.25))] * 6,
]


def take(folder, name, seed, planted=PLANTED):
    """Write frames of a sensor with planted defects; return their kinds, (y, x), or empty."""
    truth = drawn_truth(SHAPE, exposure=(1.8, 2.2), noise_e=(0.24, 0.26), step=(10.8, 11.2))
    places = np.random.default_rng(8).permutation(truth.bias.size)
    kinds = np.full(truth.bias.size, "", "<U9")
    for place, (kind, pixel) in zip(places, planted, strict=False):
        kinds[place] = kind
        truth.quanta_exposure.flat[place], truth.analog_read_noise_e.flat[place] = pixel
        if kind == "stuck":
            truth.bias.flat[place] = 3000 + place
    np.save(folder / f"{name}.npy", taken(truth, n_frames=3000, seed=seed))
    return kinds.reshape(SHAPE)


@pytest.fixture(scope="module")
def sensor(tmp_path_factory):
    """A folder with a run of a sensor with defects in light, its export, and the planted kinds."""
    folder = tmp_path_factory.mktemp("defects")
    planted = take(folder, "light", 1)
    (folder / "run.yaml").write_text(
        "run: {store: run.zarr}\n"
        "input: {files: [light.npy], integration_time: 1, bit_depth: 14, kind: light}\n"
    )
    shell = Shell(folder)
    shell.ok("run", "run.yaml", "--until", "maps")
    written = shell.ok("export", "run.zarr", "--format", "defects,fits").stdout.split()
    assert written == [
        f"export/{name}" for name in ("defects.csv", "defects.reg", "defects.tif", "maps.fits")
    ]
    return folder, planted


def table(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_what_was_planted_is_found_and_nothing_else(sensor):
    folder, planted = sensor
    rows = table(folder / "export" / "defects.csv")
    found = {(int(row["y"]), int(row["x"])): row["kind"] for row in rows}
    assert len(found) == len(rows)
    expected = {place: str(kind) for place, kind in np.ndenumerate(planted) if kind}
    known = {place: kind for place, kind in found.items() if kind not in ("not_fitted", "flagged")}
    # six robust standard deviations are beyond the even distributions: no ordinary pixel is a fault
    assert known == expected
    assert list(rows[0]) == ["x", "y", "kind", "value", "stderr", "unit", "usual", "fit_status"]
    for row in rows:
        if row["kind"] == "hot":
            assert abs(float(row["value"]) - 40.0) < 5.0 * float(row["stderr"])
            assert row["unit"] == "e-"
            assert float(row["usual"]) == pytest.approx(2.0, rel=0.02)
        if row["kind"] == "stuck":
            assert float(row["value"]) == 3000 + int(row["y"]) * SHAPE[1] + int(row["x"])
    frame = open_run(folder / "run.zarr").defects()  # a notebook has the same table
    assert list(frame.columns) == list(rows[0])
    assert frame.kind.tolist() == [row["kind"] for row in rows]
    assert frame.value.iloc[0] == pytest.approx(float(rows[0]["value"]))


def test_regions_lie_on_the_pixels_of_the_maps(sensor):
    """In DS9 the centre of the first pixel of a FITS image is (1, 1), x along its first axis."""
    folder, planted = sensor
    head, system, *lines = (folder / "export" / "defects.reg").read_text().splitlines()
    assert (head, system) == ("# Region file format: DS9 version 4.1", "image")
    boxes = [re.fullmatch(r"box\((\d+),(\d+),1,1\) # text=\{([a-z_ ]+)\}", line).groups() for line in lines]
    assert len(boxes) == len(table(folder / "export" / "defects.csv"))
    with fits.open(folder / "export" / "maps.fits") as file:
        exposure = file["QUANTA_EXPOSURE"]
        assert (exposure.header["NAXIS1"], exposure.header["NAXIS2"]) == SHAPE[::-1]
        for x, y, kind in boxes:
            if kind == "hot":
                assert exposure.data[int(y) - 1, int(x) - 1] > 30.0
            assert kind in (planted[int(y) - 1, int(x) - 1], "not_fitted", "flagged")
    assert sum(kind == "hot" for *_, kind in boxes) == 12


def test_the_mask_excludes_faults_from_another_run(sensor):
    folder, planted = sensor
    mask = imread(folder / "export" / "defects.tif")
    for kind in {kind for kind, _ in PLANTED}:
        np.testing.assert_array_equal((mask & Defect[kind.upper()]) != 0, planted == kind)
    np.testing.assert_array_equal(mask != 0, planted != "")
    take(folder, "other", 2)
    shell = Shell(folder)
    shell.ok(
        "run", "other.npy", "--store", "other.zarr", "--integration-time", "1", "--bit-depth", "14",
        "--mask", "export/defects.tif", "--until", "maps",
    )  # fmt: skip
    excluded = RunStore.open(folder / "other.zarr").read("fit/fit_status") == int(FitStatus.EXCLUDED)
    np.testing.assert_array_equal(excluded, mask != 0)
    shell.ok("export", "other.zarr", "--format", "defects", "-o", "again")
    again = imread(folder / "again" / "defects.tif")
    np.testing.assert_array_equal(again != 0, mask != 0)
    assert set(again[again != 0]) == {int(Defect.EXCLUDED)}


def test_a_comparison_tells_what_is_new_gone_and_of_another_kind(sensor):
    folder, planted = sensor
    # the first hot pixel is stuck now, the last saturated one is ordinary, and another one is hot
    later = [STUCK, *PLANTED[1:-1], ORDINARY, HOT]
    shell = Shell(folder)
    run = (folder / "run.yaml").read_text()
    now = {}
    for name, seed, pixels in (("same", 3, PLANTED), ("later", 4, later)):
        now[name] = take(folder, name, seed, pixels)
        (folder / f"{name}.yaml").write_text(
            run.replace("run.zarr", f"{name}.zarr").replace("light.npy", f"{name}.npy")
        )
        shell.ok("run", f"{name}.yaml", "--until", "maps")
    shell.refused(3, "compare", "run.zarr", "same.zarr", "later.zarr")
    same, changed, _ = json.loads((folder / "compare" / "compare.json").read_text())["comparisons"]
    # the capture is another one, and no defect is new by chance
    assert same["defects"] == {"new": 0, "gone": 0, "of_another_kind": 0, "pixels": []}
    assert not any("Defects" in what for what in same["what"])
    expected = [
        {"y": int(y), "x": int(x), "before": str(planted[y, x]), "now": str(now["later"][y, x])}
        for y, x in np.argwhere(planted != now["later"])
    ]
    assert len(expected) == 3
    assert changed["defects"] == {"new": 1, "gone": 1, "of_another_kind": 1, "pixels": expected}
    assert "Defects: 1 new, 1 gone, 1 of another kind." in changed["what"]
    row = table(folder / "compare" / "history.csv")[2]
    counted = {"hot": "12", "stuck": "13", "saturated": "5", "dead": "12", "noisy": "12"}
    assert row.items() >= {f"{kind}_pixels": n for kind, n in counted.items()}.items()
    [place] = (f"{each['y']}/{each['x']}" for each in expected if not each["now"])
    assert row["defects_gone"] == place
    assert "Defects that changed" in (folder / "compare" / "compare.html").read_text(encoding="utf-8")
