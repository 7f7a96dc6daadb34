"""``pchem view``: the report of one run in the browser, with every pixel, from a server on this computer.

The server listens on 127.0.0.1, reads one run and writes nothing. It answers GET and HEAD for a fixed list
of paths, to requests that name this computer as their host, so that neither another computer nor a page of
another site can read the run through the user's browser. The server of the standard library is enough for
that: a web framework would bring its own dependencies, and leave the checks of path and host to write.
"""

from __future__ import annotations

import base64
import contextlib
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import parse_qs, urlsplit

import numpy as np

from pchem_pipeline.base.errors import ConfigError, PchEmError, StoreError, quoted
from pchem_pipeline.base.plain import plain
from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.report.inspector import MapEntry, packed_facts, served_page
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.target import find_run
from pchem_pipeline.stages.fit.fitted_model import FittedModel
from pchem_pipeline.stages.report.inspector import deciding_parameters, listed_maps, packed_map
from pchem_pipeline.stages.report.pixels import bin_masses
from pchem_pipeline.stages.report.stored import read_histograms
from pchem_pipeline.store.run_store import RunStore

ADDRESS = "127.0.0.1"
_FILES = {
    "/report.json": "application/json",
    "/discrepancy.json": "application/json",
    "/discrepancy.html": "text/html; charset=utf-8",
}
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
_NUMBER = re.compile(r"[0-9]{1,9}")


@dataclass(frozen=True)
class Answer:
    """What the server answers to a request."""

    status: HTTPStatus
    content: bytes
    kind: str = "text/plain; charset=utf-8"
    headers: Mapping[str, str] = field(default_factory=dict)


class RunView:
    """Answers requests about one run; reads only."""

    def __init__(self, store: RunStore) -> None:
        self.store = store

    @cached_property
    def _shape(self) -> tuple[int, int]:
        return SensorInfo.read(self.store).shape

    @cached_property
    def _maps(self) -> dict[str, MapEntry]:
        return {each.path: each for each in listed_maps(self.store, self._shape)}

    def page(self) -> str:
        """Return the report with its inspector.

        Raises:
            StoreError: the run has no report, or one without an inspector, or one that is not up to date.
        """
        path = self.store.path / "report.html"
        cure = f"run: pchem report {quoted(self.store.path)}"
        if not path.is_file():
            raise StoreError(f"{self.store.path} has no report yet; {cure}")
        page = served_page(path.read_text(encoding="utf-8"))
        if page is None:
            raise StoreError(f"{path} is from an earlier version without inspector; {cure}")
        if not self._is_current("report"):
            raise StoreError(f"{self.store.path} is incomplete or stale; {cure}")
        return page

    def _is_current(self, stage: str, fingerprint: str | None = None) -> bool:
        """Return whether a stage is finished (with this fingerprint), and so are those that it rests on."""
        record = self.store.records.read(stage)
        if record is None or not record.finished or fingerprint not in (None, record.fingerprint):
            return False
        upstream = record.content.get("upstream", {}).items()
        return all(self._is_current(name, stated.partition("+")[0]) for name, stated in upstream)

    def answer(self, method: str, target: str, headers: Mapping[str, str], port: int) -> Answer:
        """Answer one request for a path with its query; headers are given by lower-case name."""
        if (refusal := _refusal(method, target, headers, port)) is not None:
            return refusal
        if not self._is_current("report"):
            return _busy()
        answer = self._answer(target)
        # what began meanwhile may have changed what was read
        return answer if self._is_current("report") else _busy()

    def _answer(self, target: str) -> Answer:
        url = urlsplit(target)
        try:
            if url.path in ("/", "/report.html"):
                return Answer(HTTPStatus.OK, self.page().encode(), "text/html; charset=utf-8")
            if url.path in _FILES:
                return self._file(url.path)
            if url.path == "/api/pixel":
                return self._pixel(parse_qs(url.query))
            if url.path == "/api/map":
                return self._map(parse_qs(url.query))
        except PchEmError as error:
            return _text(HTTPStatus.INTERNAL_SERVER_ERROR, str(error))
        return _text(HTTPStatus.NOT_FOUND, "there is nothing at this path")

    def _file(self, path: str) -> Answer:
        try:
            return Answer(HTTPStatus.OK, (self.store.path / path[1:]).read_bytes(), _FILES[path])
        except FileNotFoundError:
            return _text(HTTPStatus.NOT_FOUND, "this run has no such file")

    def _pixel(self, query: Mapping[str, list[str]]) -> Answer:
        """Return all that is known of a pixel."""
        ny, nx = self._shape
        place = [query.get(name, [""]) for name in ("y", "x")]
        if len(query) != 2 or any(len(each) != 1 or not _NUMBER.fullmatch(each[0]) for each in place):
            return _text(HTTPStatus.BAD_REQUEST, "give a pixel as y=12&x=34")
        y, x = (int(each[0]) for each in place)
        if y >= ny or x >= nx:
            return _text(HTTPStatus.NOT_FOUND, f"no such pixel; the sensor has {ny} x {nx}")
        region = (slice(y, y + 1), slice(x, x + 1))
        index = np.array([y * nx + x])
        model = FittedModel.read(self.store, region)
        histograms = read_histograms(self.store, index, self._shape)
        names = PARAMETERS if model.effects else ()
        columns = [self.store.read(f"maps/{name}", region).ravel() for name in names]
        masses = bin_masses(columns, histograms, model)
        deciding = deciding_parameters(columns, model)
        counts, mass = histograms.counts[0], masses[0] if masses else None
        occupied = np.flatnonzero(counts)
        kept = slice(occupied[0], occupied[-1] + 1) if occupied.size else slice(0, 0)
        content = {
            "origin": int(histograms.origin[0]) + int(kept.start),
            "counts": counts[kept].tolist(),
            "deciding": None if deciding is None else deciding[:, 0],
            "mass": None if mass is None or not np.isfinite(mass).all() else mass[kept],
            "values": {path: float(self.store.read(path, region).item()) for path in self._maps},
        }
        return _json(content)

    def _map(self, query: Mapping[str, list[str]]) -> Answer:
        """Return a whole map, packed as in the page."""
        asked = query.get("path", [])
        if len(query) != 1 or len(asked) != 1 or asked[0] not in self._maps:
            return _text(HTTPStatus.NOT_FOUND, "this run has no such map")
        packed = packed_map(self.store.at(), asked[0])
        return _json({**packed_facts(packed), "data": base64.b64encode(packed.data).decode("ascii")})


def _refusal(method: str, target: str, headers: Mapping[str, str], port: int) -> Answer | None:
    """Return why a request is not answered: another method, another host, or a page of another site."""
    if method not in ("GET", "HEAD"):
        allowed = {"Allow": "GET, HEAD"}
        text = b"this server only shows; GET and HEAD are all it knows"
        return Answer(HTTPStatus.METHOD_NOT_ALLOWED, text, headers=allowed)
    if not target.startswith("/"):
        return _text(HTTPStatus.BAD_REQUEST, "give a path, such as /")
    hosts = {f"{name}:{port}" for name in (ADDRESS, "localhost")}
    if headers.get("host") not in hosts:
        return _text(HTTPStatus.FORBIDDEN, "this server answers to its own address only")
    foreign = headers.get("origin") not in (None, *(f"http://{host}" for host in hosts))
    if target.startswith("/api/"):
        foreign |= headers.get("sec-fetch-site", "none") not in ("none", "same-origin")
    if foreign:
        return _text(HTTPStatus.FORBIDDEN, "this server answers to its own pages only")
    return None


def _busy() -> Answer:
    text = b"the run is being done again, or its report is older than its stages; ask again later\n"
    return Answer(HTTPStatus.SERVICE_UNAVAILABLE, text, headers={"Retry-After": "5"})


def _text(status: HTTPStatus, text: str) -> Answer:
    return Answer(status, f"{text}\n".encode())


def _json(content: Any) -> Answer:
    text = json.dumps(plain(content), separators=(",", ":"), allow_nan=False)
    return Answer(HTTPStatus.OK, text.encode(), "application/json")


class _Handler(BaseHTTPRequestHandler):
    """Hands requests to a view and sends its answers."""

    server_version = "pchem"
    sys_version = ""
    timeout = 30
    run_view: ClassVar[RunView]

    def _respond(self) -> None:
        headers = {name.lower(): value for name, value in self.headers.items()}
        assert isinstance(self.server, _Server)
        if len(self.headers.get_all("host", [])) > 1:
            answer = _text(HTTPStatus.BAD_REQUEST, "give one host")
        else:
            answer = self.run_view.answer(self.command, self.path, headers, self.server.server_port)
        self.send_response(answer.status)
        for name, value in {**_HEADERS, **answer.headers}.items():
            self.send_header(name, value)
        self.send_header("Content-Type", answer.kind)
        self.send_header("Content-Length", str(len(answer.content)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(answer.content)

    do_GET = do_HEAD = do_POST = do_PUT = do_PATCH = do_DELETE = do_OPTIONS = do_TRACE = do_CONNECT = _respond

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing: the terminal is the user's."""


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of browsers that hang up."""


def make_server(path: Path, port: int = 0) -> tuple[ThreadingHTTPServer, str]:
    """Return a server for one run (its store or YAML), listening already, and the address to open.

    Raises:
        ConfigError: the port is taken.
        StoreError: there is no run, or none with a report that can be inspected.
    """
    view = RunView(find_run(path).stored())
    view.page()
    handler = type("_RunHandler", (_Handler,), {"run_view": view})
    try:
        server = _Server((ADDRESS, port), handler)
    except OSError as error:
        raise ConfigError(
            f"--port {port}: not available ({error.strerror}); choose another port, or 0 for any free port"
        ) from error
    return server, f"http://{ADDRESS}:{server.server_port}/"


def serve(path: Path, port: int, ready: Callable[[str], None]) -> None:
    """Serve one run until Ctrl-C; ``ready`` is called with the address once the server listens.

    Raises:
        ConfigError: the port is taken.
        StoreError: there is nothing to show.
    """
    server, address = make_server(path, port)
    with server:
        ready(address)
        # Ctrl-C is how this ends, not an accident
        with contextlib.suppress(KeyboardInterrupt):
            server.serve_forever()
