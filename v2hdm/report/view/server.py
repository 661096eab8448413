"""The server of ``v2hdm view``: a port of this machine, and uvicorn behind it.

Its address is printed before the server's libraries are loaded; a client that connects meanwhile waits.
"""

from __future__ import annotations

import secrets
import socket
import threading
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from v2hdm.errors import MapFileError, V2hdmError
from v2hdm.io.metrics import read_metrics
from v2hdm.records import Drive
from v2hdm.report.page.facts import read_excluded, read_map_of
from v2hdm.report.view.lanes import Lanes
from v2hdm.report.view.session import Session, places_of

if TYPE_CHECKING:
    import uvicorn

    from v2hdm.report.view.routes import Pages
    from v2hdm.report.view.tiles import TileSource

_PATIENCE_S = 30  # time after which a connection without requests is closed, s
_MOST_CONNECTIONS = 256  # requests in work at a time, chosen: some pages, each with a browser's six


class PageServer:
    """A server on a free port of 127.0.0.1, not yet running."""

    def __init__(self, folder: Path, drive: Drive | None, path: Path, background: str | None = None) -> None:
        """Read the result; MapFileError without a map, or where the corrections in ``path`` are none.

        ``background`` is an address of tiles; ConfigError where it does not answer.
        """
        self._folder = folder
        self._drive = drive
        self._metrics = read_metrics(folder)
        hd_map = read_map_of(folder)
        if hd_map is None:
            raise MapFileError(f"{folder}: has no map to view; fix its drive and map it again")
        self._hd_map = hd_map
        self._excluded = read_excluded(folder, self._metrics)
        self._lanes = Lanes.of(folder, hd_map)
        self.session = Session(folder, path, places_of(hd_map, self._excluded), self._lanes.check)
        self._tiles: TileSource | None = None
        if background is not None:
            from v2hdm.report.view.tiles import TileSource  # for those who give an address

            self._tiles = TileSource.of(background, hd_map.origin)
        self._secret = secrets.token_urlsafe(16)
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.server_address = self._socket.getsockname()
        self._base = f"http://127.0.0.1:{self.server_address[1]}"
        self.address = f"{self._base}/{self._secret}/"
        self._server: uvicorn.Server | None = None
        self._pages: Pages | None = None
        self._is_idle = threading.Event()
        self._is_idle.set()

    def take_edits(self, path: Path) -> tuple[int, list[str]]:
        """Take the edits in a copy of the map as corrections: how many are new, and what is none.

        Raises:
            MapFileError: the file is no copy of the map, or contradicts the corrections that there are.
        """
        from v2hdm.io.maps.edits import read_edits  # for those who give a copy

        edits = read_edits(path, self._hd_map)
        return self.session.merge(edits.corrections), edits.ignored

    def load(self) -> uvicorn.Server:
        """Load the libraries of the server; ModuleNotFoundError where they are not installed."""
        if self._server is not None:
            return self._server
        import uvicorn

        from v2hdm.report.view.routes import Pages, Shown, app_of

        shown = Shown(
            self._folder,
            self._metrics,
            self._hd_map,
            self._excluded,
            self._drive,
            self.session,
            self._lanes,
            self._tiles,
        )
        self._pages = Pages(shown)
        config = uvicorn.Config(
            app_of(self._pages, self._base, self._secret),
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
        return self._server

    def prepare(self) -> None:
        """Prepare what the page asks for first; raises V2hdmError where the result is damaged."""
        self.load()
        assert self._pages is not None
        self._pages.scene.value()
        with suppress(V2hdmError, OSError):  # which the page tells whoever asks for images
            self._pages.images.value()

    def serve_forever(self) -> None:
        """Answer requests until :meth:`shutdown`, in a thread of its own."""
        server = self.load()
        self._is_idle.clear()
        try:
            server.run(sockets=[self._socket])
        finally:
            self._is_idle.set()

    def shutdown(self) -> None:
        """End :meth:`serve_forever`, which a thread runs, and wait for that."""
        self.load().should_exit = True
        self._is_idle.wait(_PATIENCE_S)

    def server_close(self) -> None:
        """Give the port back."""
        self._socket.close()


class Viewing(NamedTuple):
    """A server of a result on a free port of 127.0.0.1, not yet running."""

    server: PageServer
    address: str
    session: Session


def server_of(folder: Path, drive: Drive | None, path: Path, background: str | None = None) -> Viewing:
    """Serve the result in ``folder`` and its corrections in the file ``path``, as :class:`PageServer`."""
    server = PageServer(folder, drive, path, background)
    return Viewing(server, server.address, server.session)
