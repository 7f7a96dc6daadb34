"""Camera files and stores on S3: a real server on loopback (moto, installed from PyPI by the extra dev)."""

import re
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from importlib.util import find_spec
from urllib.parse import quote

import numpy as np
import pytest
from helpers.commands import RUN, arrays_of, assert_same_results

pytestmark = pytest.mark.skipif(
    find_spec("moto") is None or find_spec("s3fs") is None, reason='pip install ".[dev]" brings moto and s3fs'
)


SECRET = "wJalrXUtnFEMI"


def ask(url, data=None, method="GET"):
    who = "Credential=key/20260101/us-east-1/s3/aws4_request, SignedHeaders=host, Signature=unchecked"
    headers = {"Content-Type": "application/octet-stream", "Authorization": f"AWS4-HMAC-SHA256 {who}"}
    request = urllib.request.Request(url, data, headers, method=method)
    with urllib.request.urlopen(request, timeout=20) as answer:
        assert answer.status in (200, 204)
        return answer.read()


def put(url, data=b""):
    ask(url, data or None, "PUT")


@pytest.fixture(scope="module")
def server():
    """The address of an S3 server with an empty bucket."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    address = f"http://127.0.0.1:{port}"
    deadline = time.monotonic() + 90
    while time.monotonic() < deadline:
        try:
            put(f"{address}/lab")
            break
        except (OSError, urllib.error.URLError):
            time.sleep(0.1)
    yield address
    process.kill()
    process.wait()


@pytest.fixture
def keys(server, tmp_path):
    """The environment of a shell whose S3 is that server."""
    return {
        "AWS_ENDPOINT_URL": server,
        "AWS_ACCESS_KEY_ID": "key",
        "AWS_SECRET_ACCESS_KEY": SECRET,
        "AWS_DEFAULT_REGION": "us-east-1",
        "XDG_CACHE_HOME": str(tmp_path / "cache"),
    }


@pytest.fixture
def cloud(shell, keys, monkeypatch):
    """A shell with that environment."""
    for name, value in keys.items():
        monkeypatch.setenv(name, value)
    return shell


def test_frames_are_read_from_s3_and_fetched_once(cloud, server, camera, finished, tmp_path):
    for path in sorted((camera / "frames").glob("*.tif")):
        put(f"{server}/lab/night/{path.name}", path.read_bytes())
    text = RUN.replace("frames/*.tif", '"s3://lab/night/*.tif"').replace(
        "bit_depth", "mode: reference, bit_depth"
    )
    (cloud.folder / "run.yaml").write_text(text)
    cloud.ok("run", "run.yaml", "--until", "histogram")
    assert_same_results(cloud.folder / "run.zarr", finished, rtol=1e-12, groups=("histogram", "summary"))
    fetched = sorted((tmp_path / "cache").rglob("*.tif"))
    before = [path.stat().st_mtime_ns for path in fetched]
    assert len(fetched) == 4
    assert cloud.states("run.yaml")["ingest"] == "complete"
    assert [path.stat().st_mtime_ns for path in fetched] == before
    # an object that changed is fetched again, and seen
    changed = bytearray(fetched[0].read_bytes())
    changed[-1] ^= 1
    put(f"{server}/lab/night/{fetched[0].name}", bytes(changed))
    assert cloud.states("run.yaml")["ingest"] == "stale - the input has changed"


@pytest.mark.parametrize("url", ["s3://lab/none/*.tif", "s3://elsewhere/a.tif"])
def test_what_is_not_there_is_one_line(cloud, url):
    (cloud.folder / "run.yaml").write_text(RUN.replace("frames/*.tif", f'"{url}"'))
    assert re.match("pchem: .*no such file", cloud.refused(4, "ingest", "run.yaml"))


STORED = (
    RUN.replace("run.zarr", "s3://lab/night/run.zarr")
    .replace("tile: 8", "tile: 32")
    .replace("bit_depth", "mode: reference, bit_depth")
)


@pytest.mark.parametrize(
    "text", [RUN.replace("frames/*.tif", '"s3://lab/a.tif"'), STORED], ids=["frames", "store"]
)
def test_a_server_that_does_not_answer_is_one_line(shell, keys, frames, text):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        keys |= {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{free.getsockname()[1]}", "AWS_MAX_ATTEMPTS": "1"}
    (shell.folder / "run.yaml").write_text(text)
    result = shell.alone(**keys)("ingest", "run.yaml")
    assert result.code == 4
    assert re.match("pchem: s3://lab/.*check address, keys and network", result.last)
    assert "Traceback" not in result.stderr
    assert SECRET not in result.stderr


def fetched(server, folder):
    """Return the folder with all that the bucket holds, fetched by plain HTTP."""
    last, more = "", True
    while more:
        page = ask(f"{server}/lab?list-type=2&prefix=night/run.zarr&start-after={quote(last)}").decode()
        keys = re.findall("<Key>(.*?)</Key>", page)
        for key in keys:
            (folder / key).parent.mkdir(parents=True, exist_ok=True)
            (folder / key).write_bytes(ask(f"{server}/lab/{key}"))
        last, more = (keys or [""])[-1], "<IsTruncated>true" in page
    return folder / "night" / "run.zarr"


def test_a_run_whose_store_is_on_s3(cloud, server, frames, finished, tmp_path):
    (cloud.folder / "run.yaml").write_text(STORED)
    cloud.ok("run", "run.yaml", "--until", "maps")
    store = fetched(server, tmp_path / "first")
    assert_same_results(store, finished, rtol=1e-12, groups=("histogram", "summary", "fit", "maps"))
    # it is locked for all machines
    lock = f"{server}/lab/night/run.zarr/.pchem/lock.json"
    put(lock, b'{"token": "x", "host": "far", "machine": "far 1", "pid": 7}')
    words = "s3://lab/night/run.zarr is in use by pchem on far (process 7, since "
    assert words in cloud.refused(75, "ingest", "run.yaml")
    put(lock, b"{")
    said = cloud.refused(75, "ingest", "run.yaml")
    assert "lock.json is damaged; if no pchem command uses this run: python -c" in said
    code = said.partition('python -c "')[2].rstrip('"')
    subprocess.run([sys.executable, "-c", code], check=True)
    cloud.ok("export", "s3://lab/night/run.zarr", "--format", "npz", "--output", "out")
    (written,) = (cloud.folder / "out").glob("*.npz")
    with np.load(written) as maps:
        np.testing.assert_array_equal(maps["bias"], arrays_of(finished, ("maps",))["maps/bias"])
    # a tile without its marker is done again, by a process of its own; what is finished is left alone
    (marker,) = (store / ".pchem" / "done" / "fit").rglob("0.0.json")
    for lost in (marker, store / "fit" / "bias" / "c" / "0" / "0"):
        ask(f"{server}/lab/{lost.relative_to(tmp_path / 'first')}", method="DELETE")
    cloud.ok("fit", "run.yaml", "--backend", "processes", "--workers", "1")
    store = fetched(server, tmp_path / "second")
    assert_same_results(store, finished, rtol=1e-12, groups=("histogram", "fit"))
    with pytest.raises(urllib.error.HTTPError, match="404"):
        ask(lock)
    states = [words.split()[0] for words in cloud.states("s3://lab/night/run.zarr").values()]
    assert states[:4] == ["complete"] * 4
    assert not list(cloud.folder.glob("s3*"))
