"""Every command in README is run, in order, in a folder with frames/."""

import os
import re
import subprocess
import sys
from pathlib import Path

from helpers.places import ROOT

from pchem_pipeline.stages.table import pipeline

README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", README, re.S)


# the search and the study take a minute each with what run.yaml has by default
QUICKER = r"sed -i -E 's/^( +replicates):.*/\1: 24/; s/^( +study_pixels):.*/\1: 20/' run.yaml"


def test_the_commands_in_readme_work(shell, frames):
    first, *others = blocks("bash")
    script = "\n".join(["set -e", first, QUICKER, *others])
    assert script.count("pchem ") >= 10
    environment = {**shell.environment, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    result = subprocess.run(
        ["bash", "-c", script], cwd=shell.folder, env=environment, capture_output=True, text=True, timeout=500
    )
    assert result.returncode == 0, result.stderr
    assert (shell.folder / "run.zarr" / "report.html").exists()
    shown = re.search(r"<!-- output of: (pchem status .*?) -->\n```\n(.*?)```", README, re.S)
    assert shown is not None
    assert shell.ok(*shown[1].split()[1:]).stdout == shown[2]


def test_the_two_commands_are_there_and_the_demo_runs(shell):
    [block] = blocks("sh")
    for line in block.splitlines():
        script = ROOT / line.split()[0]
        assert os.access(script, os.X_OK)
    environment = {
        **shell.environment,
        "PCHEM_NO_INSTALL": "1",
        "PCHEM_VENV": str(Path(sys.executable).parents[1]),
    }
    command = [str(ROOT / "scripts" / "demo"), "out", "--size", "16", "--frames", "1500"]
    result = subprocess.run(
        command, cwd=shell.folder, env=environment, capture_output=True, text=True, timeout=500
    )
    assert result.returncode == 0, result.stderr
    for name in ("quanta_exposure", "conversion_gain", "bias", "read_noise_e"):
        assert name in result.stdout
    assert f"report: {shell.folder}/out/demo.zarr/report.html" in result.stdout


def test_ci_runs_the_test_command_of_readme():
    assert "./scripts/test" in blocks("sh")[0]
    assert (ROOT / ".ci" / "run").read_text().strip().endswith("exec ./scripts/test")


def test_readme_names_every_stage_and_exit_code():
    for stage in pipeline():
        assert stage in README
    for code in ("0 ", "1 ", "2 ", "3 ", "4 ", "75 ", "130", "143"):
        assert code in README


def test_readme_names_the_shipped_configs():
    for path in (ROOT / "configs").iterdir():
        assert f"`{path.name}`" in README


def test_the_shipped_demo_config_runs(shell):
    (shell.folder / "demo.yaml").write_text((ROOT / "configs" / "demo.yaml").read_text())
    shell.ok("run", "demo.yaml", "--quiet")
    assert (shell.folder / "demo.zarr" / "report.html").exists()


def test_help_imports_nothing_heavy():
    code = (
        "import sys; sys.argv=['pchem','--help']\n"
        "from pchem_pipeline.cli.app import main\n"
        "try: main()\nexcept SystemExit: pass\n"
        "heavy={'numpy','zarr','dask','numba','pydantic','scipy','matplotlib'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
