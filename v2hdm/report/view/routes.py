"""The routes of ``v2hdm view``, and the guards of its page.

Corrections are validated and written atomically to a file beside the result, which is never changed. The
address has a secret; requests under other host names (``Host``) or from other pages (``Origin``) are refused.
"""

from __future__ import annotations

import base64
import re
import threading
from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from v2hdm.errors import MapFileError, V2hdmError, one_line
from v2hdm.records import Drive, Exclusion, HDMap
from v2hdm.report.view.lanes import Lanes
from v2hdm.report.view.session import MeanwhileError, Session
from v2hdm.safe.texts import parse_json
from v2hdm.store.files import take_array

if TYPE_CHECKING:  # loads what decodes images
    from v2hdm.report.view.shots import Shots
    from v2hdm.report.view.tiles import TileSource

Value = TypeVar("Value")

_LENGTH = re.compile(r"[0-9]{1,9}")  # a header that states a number of bytes
_MOST_BYTES = 100_000  # largest size of a correction that is sent
_MOST_CORNERS = 1000  # of an outline whose images are asked for
_NUMBER = re.compile(r"[0-9]{1,9}")
_SHOTS = 6  # images at a time: a screen
_TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}

_HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "X-Frame-Options": "DENY",
}
"""Headers of every answer: no other page may show ours within itself."""


class Guard:
    """Refuses requests under another host name or from another page, and adds the headers of every answer."""

    def __init__(self, app: ASGIApp, base: str) -> None:
        self._app = app
        self._base = base

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request of our own page on to the routes."""

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers_of_answer = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers_of_answer.setdefault(name, value)
            await send(message)

        headers = Headers(scope=scope)
        is_ours = [f"http://{host}" for host in headers.getlist("host")] == [self._base]
        is_from_us = headers.get("origin") in (None, self._base)
        app = self._app if is_ours and is_from_us else PlainTextResponse("no such page", 404)
        await app(scope, receive, send_guarded)


class Once(Generic[Value]):
    """A value computed once, at the first request."""

    def __init__(self, make: Callable[[], Value]) -> None:
        self._make = make
        self._lock = threading.Lock()
        self._value: Value | None = None

    def value(self) -> Value:
        """The value; raises the error of its computation."""
        with self._lock:
            if self._value is None:
                self._value = self._make()
            return self._value


@dataclass(frozen=True)
class Shown:
    """The content of the page: a result's ``folder``, its map, its drive, and its corrections."""

    folder: Path
    metrics: Any
    hd_map: HDMap
    excluded: tuple[Exclusion, ...]
    drive: Drive | None
    session: Session
    lanes: Lanes
    tiles: TileSource | None = None  # a background from the web


class Pages:
    """The server's answers; slow ones are computed once, at the first request."""

    def __init__(self, shown: Shown) -> None:
        self._shown = shown
        self.scene = Once(self._draw_scene)
        self._report = Once(self._draw_report)
        self.images = Once(self._find_shots)

    def _draw_scene(self) -> bytes:
        from v2hdm.report.view.scene import scene_bytes  # loads what states accuracies

        shown = self._shown
        host = None if shown.tiles is None else shown.tiles.host
        return scene_bytes(shown.folder, shown.metrics, shown.hd_map, shown.excluded, host)

    def _draw_report(self) -> str:
        from v2hdm.report.page.document import page_text  # loads the libraries of the charts

        return page_text(self._shown.folder, self._shown.drive)

    def _find_shots(self) -> Shots:
        from v2hdm.report.view.shots import Shots  # loads what decodes images

        return Shots.of(self._shown.folder, self._shown.drive)

    def page(self, _: Request) -> Response:
        """The editor page, with the file's current corrections."""
        self._shown.session.state()
        return _asset("editor.html")

    def asset(self, request: Request) -> Response:
        """A style or a script."""
        return _asset(request.path_params["name"])

    def scene_json(self, _: Request) -> Response:
        """The map."""
        return Response(self.scene.value(), media_type="application/json")

    def state(self, _: Request) -> Response:
        """The corrections, as they are in the file now."""
        return JSONResponse(self._shown.session.state())

    def lanes_json(self, _: Request) -> Response:
        """Lanes and open questions, as the corrections are now."""
        corrections = [*self._shown.session.corrections.values()]
        return Response(self._shown.lanes.document(corrections), media_type="application/json")

    def report(self, _: Request) -> Response:
        """The report."""
        return Response(self._report.value(), media_type="text/html")

    def mosaic(self, _: Request) -> Response:
        """The picture of the ground."""
        from v2hdm.report.page.layers import mosaic_layer  # loads what states accuracies

        layer = mosaic_layer(self._shown.folder)
        if layer is None:
            raise HTTPException(404)
        return Response(base64.b64decode(layer["src"]), media_type=layer["type"])

    def tile(self, request: Request) -> Response:
        """A tile of the background."""
        tiles = self._shown.tiles
        if tiles is None:
            raise HTTPException(404)
        place = request.path_params
        tile = tiles.fetch(place["level"], place["column"], place["row"])
        return Response(
            tile.content, media_type=tile.type, headers={"Cache-Control": "private, max-age=3600"}
        )

    def shots(self, request: Request) -> Response:
        """The images that show an outline, some at a time."""
        query = request.query_params
        text = query.get("outline", "")
        if len(text) > _MOST_BYTES:
            raise MapFileError("outline: too long")
        outline_map = take_array(
            parse_json(f'{{"outline":{text}}}', "outline", MapFileError)["outline"],
            (-1, 2),
            "outline",
            MapFileError,
        )
        if not 0 < len(outline_map) <= _MOST_CORNERS:
            raise MapFileError(f"outline: expected 1 to {_MOST_CORNERS} places")
        start = query.get("start", "0")
        marking = query.get("marking", "")
        if not _NUMBER.fullmatch(start) or not (marking == "" or _NUMBER.fullmatch(marking)):
            raise MapFileError("start and marking: expected numbers")
        shots = self.images.value()
        number = int(marking) if marking else None
        return JSONResponse(shots.showing(outline_map, int(start), _SHOTS, number))

    async def correct(self, request: Request) -> Response:
        """Write corrections to the file."""
        length = request.headers.get("Content-Length", "")
        if not _LENGTH.fullmatch(length) or int(length) > _MOST_BYTES:
            return PlainTextResponse("a correction has at most 100 kB", 400)
        sent = await request.body()
        keys = await run_in_threadpool(self._shown.session.take, sent)
        return JSONResponse({"keys": keys})


def app_of(pages: Pages, base: str, secret: str) -> ASGIApp:
    """The application under ``base``, all of it below the ``secret``."""
    begin = f"/{secret}/"
    routes = [
        Route(begin, pages.page),
        Route(f"{begin}scene.json", pages.scene_json),
        Route(f"{begin}state.json", pages.state),
        Route(f"{begin}lanes.json", pages.lanes_json),
        Route(f"{begin}report", pages.report),
        Route(f"{begin}mosaic", pages.mosaic),
        Route(f"{begin}shots.json", pages.shots),
        Route(f"{begin}background/{{level:int}}/{{column:int}}/{{row:int}}", pages.tile),
        Route(f"{begin}correct", pages.correct, methods=["POST"]),
        Route(f"{begin}{{name}}", pages.asset),
    ]
    handlers: dict[Any, Any] = {
        404: _absent,
        405: _absent,
        MeanwhileError: _refused(409),
        V2hdmError: _refused(400),
        OSError: _refused(400),
    }
    return Guard(Starlette(routes=routes, exception_handlers=handlers), base)


def _asset(name: str) -> Response:
    """A file of the page; an HTTPException if it has none of that name."""
    folder = files("v2hdm.report.view") / "assets"
    if name not in {entry.name for entry in folder.iterdir()}:
        raise HTTPException(404)
    text = (folder / name).read_text(encoding="utf-8")
    return Response(text, media_type=_TYPES[Path(name).suffix])


def _absent(_: Request, __: Exception) -> Response:
    return PlainTextResponse("no such page", 404)


def _refused(status: int) -> Callable[[Request, Exception], Response]:
    """The answer to a request that a user's mistake made impossible: its one line."""

    def answer(_: Request, error: Exception) -> Response:
        return PlainTextResponse(one_line(str(error)), status)

    return answer
