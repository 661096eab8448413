"""No picture of a site makes anything else be opened, be it beside it or on the network."""

import http.server
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from v2hdm.errors import MapFileError
from v2hdm.safe.backgrounds import Window, background_pixels, check_background
from v2hdm.surface.strips import mosaic_points

rasterio = pytest.importorskip("rasterio")

CRS = "EPSG:32632"
WEST_M, NORTH_M, STEP_M, SIDE_PX = 560_000.0, 5_930_000.0, 0.1, 2000
WINDOW = Window(CRS, WEST_M, NORTH_M, 1.0, 200, 200)
ZOOM = 17


@pytest.fixture
def asked(monkeypatch):
    """Its port, and what a server on this machine is asked."""
    paths = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            paths.append(self.path)
            self.send_error(404)

        do_HEAD = do_GET

        def log_message(self, *_):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    yield f"http://127.0.0.1:{server.server_address[1]}", paths
    server.shutdown()
    server.server_close()
    thread.join()


def write_tif(path, **changes):
    """A picture with a bright square on grey ground, finer than a window."""
    place = rasterio.Affine(STEP_M, 0, WEST_M, 0, -STEP_M, NORTH_M)
    look = {"width": SIDE_PX, "height": SIDE_PX, "count": 3, "dtype": "uint8", "crs": CRS, "transform": place}
    look |= {"compress": "deflate", "tiled": True, **changes}
    pixels = np.full((look["count"], look["height"], look["width"]), 40, look["dtype"])
    pixels[:, 900:1100, 500:700] = 250
    with rasterio.open(path, "w", driver="GTiff", **look) as dataset:
        dataset.write(pixels)
    return path


def vrt(source):
    band = f"<SimpleSource><SourceFilename>{source}</SourceFilename><SourceBand>1</SourceBand></SimpleSource>"
    bands = "".join(f'<VRTRasterBand dataType="Byte" band="{n}">{band}</VRTRasterBand>' for n in range(1, 4))
    return f'<VRTDataset rasterXSize="1000" rasterYSize="1000">{bands}</VRTDataset>'


def beside(url):
    """Endings of the names of files that may lie beside a GeoTIFF."""
    files = f'<MDI key="X_DATASET">/vsicurl/{url}/x.tif</MDI><MDI key="Y_DATASET">/vsicurl/{url}/y.tif</MDI>'
    return {
        ".ovr": vrt(f"/vsicurl/{url}/overview.tif"),
        ".msk": vrt(f"/vsicurl/{url}/mask.tif"),
        ".aux.xml": f'<PAMDataset><Metadata domain="GEOLOCATION">{files}</Metadata></PAMDataset>',
    }


def bright(pixels):
    """Middle of what is bright, in m from the window's corner."""
    return (np.argwhere(pixels[..., 1] > 200).mean(axis=0) + 0.5)[::-1]


@pytest.mark.parametrize("ending", [".ovr", ".msk", ".aux.xml"])
def test_a_geotiff_is_read_without_what_lies_beside_it(ending, asked, tmp_path):
    url, paths = asked
    path = write_tif(tmp_path / "a.tif")
    Path(f"{path}{ending}").write_text(beside(url)[ending])
    check_background(path)
    assert bright(background_pixels(path, WINDOW)) == pytest.approx((60.0, 100.0), abs=0.6)
    points = np.concatenate(list(mosaic_points(path, 1.0, 10**6, 100)))
    assert points[:, 2].max() == 250
    assert paths == []


@pytest.mark.parametrize("where", ["inside", "beside"])
def test_overviews_that_a_geotiff_names_elsewhere_are_refused_unopened(where, asked, tmp_path):
    url, paths = asked
    path = write_tif(tmp_path / "a.tif")
    named = f"/vsicurl/{url}/overview.tif"
    if where == "inside":
        with rasterio.open(path, "r+") as dataset:
            dataset.update_tags(ns="OVERVIEWS", OVERVIEW_FILE=named)
    else:
        item = f'<Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">{named}</MDI></Metadata>'
        Path(f"{path}.aux.xml").write_text(f"<PAMDataset>{item}</PAMDataset>")
    for read in (check_background, lambda path: background_pixels(path, WINDOW)):
        with pytest.raises(MapFileError, match=r"a\.tif: names another file for its overviews"):
            read(path)
    assert paths == []


def test_a_geotiff_may_have_its_place_and_its_system_beside_it(tmp_path):
    with pytest.warns(rasterio.errors.NotGeoreferencedWarning):
        path = write_tif(tmp_path / "a.tif", crs=None, transform=None)
    with rasterio.open(write_tif(tmp_path / "b.tif")) as other:
        wkt = other.crs.to_wkt()
    Path(f"{path}.aux.xml").write_text(f"<PAMDataset><SRS>{wkt}</SRS></PAMDataset>")
    lines = (STEP_M, 0, 0, -STEP_M, WEST_M + STEP_M / 2, NORTH_M - STEP_M / 2)
    path.with_suffix(".tfw").write_text("".join(f"{line}\n" for line in lines))
    assert bright(background_pixels(path, WINDOW)) == pytest.approx((60.0, 100.0), abs=0.6)


CHILDREN = {
    "VRT": lambda url: vrt(f"/vsicurl/{url}/secret.tif"),
    "WMS": lambda url: f'<GDAL_WMS><Service name="TMS"><ServerUrl>{url}/tms</ServerUrl></Service></GDAL_WMS>',
    "GTI": lambda url: (
        f"<GDALTileIndexDataset><IndexDataset>/vsicurl/{url}/a.gpkg</IndexDataset></GDALTileIndexDataset>"
    ),
}


def write_tiles(folder, replaced=None, text="", ending=".png"):
    """Tiles about the window, each of one grey value; one of them, by its number, may be a text."""
    half = 20037508.342789244
    side = 2 * half / 2**ZOOM
    warp = pytest.importorskip("rasterio.warp")
    (x,), (y,) = warp.transform(CRS, "EPSG:3857", [WEST_M + 100], [NORTH_M - 100])
    column, row = int((x + half) // side), int((half - y) // side)
    number = 0
    for over in (-1, 0, 1):
        (folder / f"{ZOOM}/{column + over}").mkdir(parents=True)
        for down in (-1, 0, 1):
            path = folder / f"{ZOOM}/{column + over}/{row + down}{ending}"
            cv2.imwrite(str(path), np.full((256, 256, 3), 60 + 20 * number, np.uint8))
            if number == replaced:
                path.write_text(text)
            number += 1
    return folder


@pytest.mark.parametrize("kind", CHILDREN)
@pytest.mark.parametrize("replaced", [0, 4, 8])
def test_a_tile_that_names_other_files_is_refused_whichever_it_is(kind, replaced, asked, tmp_path):
    url, paths = asked
    folder = write_tiles(tmp_path / "tiles", replaced, CHILDREN[kind](url))
    with pytest.raises(MapFileError, match=r"\.png: not a PNG, JPEG, TIFF, BMP or WebP image; cut the tiles"):
        check_background(folder)
    if replaced == 4:
        with pytest.raises(MapFileError, match="not a PNG"):
            background_pixels(folder, WINDOW)
    assert paths == []


@pytest.mark.parametrize("kind", CHILDREN)
def test_a_file_that_is_called_a_geotiff_and_names_others_is_refused(kind, asked, tmp_path):
    url, paths = asked
    (tmp_path / "a.tif").write_text(CHILDREN[kind](url))
    with pytest.raises(MapFileError, match=r"a\.tif: not a readable GeoTIFF \(not recognized"):
        check_background(tmp_path / "a.tif")
    assert paths == []


@pytest.mark.parametrize("ending", [".png", ".jpg", ".webp"])
def test_tiles_of_every_kind_lie_where_they_belong(ending, tmp_path):
    folder = write_tiles(tmp_path / "tiles", ending=ending)
    (folder / f"{ZOOM}" / "notes.txt").write_text("cut in May")
    (folder / f"{'9' * 5000}"[:200]).mkdir()
    check_background(folder)
    pixels = background_pixels(folder, WINDOW)
    assert pixels[100, 100, :3] == pytest.approx([140, 140, 140], abs=3)  # the middle tile, by its place
    assert set(np.unique(pixels[..., 3])) <= {0, 255}


def test_pictures_of_no_place_on_the_earth_or_of_no_colours_are_refused_before_any_work(tmp_path):
    local = 'LOCAL_CS["site",UNIT["metre",1]]'
    for name, changes, reason in (
        ("local", {"crs": local}, "its coordinate system has no place on the earth"),
        ("complex", {"dtype": "complex64"}, "has pixels of type complex64"),
    ):
        with pytest.raises(MapFileError, match=f"{name}.tif: {reason}"):
            check_background(write_tif(tmp_path / f"{name}.tif", **changes))


def test_a_picture_of_nothing_is_dark_and_one_with_a_palette_has_its_colours(tmp_path):
    look = {
        "width": 200,
        "height": 200,
        "count": 1,
        "transform": rasterio.Affine(1, 0, WEST_M, 0, -1, NORTH_M),
    }
    empty = tmp_path / "empty.tif"
    with rasterio.open(empty, "w", driver="GTiff", dtype="float32", crs=CRS, **look) as dataset:
        dataset.write(np.full((1, 200, 200), np.nan, np.float32))
    assert background_pixels(empty, WINDOW)[..., :3].max() == 0
    coloured = tmp_path / "coloured.tif"
    with rasterio.open(
        coloured, "w", driver="GTiff", dtype="uint8", crs=CRS, photometric="palette", **look
    ) as dataset:
        dataset.write(np.full((1, 200, 200), 7, np.uint8))
        dataset.write_colormap(1, {7: (200, 100, 50, 255)})
    assert background_pixels(coloured, WINDOW)[100, 100].tolist() == [50, 100, 200, 255]
