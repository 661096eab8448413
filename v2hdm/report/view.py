"""A result as a page on this machine, for corrections by a person.

The page is the report plus a script. Corrections are validated and written atomically to a file beside the
result, which is never changed. The address has a secret; requests under other host names (``Host``) or from
other pages (``Origin``) are refused.
"""

from __future__ import annotations

import json
import secrets
import threading
from collections.abc import Sequence
from contextvars import Context
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import NamedTuple

import numpy as np

from v2hdm.catalogue import SHIPPED
from v2hdm.errors import MapFileError, V2hdmError, one_line
from v2hdm.io.maps.corrections import Correction, correction_of, entry_of, read_corrections, write_corrections
from v2hdm.records import Drive
from v2hdm.report.page.document import json_text, page_text
from v2hdm.report.page.facts import Facts, read_facts

_SAME_M = 0.01  # largest distance, m, between a correction and its feature
_MOST_BYTES = 100_000  # largest size of a correction that is sent


def file_beside(folder: Path) -> Path:
    """Default path of a result's corrections."""
    return folder.resolve().with_name(f"{folder.resolve().name}.corrections.yaml")


@dataclass
class Session:
    """Corrections of the result in ``folder`` by key of the feature, stored in the file ``path``."""

    folder: Path
    path: Path
    corrections: dict[str, Correction] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @classmethod
    def start(cls, folder: Path, path: Path, facts: Facts) -> Session:
        """Start from the file's content; raises MapFileError if it is no file of corrections."""
        corrections = read_corrections(path) if path.exists() else []
        return cls(
            folder,
            path,
            {_key(correction, facts) or f"old{n}": correction for n, correction in enumerate(corrections)},
        )

    def take(self, sent: bytes) -> None:
        """Store or remove a correction and write the file; raises MapFileError if malformed."""
        try:
            content = json.loads(sent)
            key = str(content["key"])
            entry = content["correction"]
        except (ValueError, TypeError, LookupError, RecursionError):
            raise MapFileError("not a correction: expected a key and a correction") from None
        with self._lock:
            corrections = {name: other for name, other in self.corrections.items() if name != key}
            if entry is not None:
                corrections[key] = correction_of(entry, key)
            # This command read the file at its start, and continues after writing it.
            Context().run(write_corrections, list(corrections.values()), str(self.folder), self.path)
            self.corrections = corrections


def _key(correction: Correction, facts: Facts) -> str | None:
    """Key in the page of a correction's feature; None if not in the map."""
    hd_map = facts.hd_map
    places = {f"x{n}": out.position_map[None] for n, out in enumerate(facts.excluded)}
    if hd_map is not None:
        places |= {f"m{marking.id}": marking.corners_map for marking in hd_map.markings}
        places |= {f"s{symbol.id}": symbol.outline_map for symbol in hd_map.symbols}
    outline = np.array(correction.outline_map)
    for key, place in places.items():
        if place.shape == outline.shape and np.abs(place - outline).max() < _SAME_M:
            return key
    return None


class Viewing(NamedTuple):
    """A server of a result on a free port of 127.0.0.1, not yet running."""

    server: ThreadingHTTPServer
    address: str
    session: Session


def server_of(folder: Path, drive: Drive | None, path: Path) -> Viewing:
    """Serve the result in ``folder`` and its corrections in the file ``path``; MapFileError without a map."""
    facts = read_facts(folder, drive)
    if facts.hd_map is None:
        raise MapFileError(f"{folder}: has no map to view; fix its drive and map it again")
    session = Session.start(folder, path, facts)
    secret = secrets.token_urlsafe(16)
    text = page_text(folder, drive, {"secret": secret})
    place = json_text({"secret": secret})
    kinds: Sequence[str] = sorted({*SHIPPED.names, *(marking.kind for marking in facts.hd_map.markings)})

    class Handler(BaseHTTPRequestHandler):
        timeout = 30

        def log_message(self, *_: object) -> None:
            """No log: errors are in the answer."""

        def do_GET(self) -> None:
            if not self._is_ours() or self.path != f"/{secret}/":
                return self._answer(404, "no such page")
            entries = {key: entry_of(correction) for key, correction in session.corrections.items()}
            editing = {"file": path.name, "corrections": entries, "kinds": kinds}
            return self._answer(200, text.replace(place, json_text(editing), 1), "text/html")

        def do_POST(self) -> None:
            length = self.headers.get("Content-Length", "")
            elsewhere = self.headers.get("Origin") not in (None, base)
            if elsewhere or not self._is_ours() or self.path != f"/{secret}/correct":
                return self._answer(404, "no such page")
            if not length.isdecimal() or int(length) > _MOST_BYTES:
                return self._answer(400, "a correction has at most 100 kB")
            try:
                session.take(self.rfile.read(int(length)))
            except (V2hdmError, OSError) as error:
                return self._answer(400, one_line(str(error)))
            return self._answer(200, "kept")

        def _is_ours(self) -> bool:
            return f"http://{self.headers.get('Host')}" == base

        def _answer(self, status: int, says: str, kind: str = "text/plain") -> None:
            content = says.encode()
            self.send_response(status)
            self.send_header("Content-Type", f"{kind}; charset=utf-8")
            self.send_header("Content-Length", str(len(content)))
            self.send_header("Cache-Control", "no-store")
            self.send_header("Referrer-Policy", "no-referrer")
            self.end_headers()
            self.wfile.write(content)

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    base = f"http://127.0.0.1:{server.server_address[1]}"
    return Viewing(server, f"{base}/{secret}/", session)
