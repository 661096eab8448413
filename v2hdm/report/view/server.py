"""The server of ``v2hdm view``: Starlette's routes, uvicorn's sockets, and the guards of this page.

Corrections are validated and written atomically to a file beside the result, which is never changed. The
address has a secret; requests under other host names (``Host``) or from other pages (``Origin``) are refused.
The page is prepared after its address is told, while the browser starts.
"""

from __future__ import annotations

import base64
import re
import secrets
import socket
import threading
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from v2hdm.errors import MapFileError, V2hdmError, one_line
from v2hdm.io.metrics import read_metrics
from v2hdm.records import Drive
from v2hdm.report.page.facts import read_excluded, read_map_of
from v2hdm.report.view.session import MeanwhileError, Session, places_of

Value = TypeVar("Value")

_LENGTH = re.compile(r"[0-9]{1,9}")  # a header that states a number of bytes
_MOST_BYTES = 100_000  # largest size of a correction that is sent
_PATIENCE_S = 30  # time after which a connection without requests is closed, s
_MOST_CONNECTIONS = 256  # requests in work at a time, chosen: some pages, each with a browser's six
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
        """Pass a request on to the routes, if it is ours."""

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(_HEADERS)
            await send(message)

        headers = Headers(scope=scope)
        is_ours = [f"http://{host}" for host in headers.getlist("host")] == [self._base]
        is_from_us = headers.get("origin") in (None, self._base)
        app = self._app if is_ours and is_from_us else PlainTextResponse("no such page", 404)
        await app(scope, receive, send_guarded)


class PageServer:
    """A server on a free port of 127.0.0.1, not yet running."""

    def __init__(self) -> None:
        self._socket = socket.create_server(("127.0.0.1", 0))
        self._server: uvicorn.Server | None = None
        self._prepare: Callable[[], object] = lambda: None
        self._is_idle = threading.Event()
        self._is_idle.set()
        self.server_address = self._socket.getsockname()
        self.base = f"http://127.0.0.1:{self.server_address[1]}"

    def serve(self, app: ASGIApp, prepare: Callable[[], object]) -> None:
        """State what is served, and what is worth preparing before somebody asks."""
        config = uvicorn.Config(
            Guard(app, self.base),
            loop="asyncio",
            http="h11",
            ws="none",
            lifespan="off",
            log_config=None,
            log_level="error",  # of bugs alone: a malformed request is answered, and no news
            access_log=False,
            proxy_headers=False,
            server_header=False,
            limit_concurrency=_MOST_CONNECTIONS,
            timeout_keep_alive=_PATIENCE_S,
            timeout_graceful_shutdown=1,
        )
        self._server = uvicorn.Server(config)
        self._prepare = prepare

    def prepare(self) -> None:
        """Prepare the page; raises V2hdmError where the result is damaged."""
        self._prepare()

    def serve_forever(self) -> None:
        """Answer requests until :meth:`shutdown`, in a thread of its own."""
        assert self._server is not None
        self._is_idle.clear()
        try:
            self._server.run(sockets=[self._socket])
        finally:
            self._is_idle.set()

    def shutdown(self) -> None:
        """End :meth:`serve_forever`, which a thread runs, and wait for that."""
        assert self._server is not None
        self._server.should_exit = True
        self._is_idle.wait(_PATIENCE_S)

    def server_close(self) -> None:
        """Give the port back."""
        self._socket.close()


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
    excluded = read_excluded(folder, metrics)
    session = Session(folder, path, places_of(hd_map, excluded))
    secret = secrets.token_urlsafe(16)
    server = PageServer()

    def draw_scene() -> bytes:
        from v2hdm.report.view.scene import scene_bytes  # loads what states accuracies

        return scene_bytes(folder, metrics, hd_map, excluded)

    def draw_report() -> str:
        from v2hdm.report.page.document import page_text  # loads the libraries of the charts

        return page_text(folder, drive)

    scene = Once(draw_scene)
    report = Once(draw_report)

    def page(_: Request) -> Response:
        session.state()  # from here on the page knows what the file has now
        return _asset("editor.html")

    def asset(request: Request) -> Response:
        return _asset(request.path_params["name"])

    def scene_json(_: Request) -> Response:
        return Response(scene.value(), media_type="application/json")

    def state(_: Request) -> Response:
        return JSONResponse(session.state())

    def report_page(_: Request) -> Response:
        return Response(report.value(), media_type="text/html")

    def mosaic(_: Request) -> Response:
        from v2hdm.report.page.layers import mosaic_layer  # loads what states accuracies

        layer = mosaic_layer(folder)
        if layer is None:
            raise HTTPException(404)
        return Response(base64.b64decode(layer["src"]), media_type=layer["type"])

    async def correct(request: Request) -> Response:
        length = request.headers.get("Content-Length", "")
        if not _LENGTH.fullmatch(length) or int(length) > _MOST_BYTES:
            return PlainTextResponse("a correction has at most 100 kB", 400)
        sent = await request.body()
        keys = await run_in_threadpool(session.take, sent)
        return JSONResponse({"keys": keys})

    begin = f"/{secret}/"
    app = Starlette(
        routes=[
            Route(begin, page),
            Route(f"{begin}scene.json", scene_json),
            Route(f"{begin}state.json", state),
            Route(f"{begin}report", report_page),
            Route(f"{begin}mosaic", mosaic),
            Route(f"{begin}correct", correct, methods=["POST"]),
            Route(f"{begin}{{name}}", asset),
        ],
        exception_handlers={
            404: _absent,
            405: _absent,
            MeanwhileError: _refused(409),
            V2hdmError: _refused(400),
            OSError: _refused(400),
        },
    )
    server.serve(app, scene.value)
    return Viewing(server, f"{server.base}/{secret}/", session)


class Once(Generic[Value]):
    """What is made once, by whoever asks for it first."""

    def __init__(self, make: Callable[[], Value]) -> None:
        self._make = make
        self._lock = threading.Lock()
        self._value: Value | None = None

    def value(self) -> Value:
        """It; raises what making it raises."""
        with self._lock:
            if self._value is None:
                self._value = self._make()
            return self._value


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
