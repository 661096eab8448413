"""A background is fetched from the address that a user gives, or refused at once in a line."""

import threading
from contextlib import contextmanager
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np
import pytest

from tests.report.page.browser import opened
from tests.report.page.folder import make_result
from tests.report.page.test_browser import browser as browser
from v2hdm.cli.main import run
from v2hdm.errors import ConfigError
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.maps.reading import read_geojson
from v2hdm.records import GeodeticOrigin
from v2hdm.report.view.server import server_of
from v2hdm.report.view.session import file_beside
from v2hdm.report.view.tiles import TileSource, tile_at

ORIGIN = GeodeticOrigin(49.0, 8.4, 110.0)
RED = cv2.imencode(".png", np.full((256, 256, 3), (0, 0, 200), np.uint8))[1].tobytes()


@contextmanager
def service(content=RED, status=200):
    """A service of tiles on this machine, and what it was asked for."""
    paths = []

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *_):
            pass

        def do_GET(self):
            paths.append(self.path)
            self.send_response(status)
            self.end_headers()
            self.wfile.write(content)

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}", paths
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def test_the_tile_of_a_place_is_that_of_all_slippy_maps():
    # The example of wiki.openstreetmap.org/wiki/Slippy_map_tilenames.
    assert tile_at(139.7006793, 35.6590699, 18) == (232798, 103246)


@pytest.mark.parametrize(
    ("template", "path"),
    [
        ("/{z}/{x}/{y}.png?key=abc", "/2/1/3.png?key=abc"),
        ("/{z}/{x}/{-y}.png", "/2/1/0.png"),
        ("/wmts/{TileMatrix}/{TileRow}/{TileCol}.jpg", "/wmts/2/3/1.jpg"),
        ("/?REQUEST=GetTile&TILEMATRIX={TileMatrix}&TILEROW={TileRow}&TILECOL={TileCol}",
         "/?REQUEST=GetTile&TILEMATRIX=2&TILEROW=3&TILECOL=1"),
    ],
)  # fmt: skip
def test_a_tile_is_fetched_by_names_of_xyz_and_wmts(template, path):
    with service() as (address, paths):
        tile = TileSource.of(f"{address}{template}", ORIGIN).fetch(2, 1, 3)
        assert (tile.content, tile.type) == (RED, "image/png")
        assert paths[-1] == path
        with pytest.raises(ConfigError, match="there is no tile 2/4/0"):
            TileSource(f"{address}{template}").fetch(2, 4, 0)


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("ftp://host/{z}/{x}/{y}", "begins with https://"),
        ("file:///etc/{z}/{x}/{y}", "begins with https://"),
        ("https://me:hidden@host/{z}/{x}/{y}", "leave user and password out"),
        ("https://host/tiles?key=hidden", "lacks the places of a tile"),
        ("https://host/{z}/{x}/{y}?key={apikey}", "write its value into the address"),
        ("http://127.0.0.1:9/{z}/{x}/{y}?key=hidden", "127.0.0.1: does not answer"),
    ],
)
def test_an_address_that_cannot_serve_is_refused_in_a_line_without_its_secrets(
    address, message, tmp_path, capsys
):
    make_result(tmp_path)
    place = tmp_path / "result" / "map.geojson"
    write_geojson(replace(read_geojson(place), origin=ORIGIN), place)
    assert run(["view", str(tmp_path / "result"), "--background", address]) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert printed.err.count("\n") == 1
    assert "hidden" not in printed.err
    assert printed.out == ""


@pytest.mark.parametrize(
    ("content", "status", "message"),
    [
        (b"<html>no", 200, "not a PNG, JPEG or WebP"),
        (RED, 403, "answers 403"),
        (RED * 9000, 200, "not a PNG"),
    ],
)
def test_what_is_no_tile_is_refused(content, status, message):
    with service(content, status) as (address, _), pytest.raises(ConfigError, match=message):
        TileSource.of(f"{address}/{{z}}/{{x}}/{{y}}", ORIGIN)


def test_a_map_without_a_place_on_the_earth_has_no_background():
    with pytest.raises(ConfigError, match=r"state the origin in drive\.yaml"):
        TileSource.of("https://host/{z}/{x}/{y}", None)


MIDDLE = """() => {
    const canvas = document.getElementById("map");
    return [...canvas.getContext("2d").getImageData(5, 5, 1, 1).data];
}"""


def test_the_page_shows_the_tiles_and_asks_nobody_else(browser, tmp_path):
    make_result(tmp_path)
    folder = tmp_path / "result"
    place = folder / "map.geojson"
    write_geojson(replace(read_geojson(place), origin=ORIGIN), place)
    with service() as (tiles, paths):
        server, address, _ = server_of(folder, None, file_beside(folder), f"{tiles}/{{z}}/{{x}}/{{y}}")
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        with opened(browser, address) as watched:
            watched.page.wait_for_selector("html[data-ready]")
            watched.page.wait_for_load_state("networkidle")
            watched.page.wait_for_timeout(300)
            assert watched.page.evaluate(MIDDLE) == [200, 0, 0, 255]
            assert {url.startswith((address, "data:")) for url in watched.requests} == {True}
            assert watched.said == []
        server.shutdown()
        server.server_close()
        thread.join()
    assert len(paths) > 1
