"""Every command in README and in the documentation is run, in order, in a folder with frames/."""

import os
import re
import subprocess
import sys
from contextlib import chdir
from pathlib import Path

import pytest
from helpers.places import ROOT

from pchem_pipeline.base.errors import ExitCode
from pchem_pipeline.stages.table import pipeline

README = (ROOT / "README.md").read_text(encoding="utf-8")
DOCS = "\n".join(
    (ROOT / "docs" / name).read_text(encoding="utf-8")
    for name in (
        "measure_a_sensor.md",
        "first_run.md",
        "howto/missing_effects.md",
        "howto/methods_and_plans.md",
        "howto/cron.md",
        "howto/use_the_sensor.md",
    )
)


def blocks(language, text=README):
    return re.findall(rf"```{language}\n(.*?)```", text, re.S)


# what takes a minute each by default is made smaller behind these commands
SMALLER = {
    "pchem init simulated.yaml --simulated": {r"^( +shape): .64, 64.": r"\1: [16, 24]"},
    blocks("bash")[0].strip(): {
        r"^( +replicates):.*": r"\1: 20",
        r"^( +study_pixels):.*": r"\1: 10",
        r"^( +study_read_noise:)\n( +- .*\n)+": r"\1 [0.3, 0.6]\n",
        r"^( +em_iterations):.*": r"\1: 100",
    },
}


def run_line(shell, line):
    """Run a command of pchem in this process; bash tells its words."""
    command = ["bash", "-c", f'pchem() {{ printf "%s\\0" "$@"; }}; {line}']
    said = subprocess.run(command, cwd=shell.folder, capture_output=True, text=True, check=True).stdout
    until = ["--until", "ensemble"] if line == "pchem run simulated.yaml" else []
    shell.ok(*said.split("\0")[:-1], *until)
    for old, new in SMALLER.get(line, {}).items():
        path = shell.folder / ("simulated.yaml" if "simulated" in line else "run.yaml")
        text, found = re.subn(old, new, path.read_text(), flags=re.M)
        assert found, old
        path.write_text(text)


@pytest.mark.usefixtures("undrawn")
def test_the_commands_in_readme_work(shell, frames):
    for path in sorted(frames.iterdir())[2:]:
        path.unlink()
    found = list(dict.fromkeys(blocks("bash") + blocks("bash", DOCS)))
    assert "".join(found).count("pchem ") >= 10
    for block in found:
        lines, *script = re.split("^(?=cat >)", block, flags=re.M)
        for line in lines.splitlines():
            run_line(shell, line)
        for each in script:  # which needs the installed command
            environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
            subprocess.run(["bash", "-ec", each], cwd=shell.folder, env=environment, check=True, timeout=300)
    assert (shell.folder / "run.zarr" / "report.html").exists()
    with chdir(shell.folder):
        exec(blocks("python")[0], {})
    shown = re.search(r"<!-- output of: (pchem status .*?) -->\n```\n(.*?)```", DOCS, re.S)
    assert shell.ok(*shown[1].split()[1:]).stdout == shown[2]


def test_the_two_commands_are_there_and_the_demo_runs(shell):
    [block] = blocks("sh")
    for line in block.splitlines():
        script = ROOT / line.split()[0]
        assert os.access(script, os.X_OK)
    environment = {**os.environ, "PCHEM_NO_INSTALL": "1", "PCHEM_VENV": str(Path(sys.executable).parents[1])}
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


def test_readme_is_short_and_its_links_lead_somewhere():
    assert len(README.splitlines()) <= 80
    links = re.findall(r"\]\(([^)]+)\)", README)
    assert len(links) >= 10
    for link in links:
        assert (ROOT / link).exists(), link


def test_the_documentation_names_every_stage_exit_code_and_shipped_config():
    for stage in pipeline():
        assert stage in README
    for code in ExitCode:
        assert re.search(rf"^\|[ \d,]*\b{code.value}\b", DOCS, re.M), code
    for path in (ROOT / "configs").iterdir():
        assert f"`{path.name}`" in DOCS


def test_the_shipped_demo_config_runs(shell):
    (shell.folder / "demo.yaml").write_text((ROOT / "configs" / "demo.yaml").read_text())
    shell.ok("run", "demo.yaml", "--until", "ensemble", "--quiet")
    assert shell.ok("status", "demo.zarr").stdout.splitlines()[-2].split()[:2] == ["ensemble", "complete"]
