"""Camera files on S3: a real server on loopback (moto, installed from PyPI by the extra dev)."""

import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from importlib.util import find_spec

import numpy as np
import pytest
from commands import RUN, arrays_of

pytestmark = pytest.mark.skipif(
    find_spec("moto") is None or find_spec("s3fs") is None, reason='pip install ".[dev]" brings moto and s3fs'
)


def put(url, data=b""):
    who = "Credential=key/20260101/us-east-1/s3/aws4_request, SignedHeaders=host, Signature=unchecked"
    headers = {"Content-Type": "application/octet-stream", "Authorization": f"AWS4-HMAC-SHA256 {who}"}
    request = urllib.request.Request(url, data or None, headers, method="PUT")
    with urllib.request.urlopen(request, timeout=20) as answer:
        assert answer.status == 200


@pytest.fixture
def server(tmp_path):
    """The address of an S3 server with nothing in it."""
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
def cloud(shell, server, tmp_path):
    """A shell whose S3 is that server."""
    shell.environment |= {
        "AWS_ENDPOINT_URL": server,
        "AWS_ACCESS_KEY_ID": "key",
        "AWS_SECRET_ACCESS_KEY": "secret",
        "AWS_DEFAULT_REGION": "us-east-1",
        "XDG_CACHE_HOME": str(tmp_path / "cache"),
    }
    return shell


def test_frames_are_read_from_s3_and_fetched_once(cloud, server, camera, finished, tmp_path):
    for path in sorted((camera / "frames").glob("*.tif")):
        put(f"{server}/lab/night/{path.name}", path.read_bytes())
    text = RUN.replace("frames/*.tif", '"s3://lab/night/*.tif"').replace(
        "bit_depth", "mode: reference, bit_depth"
    )
    (cloud.folder / "run.yaml").write_text(text)
    cloud.ok("ingest", "run.yaml")
    cloud.ok("histogram", "run.yaml")
    expected = arrays_of(finished, ("histogram", "summary"))
    found = arrays_of(cloud.folder / "run.zarr", ("histogram", "summary"))
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name)
    fetched = sorted((tmp_path / "cache").rglob("*.tif"))
    before = [path.stat().st_mtime_ns for path in fetched]
    assert len(fetched) == 4
    assert cloud.ok("status", "run.yaml").stdout.splitlines()[0].split() == ["ingest", "complete"]
    assert [path.stat().st_mtime_ns for path in fetched] == before
    # an object that changed is fetched again, and seen
    changed = bytearray(fetched[0].read_bytes())
    changed[-1] ^= 1
    put(f"{server}/lab/night/{fetched[0].name}", bytes(changed))
    status = cloud.ok("status", "run.yaml").stdout.splitlines()[0]
    assert status == "ingest      stale - the content of the input changed"


@pytest.mark.parametrize(
    ("url", "words"), [("s3://lab/none/*.tif", "no such file"), ("s3://elsewhere/a.tif", "no such file")]
)
def test_what_is_not_there_is_one_line(cloud, url, words):
    (cloud.folder / "run.yaml").write_text(RUN.replace("frames/*.tif", f'"{url}"'))
    result = cloud("ingest", "run.yaml")
    assert result.code == 4
    assert result.last.startswith("pchem: ")
    assert words in result.last


def test_a_server_that_does_not_answer_is_one_line(cloud):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        cloud.environment["AWS_ENDPOINT_URL"] = f"http://127.0.0.1:{free.getsockname()[1]}"
    cloud.environment["AWS_MAX_ATTEMPTS"] = "1"
    (cloud.folder / "run.yaml").write_text(RUN.replace("frames/*.tif", '"s3://lab/a.tif"'))
    result = cloud("ingest", "run.yaml")
    assert result.code == 4
    assert "check address, keys and network" in result.last


def test_a_store_cannot_be_a_url(shell):
    (shell.folder / "run.yaml").write_text(RUN.replace("run.zarr", "s3://lab/run.zarr"))
    result = shell("ingest", "run.yaml")
    assert result.code == 2
    assert "run.store" in result.last
    assert not (shell.folder / "s3:").exists()
