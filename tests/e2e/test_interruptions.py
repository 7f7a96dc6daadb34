"""Kill, stop, lock: nothing is lost and the resumed result is the uninterrupted one."""

import random
import signal
import subprocess
import time

import pytest
from helpers.commands import RUN, assert_same_results

UNTIL = ("--until", "ensemble")  # a report is drawn once, in a test of its own


@pytest.fixture
def run(shell, frames):
    (shell.folder / "run.yaml").write_text(RUN)
    return shell


def wait_for_stage(run, process):
    """Wait until the histograms are begun."""
    stages = run.folder / "run.zarr" / ".pchem" / "stages"
    deadline = time.monotonic() + 120
    while not (stages / "histogram.json").exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)


def test_killed_again_and_again_it_ends_with_the_same_bits(run, finished):
    rng = random.Random(4)
    killed = 0
    for _ in range(5):  # scripts/validation/kills.py has hundreds
        with run.start("run", "run.yaml", *UNTIL, "--quiet", "--workers", "2") as process:
            try:
                process.wait(timeout=rng.uniform(1.5, 5))
            except subprocess.TimeoutExpired:
                process.kill()
                killed += 1
                continue
        assert process.returncode == 0
        break
    run.ok("run", "run.yaml", *UNTIL)
    assert killed >= 1
    assert_same_results(finished, run.folder / "run.zarr")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_stops_with_its_code_and_the_run_goes_on_later(run, finished, number, code):
    with run.start("run", "run.yaml", *UNTIL) as process:
        wait_for_stage(run, process)
        process.send_signal(number)
        _, stderr = process.communicate(timeout=120)
    assert process.returncode == code
    assert stderr.strip().splitlines()[-1].startswith(f"pchem: stopped by {signal.Signals(number).name}")
    run.ok("run", "run.yaml", *UNTIL)
    assert_same_results(finished, run.folder / "run.zarr")
