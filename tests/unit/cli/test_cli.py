"""The command line translates and calls once; what it calls is tested elsewhere."""

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from helpers.commands import invoke
from typer.main import get_command

from pchem_pipeline import __version__
from pchem_pipeline.base.errors import ConfigError, ExitCode, InputError, StoreError
from pchem_pipeline.cli import app
from pchem_pipeline.commands import first_screen, new_run
from pchem_pipeline.commands.figures import figures_of_run
from pchem_pipeline.commands.new_run import find_or_start
from pchem_pipeline.config.load import load_config, parse_config
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.run import target as run_target
from pchem_pipeline.run.progress import Reporter
from pchem_pipeline.run.stage import Command
from pchem_pipeline.run.target import Target
from pchem_pipeline.runner import session

CONFIG = "input: {files: [a.tif]}\n"


@pytest.fixture
def calls(monkeypatch):
    seen = []
    target = Target(parse_config(CONFIG), Path("/x"), Path("/x/run.zarr"))
    monkeypatch.setattr(run_target, "find_run", lambda path: target)
    monkeypatch.setattr(new_run, "find_run", lambda path: target)
    for home in (session, first_screen):
        monkeypatch.setattr(home, "run_stages", lambda *args: seen.append(args))
    return seen


@pytest.mark.parametrize("name", ["simulate", "histogram", "fit", "maps", "ensemble", "report", "electrons"])
def test_a_stage_command_runs_its_stage(calls, name):
    options = ["--force", "--roi", "0:8,8:16", "--workers", "3", "--backend", "serial", "--progress", "off"]
    result = invoke(name, "run.zarr", *options, "--quiet", "--log-json", "l.json", "--max-memory", "900")
    assert result.exit_code == 0
    [(target, stages, command)] = calls
    assert stages == [name]
    assert target.config == parse_config(CONFIG)
    common = Command(True, False, (0, 8, 8, 16), None, 3, "serial", "off", True, Path("l.json"), 900)
    assert command == common


def test_ingest_crops_the_input_to_the_region_and_run_does_every_stage(calls):
    invoke("ingest", "c.yaml", "--roi", "0:8,8:16")
    [(target, _, command)] = calls
    assert (target.config.input.roi, command.roi) == ((0, 8, 8, 16), None)
    result = invoke("run", "c.yaml")
    _, stages, _ = calls[1]
    assert stages == ("ingest", "histogram", "fit", "maps", "ensemble", "report")
    assert result.stdout == "/x/run.zarr\n"  # there is no report in this folder


def test_what_a_run_cannot_begin_with_is_named(tmp_path):
    with pytest.raises(ConfigError, match="--integration-time: only with camera files"):
        find_or_start([tmp_path / "c.yaml"], None, {"integration_time": 1})
    with pytest.raises(InputError, match="does not exist"):
        find_or_start([tmp_path / "none.tif"], None, {})


def test_a_wrong_or_empty_roi_shows_how():
    empty = ("4:2,0:5", "0:4,5:5", "-1:4,0:5")
    for text in ("1,2", "a:b,c:d", "0:1", "0:1,2:3,4:5", *empty):
        words = r"^--roi .* contains no pixel; write y0:y1,x0:x1" if text in empty else "y0:y1,x0:x1"
        with pytest.raises(ConfigError, match=words):
            invoke("fit", "run.zarr", "--roi", text)


def test_init_writes_a_valid_file_once_whose_first_line_names_its_schema(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert invoke("init", "d.yaml", "--simulated").stdout == "d.yaml\n"
    assert load_config(tmp_path / "d.yaml").simulate is not None
    said = invoke("init", "c.yaml", "x.fits", "--schema").stdout
    assert said.splitlines() == ["c.yaml", "pchem.schema.json"]
    assert (tmp_path / "c.yaml").read_text().startswith("# yaml-language-server: $schema=pchem.schema.json\n")
    schema = json.loads((tmp_path / "pchem.schema.json").read_text())
    assert set(schema["properties"]) == set(RunConfig.model_fields)
    fit = schema["$defs"]["FitSettings"]
    assert fit["additionalProperties"] is False  # an editor marks a misspelt key
    assert all("description" in each for each in fit["properties"].values())
    assert load_config(tmp_path / "c.yaml").input.files == ("x.fits",)
    with pytest.raises(ConfigError, match=r"c\.yaml exists"):
        invoke("init", "c.yaml")
    invoke("init", "c.yaml", "--simulated", "--force")
    assert load_config(tmp_path / "c.yaml").simulate is not None


def test_init_finds_from_the_folder_of_its_file_what_was_given_from_another_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "notes").mkdir()
    given = ("night/*.fits", str(tmp_path / "x.fits"), "https://lab.org/y.fits")
    invoke("init", "notes/c.yaml", *given)
    assert load_config(tmp_path / "notes" / "c.yaml").input.files == ("../night/*.fits", *given[1:])


def pchem(*arguments, **options):
    """Run the package in a process of its own."""
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options}
    return subprocess.run([sys.executable, "-m", "pchem_pipeline", *arguments], text=True, **options)


def test_help_has_a_short_name_and_the_package_is_the_command():
    assert invoke("-h").stdout == invoke("--help").stdout
    assert "y0:y1,x0:x1" in invoke("fit", "-h").stdout
    assert pchem("--version").stdout == f"pchem {__version__}\n"


def test_help_groups_commands_and_options_and_cuts_no_first_line():
    text = invoke("--help").stdout
    for name, command in get_command(app.app).commands.items():
        assert f"\n  {name:11}  {command.help.splitlines()[0]}\n" in text
    headings = [line for line in text.splitlines() if line.endswith(":") and not line.startswith(" ")]
    assert headings == [
        "Options:", "Run:", "Look at results:", "Use results:", "Plan:", "Stages of a run:"
    ]  # fmt: skip
    own, common = invoke("run", "--help").stdout.split("Common options:")
    assert "--until" in own
    assert "--bit-depth" in own.partition("Camera files:")[2]
    assert "--workers" in common


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (InputError("a.tif is truncated;\n copy it again"), 4, "a.tif is truncated; copy it again\n"),
        (MemoryError(), 1, ""),
        (KeyboardInterrupt(), 130, ""),
    ],
)
def test_errors_are_one_line_with_their_exit_code(monkeypatch, capsys, error, code, words):
    monkeypatch.setattr(app, "app", Mock(side_effect=error))
    with pytest.raises(SystemExit) as caught:
        app.main([])
    assert caught.value.code == code
    assert capsys.readouterr().err.startswith(f"pchem: {words}")


def test_a_library_that_cannot_be_imported_is_one_line(tmp_path):
    (tmp_path / "zarr.yaml").write_text("a: [b")
    npy = tmp_path / "a.npy"
    np.save(npy, np.zeros((2, 3, 4), np.uint16))
    environment = {**os.environ, "ZARR_CONFIG": str(tmp_path), "PYTHONPATH": os.pathsep.join(sys.path)}
    found = pchem("run", npy, "--store", tmp_path / "a.zarr", env=environment)
    assert (found.returncode, len(found.stderr.splitlines())) == (2, 1)
    assert f"zarr cannot be imported (A config file at '{tmp_path}/zarr.yaml' is malformed" in found.stderr


@pytest.mark.parametrize(
    ("line", "code", "words"),
    [
        (
            "NUMBA_NUM_THREADS=many {pchem} info",
            2,
            r"'NUMBA_NUM_THREADS' .* 'many' could not be parsed\.\); ",
        ),
        ("ulimit -v 400000; {pchem} info", 2, r"^pchem: ulimit -v 400000: \d+ or more are needed; raise it$"),
        ("PYTHONUTF8=0 LC_ALL=C {pchem} info nähe.npy | head -1", 0, "/nähe.npy: npy, 2 frames of 3 x 4, "),
    ],
)
def test_odd_surroundings_are_one_line_or_do_not_matter(tmp_path, line, code, words):
    np.save(tmp_path / "nähe.npy", np.arange(24, dtype=np.uint16).reshape(2, 3, 4))
    pchem = f"{shlex.quote(sys.executable)} -m pchem_pipeline"
    paths = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = ["bash", "-c", line.format(pchem=pchem)]
    found = subprocess.run(command, cwd=tmp_path, env=paths, capture_output=True, encoding="utf-8")
    (said,) = (found.stdout + found.stderr).splitlines()
    assert (found.returncode, bool(re.search(words, said))) == (code, True), said


def test_figures_are_drawn_into_files_whatever_matplotlib_is_told(monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "rubbish")
    with pytest.raises(SystemExit):
        app.main(["--version"])
    assert os.environ["MPLBACKEND"] == "Agg"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux has it")
def test_a_full_disk_behind_stdout_is_one_line():
    with Path("/dev/full").open("w") as full:
        found = pchem("--version", stdout=full)
    assert found.returncode == ExitCode.INPUT
    assert found.stderr == "pchem: cannot write to stdout (No space left on device); check where it goes\n"


@pytest.mark.parametrize(
    "arguments",
    [
        ("init", "s3://lab/run.yaml"),
        ("export", "run.zarr", "--output", "s3://lab/x"),
        ("figures", "run.zarr", "--output", "s3://lab/x"),
        ("compare", "a.zarr", "b.zarr", "--output", "s3://lab/x"),
        ("demo", "--output", "s3://lab/x"),
        ("twin", "run.zarr", "--output", "s3://lab/twin.yaml"),
        ("plan", "--read-noise", "0.3", "--json", "s3://lab/plan.json"),
        ("run", "run.yaml", "--log-json", "s3://lab/log.jsonl"),
    ],
)
def test_what_is_written_beside_a_store_lies_on_this_machine(arguments, tmp_path, monkeypatch):
    """As a path of this machine a URL would be a folder called s3:."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r"^s3://lab/.*: only stores can be in an object storage; give a"):
        invoke(*arguments)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ConfigError, match=r"^s3://lab/frames: only stores"):
        parse_config("simulate: {output: 's3://lab/frames'}")


@pytest.mark.parametrize(
    ("home", "name", "arguments"),
    [
        ("compare.compare", "compare_runs", ("compare", "a.zarr", "b.zarr")),
        ("demo", "run_demo", ("demo",)),
        ("export", "export_run", ("export", "run.zarr")),
        ("figures", "figures_of_run", ("figures", "run.zarr")),
        ("apply.apply", "apply_to_frames", ("apply", "run.zarr", "a.tif")),
    ],
)
def test_commands_of_a_run_are_quiet_if_asked_and_know_where_to_write(
    calls, home, name, arguments, monkeypatch
):
    called = Mock(return_value="")
    monkeypatch.setattr(f"pchem_pipeline.commands.{home}.{name}", called)
    assert invoke(*arguments, "--quiet").exit_code == 0
    given = called.call_args.args
    assert any(getattr(each, "quiet", getattr(each, "_quiet", False)) for each in given)
    assert any(
        path in given for path in map(Path, ("compare", "pchem-demo", "export", "figures", "calibrated.zarr"))
    )


def test_frames_without_their_run_are_told_what_is_needed(tmp_path):
    (tmp_path / "1.fits").touch()
    with pytest.raises(ConfigError, match=r"1.fits is no run; .*: pchem apply run.zarr FRAMES"):
        invoke("apply", tmp_path / "1.fits", tmp_path / "2.fits")


def test_what_cannot_be_drawn_is_refused_before_anything_is_read():
    for wanted, words in (
        ({"formats": ("pdf", "jpg")}, "--format: jpg cannot be drawn; choose from pdf, svg, png"),
        ({"formats": ()}, "--format: no format"),
        ({"width": "88 px"}, "--width '88 px': write a length such as 88mm"),
    ):
        with pytest.raises(ConfigError, match=words):
            figures_of_run(Path("nowhere.zarr"), Path("out"), Reporter("off"), **wanted)


@pytest.mark.parametrize("option", ["--only", "--format"])
def test_a_list_of_nothing_does_not_mean_all_and_a_folder_without_a_run_is_told(tmp_path, option):
    with pytest.raises(ConfigError, match=f"{option}: ' ,' is no name"):
        invoke("figures", "run.zarr", option, " ,")
    with pytest.raises(StoreError, match="there is no run at"):
        figures_of_run(tmp_path, tmp_path / "out", Reporter("off"))
