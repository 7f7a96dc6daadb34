"""Real data: spectra of a silicon photomultiplier, on which the plain PCD must fail and has to say so."""

import json

import numpy as np
import pytest
from helpers.commands import Shell
from helpers.places import SIPM
from helpers.without_pictures import undrawn

from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.store.run_store import RunStore

SPECTRA = sorted(SIPM.glob("*.csv"))

YAML = """
run: {store: sipm.zarr}
discrepancy: {replicates: 24}
input:
  files:
"""


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """The spectra, run through every stage."""
    shell = Shell(tmp_path_factory.mktemp("measured"))
    (shell.folder / "sipm.yaml").write_text(YAML + "".join(f"    - {path}\n" for path in SPECTRA))
    with undrawn():
        yield shell, shell.ok("run", "sipm.yaml")


def test_ready_made_histograms_go_through_every_stage(measured):
    assert len(SPECTRA) == 6
    shell, result = measured
    assert "with equal weight per channel" in result.stderr
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


def test_the_search_names_what_physics_says_and_describes_the_rest(measured):
    shell, _ = measured
    store = RunStore.open(shell.folder / "sipm.zarr")
    before = store.read("fit/read_noise_dn")
    result = shell.ok("discrepancy", "sipm.yaml")
    found = json.loads((shell.folder / "sipm.zarr" / "discrepancy.json").read_text())
    # the library explains a part of what such a detector does, and the verdict says so
    assert found["verdict"] == "named_in_part"
    assert found["gap"]["after"] > found["gap"]["floor"]
    assert found["effects"] == ["branching_counts", "signal_dependent_noise"]
    branching, widening = (step["parameters"] for step in found["steps"])
    # seen by eye: every photoelectron is followed by a further one in about a fifth of the cases
    assert 0.1 < branching["branching"]["value"] < 0.3
    assert widening["noise_e"]["value"] > 2 * widening["noise_e"]["stderr"] > 0
    # the near twin of the first is told apart, and closes less
    first = found["steps"][0]
    twin = next(rival for rival in first["rivals"] if rival["effect"] == "overdispersed_counts")
    assert twin["gap_after"] > first["gap_after"]
    assert "worse" in twin["why"]
    gap = found["gap"]
    assert gap["after"] < 0.7 * gap["before"]
    assert gap["interval_after"][1] < gap["interval_before"][0]
    # the library holds neither the trigger that cuts the 0-electron peak nor afterpulses in the valleys
    left = [place["sentence"] for place in found["unexplained"]]
    assert left[0].startswith("fewer samples than expected at the 0-electron peak")
    assert any("more samples than expected between the 1- and the 2-electron peak" in s for s in left)
    assert {"row_noise", "interpixel_capacitance", "bias_drift"} <= set(found["untestable"])
    assert "unexplained:" in result.stdout
    # the picture shows both: the tail, which the plain model lacks, is there with branching
    arrays = {n: store.read(f"discrepancy/code_{n}") for n in ("dn", "observed", "expected", "extended")}
    far = arrays["dn"] >= 300
    observed, plain, extended = (arrays[n][far].sum() for n in ("observed", "expected", "extended"))
    assert plain < observed / 10
    assert observed / 2 < extended < 2 * observed
    # the fit that follows has the effects: one sigma no longer stands for peaks that widen
    shell.ok("fit", "sipm.yaml")
    after = store.read("fit/read_noise_dn")
    assert (after < 0.9 * before).all()
