"""A server between a program and an object storage: it counts requests, and lets some of them fail."""

import http.client
import threading
import time
from collections import Counter
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import urlsplit

BUSY = b'<?xml version="1.0"?><Error><Code>%s</Code><Message>no</Message></Error>'


class FlakyProxy(ThreadingHTTPServer):
    """Forwards to ``upstream``; ``plan(number, method, path)`` says what becomes of each request.

    ``ok``, ``500``, ``503``, ``slow`` (a second), ``cut`` (half of the answer), ``lost`` (it is done, but the
    answer does not arrive).

    Attributes:
        requests: how many came, by method.
        fates: what became of them.
    """

    daemon_threads = True

    def __init__(self, upstream, plan=lambda number, method, path: "ok"):
        super().__init__(("127.0.0.1", 0), _Handler)
        self.upstream, self.plan = urlsplit(upstream).netloc, plan
        self.requests, self.fates = Counter(), Counter()
        self._lock = threading.Lock()
        threading.Thread(target=self.serve_forever, daemon=True).start()

    @property
    def address(self):
        return f"http://127.0.0.1:{self.server_address[1]}"

    def end(self):
        """Stop serving."""
        self.shutdown()
        self.server_close()

    def fate(self, method, path):
        with self._lock:
            number = sum(self.requests.values())
            self.requests[method] += 1
        fate = self.plan(number, method, path)
        self.fates[fate] += 1
        return fate

    def handle_error(self, *unused):
        """Say nothing: clients that go away are part of the play."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def _serve(self):
        body = self._body()
        fate = self.server.fate(self.command, self.path)
        if fate == "slow":
            time.sleep(1)
        elif fate in ("500", "503"):
            code = b"InternalError" if fate == "500" else b"SlowDown"
            self._answer(int(fate), [], BUSY % code)
            return
        status, headers, content = self._ask(body)
        if fate == "lost":
            self.close_connection = True
            return
        self._answer(status, headers, content, half=fate == "cut")

    def _body(self):
        if self.headers.get("Expect", "").lower() == "100-continue":
            pass  # the base class has answered
        if self.headers.get("Transfer-Encoding", "").lower() == "chunked":
            content = b""
            while size := int(self.rfile.readline().split(b";")[0], 16):
                content += self.rfile.read(size)
                self.rfile.readline()
            self.rfile.readline()
            return content
        return self.rfile.read(int(self.headers.get("Content-Length", 0)))

    def _ask(self, body):
        connection = http.client.HTTPConnection(self.server.upstream, timeout=60)
        skipped = ("transfer-encoding", "content-length", "expect", "connection")
        headers = {k: v for k, v in self.headers.items() if k.lower() not in skipped}
        headers["Content-Length"] = str(len(body))
        connection.request(self.command, self.path, body, headers)
        answer = connection.getresponse()
        content = answer.read()
        connection.close()
        return answer.status, answer.getheaders(), content

    def _answer(self, status, headers, content, half=False):
        self.send_response_only(status)
        told = {name.lower(): value for name, value in headers}
        for name, value in headers:
            if name.lower() not in ("transfer-encoding", "content-length", "connection"):
                self.send_header(name, value)
        size = told.get("content-length", "0") if self.command == "HEAD" else str(len(content))
        self.send_header("Content-Length", size)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content[: len(content) // 2] if half else content)
        self.close_connection = self.close_connection or half

    do_GET = do_PUT = do_POST = do_DELETE = do_HEAD = _serve

    def log_message(self, *unused):
        """Say nothing."""
