"""``pchem view``: every pixel of one run, to this computer's browser only, and nothing else."""

import base64
import contextlib
import http.client
import json
import shutil
import signal
import socket
from dataclasses import replace

import numpy as np
import pytest
from helpers.commands import served
from helpers.packed_maps import unpack_map

from pchem_pipeline.base.errors import ConfigError, StoreError
from pchem_pipeline.commands.view import make_server
from pchem_pipeline.report.inspector import PackedMap, Scale
from pchem_pipeline.store.run_store import RunStore


class Client:
    """Asks the server, with any header."""

    def __init__(self, port):
        self.port = port

    def ask(self, method, path, **headers):
        with contextlib.closing(http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)) as connection:
            headers = {name.replace("_", "-"): value for name, value in headers.items()}
            connection.request(method, path, headers=headers)
            answer = connection.getresponse()
            return answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()

    def json(self, path):
        status, _, content = self.ask("GET", path)
        assert status == 200, content
        return json.loads(content)


def files(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def client(finished):
    with served(finished) as (server, address):
        assert address == f"http://127.0.0.1:{server.server_port}/"
        assert server.server_address[0] == "127.0.0.1"  # for this computer only
        before = files(finished)
        yield Client(server.server_port)
        assert files(finished) == before  # nothing is written


def test_the_page_may_ask_its_own_server_and_no_other(client, finished):
    status, headers, content = client.ask("GET", "/")
    page, stored = content.decode(), (finished / "report.html").read_text()
    assert status == 200
    assert "connect-src &#39;self&#39;" in page
    assert "connect-src &#39;none&#39;" not in page
    assert "connect-src &#39;none&#39;" in stored
    assert '<meta name="pchem-view" content="yes">' in page
    assert headers.items() >= {
        ("content-type", "text/html; charset=utf-8"),
        ("x-content-type-options", "nosniff"),
        ("cross-origin-resource-policy", "same-origin"),
        ("content-security-policy", "frame-ancestors 'none'"),
    }
    assert "access-control-allow-origin" not in headers


@pytest.mark.parametrize("place", [(0, 0), (19, 27), (7, 13)])
def test_every_pixel_as_the_store_has_it(client, finished, place):
    store, (y, x) = RunStore.open(finished), place
    pixel = client.json(f"/api/pixel?y={y}&x={x}")
    counts, origin = store.read("histogram/counts")[y, x], int(store.read("histogram/origin")[y, x])
    seen, stored = (
        {first + i: int(n) for i, n in enumerate(values) if n}
        for first, values in ((pixel["origin"], pixel["counts"]), (origin, counts))
    )
    assert seen == stored
    assert pixel["mass"] is None
    assert pixel["deciding"] is None
    assert len(pixel["values"]) >= 25
    for path, value in pixel["values"].items():
        stored = float(store.read(path)[y, x])
        assert value == stored if np.isfinite(stored) else value is None, path


def test_a_whole_map_as_the_store_has_it(client, finished):
    store = RunStore.open(finished)
    found = client.json("/api/map?path=maps/bias")
    scale = Scale(found["low"], found["step"], found["log"])
    packed = PackedMap(scale, found["nOdd"], base64.b64decode(found["data"]))
    stored, error = store.read("maps/bias"), np.nanmedian(store.read("maps/bias_stderr"))
    np.testing.assert_allclose(unpack_map(packed, stored.shape), stored, rtol=0, atol=error / 16 * 1.001)


PIXEL = "/api/pixel?y=0&x=0"
HOSTS = ("evil.example", "127.0.0.1", "evil.example:80", "127.0.0.1:1", "", "[::1]:80")
NOT_THERE = (
    "/zarr.json", "/fit/bias/zarr.json", "/.pchem/config.yaml", "/../run.yaml", "/%2e%2e/run.yaml",
    "/report.html/../zarr.json", "//etc/passwd", "/figures/ensemble.svg", "/discrepancy.html", "/api/",
    "/api/map?path=frames/dn", "/api/map?path=../fit/bias", "/api/map?path=fit/bias&path=fit/bias",
    "/api/pixel?y=20&x=0", "/api/pixel?y=0&x=28",
)  # fmt: skip
METHODS = ("POST", "PUT", "PATCH", "DELETE", "OPTIONS", "TRACE", "CONNECT")
NO_PIXELS = ("", "y=1", "y=-1&x=0", "y=1.5&x=0", "y=1&x=0&z=3", "y=a&x=0", "y=%EF%BC%91&x=0")


@pytest.mark.parametrize(
    ("status", "method", "path", "headers"),
    [
        *((405, method, "/", {}) for method in METHODS),
        (501, "MOVE", "/", {}),
        *((403, "GET", path, {"Host": host}) for host in HOSTS for path in ("/", PIXEL)),
        (200, "GET", "/report.json", {"Host": "localhost:PORT"}),
        (200, "HEAD", "/report.json", {"Host": "127.0.0.1:PORT"}),
        (403, "GET", PIXEL, {"Origin": "http://evil.example"}),
        (403, "GET", PIXEL, {"Origin": "null"}),
        (200, "GET", PIXEL, {"Origin": "http://127.0.0.1:PORT"}),
        (403, "GET", PIXEL, {"Sec_Fetch_Site": "cross-site"}),
        (200, "GET", PIXEL, {"Sec_Fetch_Site": "same-origin"}),
        *((404, "GET", path, {}) for path in NOT_THERE),
        *((400, "GET", f"/api/pixel?{query}", {}) for query in NO_PIXELS),
    ],
)
def test_other_methods_hosts_sites_and_paths_are_refused(client, status, method, path, headers):
    headers = {name: value.replace("PORT", str(client.port)) for name, value in headers.items()}
    found, answered, content = client.ask(method, path, **headers)
    assert found == status
    assert status != 405 or answered["allow"] == "GET, HEAD"
    assert method != "HEAD" or content == b""


def test_a_port_scanner_stops_nothing(client):
    rng = np.random.default_rng(4)
    sent = [b"", b"\r\n\r\n", b"\0" * 100, b"\x16\x03\x01\x02\x00\x01\x00", b"SSH-2.0-x\r\n", b"GET\r\n\r\n"]
    sent += [b"GET //[ HTTP/1.1\r\nHost: 127.0.0.1:%d\r\n\r\n" % client.port, b"GET /" + b"a" * 100_000]
    sent += [b"GET / HTTP/9.9\r\n\r\n", b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * 500 + b"\r\n"]
    sent += [rng.bytes(int(size)) for size in rng.integers(1, 3000, 20)]
    held = []
    for content in sent:
        connection = socket.create_connection(("127.0.0.1", client.port), timeout=5)
        connection.sendall(content)
        held.append(connection)  # open while the others come
    assert client.ask("GET", "/api/pixel?y=3&x=4")[0] == 200
    for connection in held:
        connection.close()
    assert client.ask("GET", "/api/pixel?y=3&x=4")[0] == 200


@pytest.mark.parametrize(
    ("target", "hosts"),
    [
        ("http://[::1", 1),
        ("http://127.0.0.1:PORT/api/pixel?y=0&x=0", 1),
        ("http://evil.example/api/pixel?y=0&x=0", 1),
        ("api/pixel?y=0&x=0", 1),
        ("*", 1),
        ("/", 2),
    ],
)
def test_malformed_requests_are_said(client, target, hosts):
    request = f"GET {target} HTTP/1.1\r\n" + "Host: 127.0.0.1:PORT\r\n" * hosts
    request += "Sec-Fetch-Site: cross-site\r\nConnection: close\r\n\r\n"
    with socket.create_connection(("127.0.0.1", client.port), timeout=5) as connection:
        connection.sendall(request.replace("PORT", str(client.port)).encode())
        assert connection.makefile("rb").readline().split()[1] == b"400"


def test_a_run_that_is_done_again_is_not_shown(finished, tmp_path):
    store = RunStore.open(shutil.copytree(finished, tmp_path / "run.zarr"), writable=True)
    server, _ = make_server(store.path)
    with server:
        view, port = server.RequestHandlerClass.run_view, server.server_port

        def status():
            asked = ("/", "/report.json", "/api/pixel?y=0&x=0", "/api/map?path=maps/bias")
            return {view.answer("GET", each, {"host": f"localhost:{port}"}, port).status for each in asked}

        assert status() == {200}
        fit = store.records.read("fit")
        for changed in (replace(fit, finished=False), replace(fit, fingerprint="another")):
            store.records.write(changed)
            assert status() == {503}
            with pytest.raises(StoreError, match="is incomplete or stale; run: pchem rep"):
                make_server(store.path)
        store.records.write(fit)
        assert status() == {200}


def test_runs_without_a_report_and_a_taken_port_are_said(finished, tmp_path):
    bare = RunStore.create(tmp_path / "bare.zarr")
    bare.write_config((finished / ".pchem" / "config.yaml").read_text())
    with pytest.raises(StoreError, match="has no report yet; run: pchem report"):
        make_server(bare.path)
    (bare.path / "report.html").write_text("<html></html>")
    with pytest.raises(StoreError, match="from an earlier version"):
        make_server(bare.path)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(ConfigError, match="not available"):
            make_server(finished, taken.getsockname()[1])


def test_the_command_ends_well_with_ctrl_c(shell, finished):
    with shell.start("view", finished) as process:
        address = process.stdout.readline().strip()
        assert address.startswith("http://127.0.0.1:")
        client = Client(int(address.rstrip("/").rsplit(":")[-1]))
        assert client.ask("GET", "/")[0] == 200
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=30)
    assert (process.returncode, out, err) == (0, "", "")
