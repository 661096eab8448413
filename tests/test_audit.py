"""The audit of installed packages runs where advisories can be reached, and says why where not."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

from tests import audit


@contextmanager
def served(body: bytes) -> Iterator[str]:
    """The address of a server that answers everything with ``body``."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None: ...

    server = HTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()


@pytest.mark.parametrize("body", [b"", b"<html>", json.dumps({"vulnerabilities": []}).encode()])
def test_without_advisories_the_audit_is_skipped_with_a_reason(
    body: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    with served(body) as address:
        assert audit.main(address) == 0
        assert address in capsys.readouterr().out


def test_an_unreachable_server_is_a_reason() -> None:
    assert "refused" in str(audit.why_not("http://127.0.0.1:9/"))


def test_with_advisories_there_is_no_reason_to_skip() -> None:
    with served(json.dumps({"vulnerabilities": [{"id": "CVE-2020-14343"}]}).encode()) as address:
        assert audit.why_not(address) is None
