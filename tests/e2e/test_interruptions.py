"""Kill, stop, lock: nothing is lost and the resumed result is the uninterrupted one."""

import signal
import time

import pytest
from helpers.commands import RUN, assert_same_results

UNTIL = ("--until", "ensemble")  # a report is drawn once, in a test of its own


@pytest.fixture
def run(shell, frames):
    (shell.folder / "run.yaml").write_text(RUN)
    return shell


def wait_for_stage(run, process, stage):
    """Wait until a stage is begun."""
    stages = run.folder / "run.zarr" / ".pchem" / "stages"
    deadline = time.monotonic() + 120
    while not (stages / f"{stage}.json").exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)


def test_stopped_and_killed_again_and_again_it_ends_with_the_same_bits(run, finished):
    """scripts/validation/kills.py has hundreds of moments."""
    for stage, number, code in (
        ("histogram", signal.SIGINT, 130),
        ("fit", signal.SIGTERM, 143),
        ("ensemble", signal.SIGKILL, -signal.SIGKILL),
    ):
        # on a busy machine a run may have come so far before it was killed: what is waited for is this one's
        (run.folder / "run.zarr" / ".pchem" / "stages" / f"{stage}.json").unlink(missing_ok=True)
        with run.start("run", "run.yaml", *UNTIL, "--workers", "2") as process:
            wait_for_stage(run, process, stage)
            process.send_signal(number)
            _, stderr = process.communicate(timeout=120)
        assert process.returncode == code
        said = f"pchem: stopped by {signal.Signals(number).name}"
        assert code < 0 or stderr.strip().splitlines()[-1].startswith(said)
    run.ok("run", "run.yaml", *UNTIL)
    assert_same_results(finished, run.folder / "run.zarr")
