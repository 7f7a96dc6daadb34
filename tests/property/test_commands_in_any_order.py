"""Commands, kills and changes of the YAML in any order: the end is that of a run from scratch."""

import shutil
import subprocess
import tempfile
from pathlib import Path

from helpers.commands import Shell, assert_same_results
from hypothesis import HealthCheck, Phase, settings
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule
from hypothesis.strategies import floats, sampled_from

CAMERA = """
run: {store: truth.zarr, tile: 8}
simulate:
  {shape: [10, 12], n_frames: 900, seed: 5, output: frames, frames_per_file: 300, integration_time: 1.0}
"""
RUN = """
run: {{store: {store}, tile: {tile}}}
input: {{files: [frames/*.tif], integration_time: {seconds}}}
histogram: {{block_frames: 32}}  # appended frames go into blocks as long as the first
fit: {{gap_threshold: {gap}}}
model: {{effects: [{effects}]}}
"""
STAGES = ("ingest", "histogram", "fit", "maps", "ensemble")
CHANGES = (
    ("seconds", 2.0),
    ("gap", 6.0),
    ("effects", "{tag: nonlinearity, step_change: 0.004}"),
    ("effects", ""),
)


class Commands(RuleBasedStateMachine):
    """A folder with the first of three files of frames, and the settings of its run."""

    @initialize()
    def begin(self):
        self.folder = Path(tempfile.mkdtemp())
        self.shell = Shell(self.folder)
        (self.folder / "camera.yaml").write_text(CAMERA)
        self.shell.ok("simulate", "camera.yaml", "--quiet")
        self.later = self.folder / "later"
        self.later.mkdir()
        for file in sorted((self.folder / "frames").iterdir())[1:]:
            file.rename(self.later / file.name)
        self.settings = {"tile": 8, "seconds": 1.0, "gap": 5.0, "effects": ""}
        self.write("run.zarr")

    def write(self, store):
        (self.folder / "run.yaml").write_text(RUN.format(store=store, **self.settings))

    @rule(stage=sampled_from(STAGES))
    def run(self, stage):
        self.shell.ok("run", "run.yaml", "--until", stage, "--quiet")

    @rule(seconds=floats(0.6, 3.0))
    def kill(self, seconds):
        with self.shell.start("run", "run.yaml", "--until", "ensemble", "--quiet") as process:
            try:
                process.wait(timeout=seconds)
            except subprocess.TimeoutExpired:
                process.kill()

    @rule(change=sampled_from(CHANGES))
    def change(self, change):
        self.settings |= [change]
        self.write("run.zarr")

    @precondition(lambda self: any(self.later.iterdir()))
    @rule()
    def append(self):
        self.shell.ok("run", "run.yaml", "--until", "histogram", "--quiet")
        file = min(self.later.iterdir())
        file.rename(self.folder / "frames" / file.name)
        self.shell.ok("ingest", "run.yaml", "--append", "--quiet")

    @rule(what=sampled_from(["status", "model"]))
    def look(self, what):
        if (self.folder / "run.zarr").exists():
            self.shell.ok(what, "run.yaml")

    @rule(stage=sampled_from(STAGES[1:]))
    def again(self, stage):
        self.shell.ok("run", "run.yaml", "--until", "ensemble", "--quiet")
        self.shell.ok(stage, "run.yaml", "--force", "--quiet")

    def teardown(self):
        self.shell.ok("run", "run.yaml", "--until", "ensemble", "--quiet")
        self.write("scratch.zarr")
        self.shell.ok("run", "run.yaml", "--until", "ensemble", "--quiet")
        assert_same_results(self.folder / "run.zarr", self.folder / "scratch.zarr")
        shutil.rmtree(self.folder)


Commands.TestCase.settings = settings(
    max_examples=3,
    stateful_step_count=6,
    deadline=None,
    phases=[Phase.generate],  # an example takes half a minute: it is not made smaller
    suppress_health_check=list(HealthCheck),
)
TestCommands = Commands.TestCase
