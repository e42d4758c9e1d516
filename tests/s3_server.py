"""An S3 server on this machine, of moto, which counts requests and fails or kills at a chosen one."""

from __future__ import annotations

import contextlib
import os
import threading
import urllib.request
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any
from unittest import mock

BUCKET = "bucket"


@dataclass(frozen=True)
class Request:
    """A request and the number of bytes of its answer."""

    method: str
    path: str
    range: str
    answered: int


class S3Server:
    """Serves S3 in a thread of this process.

    `before` is called before each request and may return a status, such as 503, to answer instead of it; `after` is
    called when it was done, before the answer is sent.
    """

    def __init__(self) -> None:
        from moto.server import DomainDispatcherApplication, create_backend_app
        from werkzeug.serving import WSGIRequestHandler, make_server

        class Silent(WSGIRequestHandler):
            def log(self, *_: Any) -> None:
                pass

        self._application = DomainDispatcherApplication(create_backend_app)
        self.requests: list[Request] = []
        self.before: Callable[[str, str], int | None] = lambda method, path: None
        self.after: Callable[[str, str], None] = lambda method, path: None
        self._server = make_server("127.0.0.1", 0, self._answer, threaded=True, request_handler=Silent)
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()
        self.url = f"http://127.0.0.1:{self._server.server_port}"
        self.environment = {
            "AWS_ENDPOINT_URL": self.url,
            "AWS_ACCESS_KEY_ID": "a",
            "AWS_SECRET_ACCESS_KEY": "b",
            "AWS_REGION": "us-east-1",
            "AWS_ALLOW_HTTP": "true",
        }
        urllib.request.urlopen(urllib.request.Request(f"{self.url}/{BUCKET}", method="PUT")).close()

    def _answer(self, environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
        method, path = environ["REQUEST_METHOD"], environ["PATH_INFO"]
        status = self.before(method, path)
        if status is not None:
            environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0))
            start_response(f"{status} made up", [("Content-Length", "0")])
            return []
        body = b"".join(self._application(environ, start_response))
        self.after(method, path)
        self.requests.append(Request(method, path, environ.get("HTTP_RANGE", ""), len(body)))
        return [body]

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    @contextlib.contextmanager
    def counted(self) -> Iterator[list[Request]]:
        """Collect the requests of a `with` block."""
        first = len(self.requests)
        seen: list[Request] = []
        yield seen
        seen += self.requests[first:]

    @contextlib.contextmanager
    def failing(self, status: int, when: Callable[[str, str], bool]) -> Iterator[list[str]]:
        """Answer the chosen requests of a `with` block with a status; their methods and paths are collected."""
        refused: list[str] = []

        def before(method: str, path: str) -> int | None:
            if not when(method, path):
                return None
            refused.append(f"{method} {path}")
            return status

        self.before, earlier = before, self.before
        try:
            yield refused
        finally:
            self.before = earlier


def in_environment(server: S3Server) -> Any:
    """Let obstore in this process find the server in a `with` block."""
    return mock.patch.dict(os.environ, server.environment)
