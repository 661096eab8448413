"""A result as a page on this machine, for corrections by a person.

The page is the report plus a script. Corrections are validated and written atomically to a file beside the
result, which is never changed. The address has a secret; requests under other host names (``Host``) or from
other pages (``Origin``) are refused. The page is drawn after its address is told, while the browser starts.
"""

from __future__ import annotations

import re
import secrets
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from contextvars import Context
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import NamedTuple

import numpy as np

from v2hdm.catalogue import SHIPPED
from v2hdm.errors import MapFileError, V2hdmError, one_line
from v2hdm.io.maps.corrections import (
    Correction,
    correction_of,
    corrections_text,
    entry_of,
    read_corrections,
    write_corrections,
)
from v2hdm.io.metrics import read_metrics
from v2hdm.records import Drive, Exclusion, FloatArray, HDMap
from v2hdm.report.page.embedding import json_text
from v2hdm.report.page.facts import read_excluded, read_map_of
from v2hdm.safe.texts import parse_json, parse_yaml
from v2hdm.store.files import dump_yaml, load_yaml, refuse_unwritable, refuse_url
from v2hdm.store.folders import waited_for

_SAME_M = 0.01  # largest distance, m, between a correction and its feature
_LENGTH = re.compile(r"[0-9]{1,9}")  # a header that states a number of bytes
_MOST_BYTES = 100_000  # largest size of a correction that is sent


def file_beside(folder: Path) -> Path:
    """Default path of a result's corrections."""
    return folder.resolve().with_name(f"{folder.resolve().name}.corrections.yaml")


class _MeanwhileError(MapFileError):
    """Somebody else has corrected the same, or has edited the file."""


class Session:
    """Corrections of a result by key of the feature, in a file that others may write as well.

    It is read before it is written: what another ``v2hdm view`` has put there is kept, and what a person
    has written there by hand is not replaced before the page has shown it. A link stays one.
    """

    def __init__(self, folder: Path, path: Path, places: Mapping[str, FloatArray]) -> None:
        """Start from the file's content; MapFileError if that is something else, ConfigError if no place.

        ``places`` (N, 2) are those of the result's features, m, by their key in the page.
        """
        refuse_url(path)
        refuse_unwritable(path.resolve())
        self.path = path
        self.corrections: dict[str, Correction] = {}
        self._folder = folder
        self._places = places
        self._place = path.resolve()
        self._content: bytes | None = None  # of the file, as it was last read or written
        self._lock = threading.Lock()
        if self._place.exists():
            self._read()

    def refresh(self) -> None:
        """Take over what is in the file now, if that can be read; else the next correction says why not."""
        with self._lock, suppress(V2hdmError, OSError):
            if self._place.read_bytes() != self._content:
                self._read()

    def take(self, sent: bytes) -> None:
        """Store or remove a correction and write the file; raises MapFileError if malformed, or outdated."""
        try:
            content = parse_json(sent.decode(), "correction", MapFileError)
            key = content["key"]
            entry = content["correction"]
            is_compared = "before" in content
            corrected_before = content.get("before")
        except (ValueError, TypeError, LookupError, AttributeError):
            raise MapFileError("not a correction: expected a key and a correction") from None
        correction = None if entry is None else self._kept(entry)
        if correction is not None:
            key = _key(correction, self._places)
        before = self.corrections.get(key)
        if is_compared:
            before = None if corrected_before is None else self._kept(corrected_before)
        self._place.parent.mkdir(parents=True, exist_ok=True)
        with self._lock, waited_for(self._place.with_name(f".{self._place.name}.lock")):
            self._follow()
            if not _is_same(self.corrections.get(key), before):
                raise _MeanwhileError(f"{self.path}: this was corrected elsewhere meanwhile; reload the page")
            corrections = {name: other for name, other in self.corrections.items() if name != key}
            if correction is not None:
                corrections[key] = correction
            # This command read the file at its start, and continues after writing it.
            Context().run(write_corrections, [*corrections.values()], str(self._folder), self._place)
            self._content = self._place.read_bytes()
            self.corrections = corrections

    def _kept(self, entry: object) -> Correction:
        """A correction as it will be read again."""
        where = f"{self.path}: the new correction"
        text = dump_yaml(entry_of(correction_of(entry, where)))
        return correction_of(parse_yaml(text, where, MapFileError), where)

    def _read(self) -> None:
        content = self._place.read_bytes()
        corrections: dict[str, Correction] = {}
        for correction in Context().run(read_corrections, self._place):
            key = _key(correction, self._places)
            if not _is_same(corrections.setdefault(key, correction), correction):
                raise MapFileError(
                    f"{self.path}: two corrections contradict each other on the {correction.place}; keep one"
                )
        self.corrections = corrections
        self._content = content

    def _follow(self) -> None:
        """Take over what another view has written; refuse where anybody else has changed the file."""
        try:
            content = self._place.read_bytes()
        except FileNotFoundError:
            if self._content is None:
                return
            raise _MeanwhileError(
                f"{self.path}: was removed meanwhile; put it back, or start view again"
            ) from None
        if content == self._content:
            return
        corrections = Context().run(read_corrections, self._place)
        result = str(Context().run(load_yaml, self._place, MapFileError).get("result", ""))
        if content != corrections_text(corrections, result).encode():
            raise _MeanwhileError(f"{self.path}: was edited meanwhile; reload the page to go on from there")
        self._read()


def _is_same(correction: Correction | None, other: Correction | None) -> bool:
    """Whether two corrections are written in the same way."""
    return (correction and entry_of(correction)) == (other and entry_of(other))


def _places(hd_map: HDMap, excluded: Sequence[Exclusion]) -> dict[str, FloatArray]:
    """Places (N, 2) of a result's features, m, by their key in the page."""
    places = {f"x{n}": out.position_map[None] for n, out in enumerate(excluded)}
    places |= {f"m{marking.id}": marking.corners_map for marking in hd_map.markings}
    places |= {f"s{symbol.id}": symbol.outline_map for symbol in hd_map.symbols}
    return places


def _key(correction: Correction, places: Mapping[str, FloatArray]) -> str:
    """Key in the page of a correction's feature; its outline, if that is not in the map."""
    outline = np.array(correction.outline_map)
    for key, place in places.items():
        if place.shape == outline.shape and np.abs(place - outline).max() < _SAME_M:
            return key
    return str(outline.round(3).tolist())


_HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "X-Frame-Options": "DENY",
}
"""Headers of every answer: no other page may show ours within itself."""


class PageServer(ThreadingHTTPServer):
    """A server of a page that is drawn once, by whoever asks for it first."""

    daemon_threads = True

    def __init__(self, handler: type[BaseHTTPRequestHandler], draw: Callable[[], str]) -> None:
        super().__init__(("127.0.0.1", 0), handler)
        self._draw = draw
        self._drawing = threading.Lock()
        self._text = ""

    def text(self) -> str:
        """The page; raises V2hdmError where the result is damaged."""
        with self._drawing:
            self._text = self._text or self._draw()
        return self._text

    def handle_error(self, request: object, client_address: object) -> None:
        """Say nothing of a reader who hangs up."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)  # type: ignore[arg-type]


class Viewing(NamedTuple):
    """A server of a result on a free port of 127.0.0.1, not yet running."""

    server: PageServer
    address: str
    session: Session


def server_of(folder: Path, drive: Drive | None, path: Path) -> Viewing:
    """Serve the result in ``folder`` and its corrections in the file ``path``; MapFileError without a map."""
    metrics = read_metrics(folder)
    hd_map = read_map_of(folder)
    if hd_map is None:
        raise MapFileError(f"{folder}: has no map to view; fix its drive and map it again")
    session = Session(folder, path, _places(hd_map, read_excluded(folder, metrics)))
    secret = secrets.token_urlsafe(16)
    kinds: Sequence[str] = sorted({*SHIPPED.names, *(marking.kind for marking in hd_map.markings)})

    def draw() -> str:
        from v2hdm.report.page.document import page_text  # loads the libraries of the charts

        return page_text(folder, drive, {"secret": secret})

    class Handler(BaseHTTPRequestHandler):
        timeout = 30

        def log_message(self, *_: object) -> None:
            """No log: errors are in the answer."""

        def do_GET(self) -> None:
            if not self._is_ours() or self.path != f"/{secret}/":
                return self._answer(404, "no such page")
            try:
                text = server.text()
            except (V2hdmError, OSError) as error:
                return self._answer(500, one_line(str(error)))
            session.refresh()
            entries = {key: entry_of(correction) for key, correction in session.corrections.items()}
            editing = {"file": path.name, "corrections": entries, "kinds": kinds}
            place = json_text({"secret": secret})
            return self._answer(200, text.replace(place, json_text(editing), 1), "text/html")

        def do_POST(self) -> None:
            length = self.headers.get("Content-Length", "")
            elsewhere = self.headers.get("Origin") not in (None, base)
            if elsewhere or not self._is_ours() or self.path != f"/{secret}/correct":
                return self._answer(404, "no such page")
            if not _LENGTH.fullmatch(length) or int(length) > _MOST_BYTES:
                return self._answer(400, "a correction has at most 100 kB")
            try:
                session.take(self.rfile.read(int(length)))
            except _MeanwhileError as error:
                return self._answer(409, one_line(str(error)))
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
            self.end_headers()
            self.wfile.write(content)

        def end_headers(self) -> None:
            for name, value in _HEADERS.items():
                self.send_header(name, value)
            super().end_headers()

    server = PageServer(Handler, draw)
    base = f"http://127.0.0.1:{server.server_address[1]}"
    return Viewing(server, f"{base}/{secret}/", session)
