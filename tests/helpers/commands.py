"""Running ``pchem`` as a user does, and comparing what it leaves."""

import io
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from http.server import ThreadingHTTPServer
from pathlib import Path
from unittest.mock import patch

import numpy as np
from typer.testing import CliRunner

from pchem_pipeline.cli.app import app, main
from pchem_pipeline.commands.view import make_server
from pchem_pipeline.run.stage import open_store
from pchem_pipeline.store.run_store import RunStore

PCHEM = str(Path(sys.executable).with_name("pchem"))

RUN = """
run: {store: run.zarr, tile: 8}
input: {files: [frames/*.tif], integration_time: 4.87, bit_depth: 14}
"""


LISTING = """
import sys
from pchem_pipeline.cli import app
try:
    app.main(sys.argv[1:])
except SystemExit as end:
    assert end.code in (0, None), end.code
print(' '.join(sorted({name.partition('.')[0] for name in sys.modules})))
"""


def imported_by(*arguments) -> set[str]:
    """Run a command in a process of its own, which must succeed; return the libraries that it imported."""
    command = [sys.executable, "-c", LISTING, *map(str, arguments)]
    outcome = subprocess.run(command, capture_output=True, text=True, timeout=200)
    assert outcome.returncode == 0, outcome.stderr
    return set(outcome.stdout.splitlines()[-1].split())


def invoke(*arguments):
    """Run the command line in this process and folder; errors are raised as they are."""
    return CliRunner().invoke(app, [*map(str, arguments)], catch_exceptions=False)


@dataclass
class Result:
    """What a finished command left."""

    code: int
    stdout: str
    stderr: str

    @property
    def last(self) -> str:
        """Last line of stderr."""
        return self.stderr.strip().splitlines()[-1] if self.stderr.strip() else ""


@contextmanager
def sigint(handler) -> Iterator[None]:
    """Set what Ctrl-C does for a moment: a process inherits that it is ignored, whoever started the tests."""
    old = signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, old)


@dataclass
class Shell:
    """Runs ``pchem`` in a folder: in this process, or in one of its own where the environment is given."""

    folder: Path
    environment: dict[str, str] | None = None

    def alone(self, **variables: str) -> "Shell":
        """Return a shell of the folder whose commands are processes, with these variables."""
        return Shell(self.folder, {**os.environ, **variables})

    @contextmanager
    def start(self, *arguments) -> Iterator[subprocess.Popen[str]]:
        """Start the command as on a terminal; leave none behind."""
        with sigint(signal.default_int_handler):
            process = subprocess.Popen(
                [PCHEM, *map(str, arguments)],
                cwd=self.folder,
                env=self.environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
        with process:
            try:
                yield process
            finally:
                process.kill()

    def __call__(self, *arguments) -> Result:
        """Run the command to its end."""
        if self.environment is None:
            return self._here(list(map(str, arguments)))
        with self.start(*arguments) as process:
            stdout, stderr = process.communicate(timeout=300)
        return Result(process.returncode, stdout, stderr)

    def _here(self, arguments: list[str]) -> Result:
        """Run the command in this process: the same, but for the second that a process takes to start."""
        stdout, stderr, code = io.StringIO(), io.StringIO(), None
        with chdir(self.folder), redirect_stdout(stdout), redirect_stderr(stderr), patch.dict(os.environ):
            try:
                main(arguments)
            except SystemExit as end:
                code = end.code
        open_store.cache_clear()  # as a process of its own forgets them
        return Result(code or 0, stdout.getvalue(), stderr.getvalue())

    def refused(self, code: int, *arguments) -> str:
        """Run the command, which must end with this code; return what it says last, in one line."""
        result = self(*arguments)
        assert result.code == code, result.stderr
        assert "Traceback" not in result.stderr
        return result.last

    def states(self, run) -> dict[str, str]:
        """Return what ``pchem status`` says of each stage."""
        return dict(line.split(maxsplit=1) for line in self.ok("status", run).stdout.splitlines())

    def ok(self, *arguments) -> Result:
        """Run the command, which must succeed."""
        result = self(*arguments)
        assert result.code == 0, result.stderr
        return result


@contextmanager
def served(path) -> Iterator[tuple[ThreadingHTTPServer, str]]:
    """Serve the page of a run meanwhile: the server, and its address."""
    server, address = make_server(path)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield server, address
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def arrays_of(path, groups=("frames", "histogram", "summary", "fit", "maps", "ensemble")):
    """Return every array of a run by name."""
    store = RunStore.open(Path(path))
    found = {}
    for group in groups:
        for folder in sorted((Path(path) / group).iterdir()):
            if (folder / "zarr.json").exists():
                found[f"{group}/{folder.name}"] = store.read(f"{group}/{folder.name}")
    return found


def assert_equal_arrays(found, expected, *, rtol=0.0):
    """Arrays by name: integers must be equal, floats to ``rtol`` of the largest (0: to the bit)."""
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        if rtol and values.dtype.kind == "f":
            scale = np.nanmax(np.abs(values), initial=0.0)
            np.testing.assert_allclose(found[name], values, rtol=rtol, atol=rtol * scale, err_msg=name)
        else:
            np.testing.assert_array_equal(found[name], values, err_msg=name)


def assert_same_results(one, other, *, rtol=0.0, groups=("histogram", "summary", "fit", "maps", "ensemble")):
    """Compare the arrays of two runs."""
    found, expected = arrays_of(one, groups), arrays_of(other, groups)
    assert len(found) > 5
    assert_equal_arrays(found, expected, rtol=rtol)
