"""Real data: spectra of a silicon photomultiplier, on which the plain PCD must fail and has to say so."""

import json
from pathlib import Path

import numpy as np

from pchem_pipeline.model.fit_status import FitStatus
from pchem_pipeline.store.run_store import RunStore

SPECTRA = sorted((Path(__file__).parents[1] / "data" / "sipm").glob("*.csv"))


def test_ready_made_histograms_go_through_every_stage(shell):
    assert len(SPECTRA) == 6
    result = shell.ok("run", *SPECTRA, "--store", "sipm.zarr")
    assert "every channel counting the same" in result.stderr
    store = RunStore.open(shell.folder / "sipm.zarr")
    counts = store.read("histogram/counts")
    expected = [np.loadtxt(path, delimiter=",", skiprows=1)[:, 1].sum() for path in SPECTRA]
    assert sorted(counts.sum(axis=(0, 2))) == sorted(expected)
    # the peaks lie about 28 channels apart and are well resolved
    spacing = 1 / store.read("fit/conversion_gain")
    assert ((spacing > 26) & (spacing < 30)).all()
    assert (store.read("maps/read_noise_e") < 0.25).all()
    # the model misses the cut 0-photoelectron peak, the crosstalk and the widening of the peaks
    words = store.read("fit/fit_status")
    assert (words & int(FitStatus.POOR_FIT) != 0).all()
    assert (store.read("fit/goodness_chi2") > 1000 * store.read("fit/goodness_dof")).all()
    assert "order in time" in store.attributes("summary")["missing"]
    report = json.loads((store.path / "report.json").read_text())
    assert report["ensemble"]["rmse"]["epcd_exact"] > 100 * report["ensemble"]["rmse"]["noise_floor"]
    html = (store.path / "report.html").read_text()
    assert "does not describe" in html
    assert "M11_LED_dark" in html


def test_electron_numbers_need_frames(shell):
    shell.ok("run", SPECTRA[0], "--store", "sipm.zarr", "--quiet")
    result = shell("electrons", "sipm.zarr")
    assert result.code in (2, 4)
    assert "histograms" in result.last
