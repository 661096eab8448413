"""The page says what the folder's files say, and tells what it lacks."""

import base64
import json
import os
import re
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from matplotlib.backends.backend_svg import FigureCanvasSVG

from tests.faults.pictures import png_header
from tests.maps.gis import write_empty
from tests.report.page.folder import (
    DIAMOND_M,
    GONE,
    INFO,
    NASTY_NAME,
    PLACES,
    SHIFT_PX,
    make_result,
    make_site,
)
from v2hdm.cli.main import run
from v2hdm.errors import DriveError, MapFileError
from v2hdm.geometry.geodetic import Grid, geodetic_from_enu
from v2hdm.io.drive import ReadOptions, drive_of, read_drive, told_of
from v2hdm.io.maps.evidence import COLUMNS
from v2hdm.mapping.results import MethodResult
from v2hdm.records import DIAMOND, GeodeticOrigin, Marking
from v2hdm.report.page import document as document_module
from v2hdm.report.page import pictures, tables
from v2hdm.report.page.document import document, write_page
from v2hdm.report.page.facts import ground_residuals, read_facts
from v2hdm.report.page.layers import background_layer, ellipses, layers
from v2hdm.store.files import file_digest, write_json
from v2hdm.verdict.results.accuracy import check_goal


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return make_result(tmp_path_factory.mktemp("page"))


@pytest.fixture(scope="module")
def result(drive):
    return drive.root.parent / "result"


@pytest.fixture(scope="module")
def page(drive, result):
    return document(read_facts(result, drive))


def test_the_page_begins_with_how_good_the_map_is(page, result, drive):
    assert page.headline == "95 % of 12 markings within 2.1 cm; goal 5 cm"
    text = write_page(result, drive).read_text()
    figure, definition = (
        re.search(rf'class="{name}">([^<]*)<', text)[1].strip() for name in ("figure", "defined")
    )
    assert figure == "2.5"
    assert definition.startswith("Accuracy: 95 % of the mapped corners lie within this distance")
    assert "1 marking known less well (accuracy C) is not counted" in definition


def test_suspicious_markings_are_listed_with_their_reason_and_pictures(page):
    # A marking that is not in the map, such as one that an update of the map has dropped, has no row.
    assert page.suspicious == {"m2": ["2", "diamond", "< 0.001", "shape", "< 0.001", "0.400", "0.200", "25"]}
    assert "m2" in page.pictures


def test_an_ellipse_has_the_half_axes_and_the_direction_of_its_covariance():
    turned = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    covariance_m2 = turned @ np.diag([0.02**2, 0.01**2]) @ turned.T
    unknown = Marking(DIAMOND, DIAMOND_M, 3)
    none, half = ellipses([unknown, Marking(DIAMOND, DIAMOND_M, 3, np.kron(np.eye(4), covariance_m2))])
    assert np.isnan(none).all()
    # 5.991 is the 95 % quantile of chi-square with two degrees of freedom.
    assert half[:, :2] == pytest.approx(np.tile(np.sqrt(5.991) * np.array([0.02, 0.01]), (4, 1)), rel=1e-3)
    assert np.tan(half[:, 2]) == pytest.approx(np.full(4, np.tan(0.4)))


def test_the_stated_ellipses_hold_95_of_100_true_corners_of_right_covariances(result, drive, monkeypatch):
    from v2hdm.records import HDMap, Truth
    from v2hdm.report.page import tables

    random = np.random.default_rng(3)
    places = np.stack(np.meshgrid(np.arange(40), np.arange(25)), axis=-1).reshape(-1, 2) * 5.0
    sigma_m = 0.01
    true = [Marking(DIAMOND, DIAMOND_M + place, 3) for place in places]
    mapped = [
        replace(marking, corners_map=marking.corners_map + random.normal(0, sigma_m, (4, 2)),
                covariance_m2=sigma_m**2 * np.eye(8))
        for marking in true
    ]  # fmt: skip
    facts = replace(
        read_facts(result, drive),
        hd_map=HDMap(tuple(mapped)),
        truth=Truth(HDMap(tuple(true)), {}, np.empty((0, 4, 4)), np.empty((0, 1000)), (), {}),
    )
    table = tables.truth_table(facts)
    assert abs(int(table.rows[-1][-1]) - 95) <= 1


def test_key_figures_and_tables_state_what_the_files_do(page):
    figures = {figure.name: (figure.value, figure.unit) for figure in page.figures}
    assert figures["Markings"] == ("4", "")
    assert figures["From marking to marking"] == ("1.0", "cm")  # 2.45 x 0.004 m
    assert figures["In the map’s frame"] == ("2.5", "cm")  # 2.451 x 0.01 m
    assert figures["In the images"] == ("0.36", "px")
    assert figures["Accuracy A"] == ("3", "of 5")
    note = next(figure.note for figure in page.figures if figure.name == "Accuracy A")
    assert note == "within the accuracy goal; besides, 1 B, 1 C"
    mounting = {row[0]: row[1:] for row in page.cameras[0].mounting.rows}
    assert mounting["centre up"][:2] == ["2.000 m", "2.0 mm"]
    assert mounting["centre forward"][2] == "+100 mm"
    assert mounting["pitch, down"][:2] == ["14.324°", "0.006°"]
    assert mounting["clock, images later"][:2] == ["1.0 ms", "0.5 ms"]
    assert page.summary.startswith("4 markings, 1 lane line and 1 symbol, mapped along 3\u00a0m with 1 cam")
    assert len(page.residuals) == 4


def test_residuals_on_the_ground_lead_from_the_observation_to_the_map(result, drive):
    residuals = ground_residuals(read_facts(result, drive))
    assert residuals.residual_px == pytest.approx(np.tile(SHIFT_PX, (80, 1)), abs=1e-4)
    # Straight ahead 0.3 px to the right are depth / 500 px times as many metres to the vehicle's right.
    ahead = np.isin(residuals.marking, (1, 4)) & (residuals.corner % 2 == 0)
    depth_m = np.cos(0.25) * residuals.range_m + np.sin(0.25) * 2.0
    assert residuals.ground_m[ahead, 1] == pytest.approx(-0.3 * depth_m[ahead] / 500, rel=0.02)
    assert (residuals.ground_m[ahead, 0] > 0).all()  # 0.2 px up is farther away
    assert residuals.range_m.max() == pytest.approx(9.5, abs=0.1)


def test_pictures_stay_within_their_budget_and_the_best_of_everything_comes_first(result, drive, monkeypatch):
    facts = read_facts(result, drive)
    everything = pictures.pictures(facts, pictures.BUDGET_BYTES)
    assert {"m1", "m2", "m3", "m4", "s6", "x0"} <= everything.keys()
    total = sum(len(picture["src"]) for shots in everything.values() for picture in shots)
    monkeypatch.setattr(pictures, "_USUAL_BYTES", 1)
    fewer = pictures.pictures(facts, total // 2)
    assert sum(len(picture["src"]) for shots in fewer.values() for picture in shots) <= total // 2
    assert all(shots[0] == everything[key][0] for key, shots in fewer.items())
    assert len([key for key in fewer if key.startswith("m")]) == 4


@pytest.mark.parametrize(
    ("map_bytes", "expected"), [(100_000, 8_000_000), (10_000_000, 3_000_000), (20_000_000, 0)]
)
def test_a_large_map_leaves_less_room_for_pictures(map_bytes, expected):
    room = pictures.room_for_pictures({"markings": "m" * map_bytes})
    assert room == pytest.approx(expected, abs=100)


def test_names_end_no_script_and_become_no_markup(tmp_path):
    drive = make_result(tmp_path, kind=NASTY_NAME, status="WARN")
    text = write_page(tmp_path / "result", drive).read_text()
    assert "<img src=x" not in text
    assert text.count("</script>") == text.count("<script")
    embedded = re.search(r'id="map-data">(.*?)</script>', text, re.DOTALL)
    assert NASTY_NAME in json.loads(embedded.group(1))["kinds"]


def test_the_page_asks_for_nothing_beyond_itself(result, drive):
    text = write_page(result, drive).read_text()
    assert "default-src 'none'" in text
    outside_scripts = re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL)
    assert not re.search(r"""(?:src|href)=["'](?!data:|#)""", outside_scripts)
    assert "@import" not in outside_scripts
    assert "sourceMappingURL" not in text


def test_the_same_folder_gives_the_same_page_to_the_byte(result, drive):
    page = write_page(result, drive).read_bytes()
    assert b"1 of 5 candidates (20 %) are not in the map." in page
    assert write_page(result, drive).read_bytes() == page


def test_without_its_drive_the_page_says_what_it_lacks(result):
    page = document(read_facts(result, None))
    assert page.pictures == {}
    assert "Make the report again with --drive." in write_page(result, None).read_text()
    assert page.map_data["route"]["recorded"] == []
    assert len(page.map_data["markings"]) == 4


def test_a_result_of_an_older_version_shows_what_its_drive_cannot_tell_as_one_of_today_does(result):
    metrics = json.loads((result / "metrics.json").read_text())
    today = document(read_facts(result, None)).findings
    assert today["unobservable"]
    metrics["verdict"]["untold"] = metrics["verdict"].pop("unobservable")
    write_json(result / "metrics.json", metrics)
    assert document(read_facts(result, None)).findings == today
    assert "Unobservable in this drive" in write_page(result, None).read_text()


def test_a_run_without_a_map_has_a_page_with_its_verdict(tmp_path):
    finding = {"check": "map", "status": "FAIL", "value": None, "limit": None, "unit": "",
               "says": "this drive gave no map", "about": "map"}  # fmt: skip
    verdict = {"status": "FAIL", "findings": [finding], "unobservable": [], "passed": []}
    write_json(tmp_path / "metrics.json", {"name": "n", "verdict": verdict, "results": {}})
    text = write_page(tmp_path, None).read_text()
    assert "this drive gave no map" in text
    assert 'id="map"' not in text


def test_check_points_of_the_folder_are_told_in_centimetres_and_shown_on_the_map(tmp_path):
    drive = make_result(tmp_path)
    rows = [
        "id,x_map_m,y_map_m,marking,corner,dx_m,dy_m,distance_m,inside_95_percent,not_compared_because",
        "P1,6.5,0.0,1,1,0.0123,-0.0040,0.0129,yes,",
        "P2,30.0,0.0,,,,,,,nothing of the map is near",
    ]
    (tmp_path / "result" / "check_points.csv").write_text("\n".join(rows) + "\n")
    page = document(read_facts(tmp_path / "result", drive))
    first = dict(zip(page.check_points.headings, page.check_points.rows[0], strict=True))
    assert (first["point"], first["east (cm)"], first["north (cm)"]) == ("P1", "1.2", "−0.4")
    assert [check["off"] for check in page.map_data["checks"]] == [[0.0123, -0.004], [None, None]]


def test_what_changed_since_an_earlier_map_is_a_layer_of_the_map(page):
    moved, gone = page.map_data["changes"]
    assert (moved["fate"], moved["p"]) == ("moved", (DIAMOND_M + PLACES[0]).tolist())
    assert np.mean(moved["before"], axis=0).tolist() == pytest.approx([PLACES[0][0], PLACES[0][1] - 0.3])
    assert (gone["fate"], gone["before"], gone["p"], gone["views"]) == ("vanished", GONE, GONE, 7)


def test_coordinates_under_the_pointer_are_those_of_the_origin_to_a_millimetre(result):
    origin, facts = GeodeticOrigin(53.5, 9.9, 12.0), read_facts(result, None)
    far = Marking(DIAMOND, DIAMOND_M + np.array([4000.0, -3000.0]), 3)
    hd_map = replace(facts.hd_map, origin=origin, markings=(*facts.hd_map.markings, far))
    earth, grid = layers(replace(facts, hd_map=hd_map), None)["systems"]

    def at(system, x, y):
        x, y = x / system["scale"], y / system["scale"]
        return np.array(system["of"]) @ [x**a * y**b for a in range(4) for b in range(4 - a)]

    place = np.array([[3100.0, -1900.0, 0.0]])
    true = geodetic_from_enu(origin, place)[0, :2]
    assert at(earth, *place[0, :2]) == pytest.approx(true, abs=1e-8)  # a millimetre
    pyproj = pytest.importorskip("pyproj")
    assert grid["name"] == "EPSG:32632"
    stated = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32632").transform(*true)
    assert at(grid, *place[0, :2]) == pytest.approx(stated, abs=1e-3)


HAMBURG = GeodeticOrigin(53.5, 9.9, 12.0)


def in_grid(x, y):
    """UTM's easting and northing of a place in a map with that origin."""
    return Grid("EPSG:32632", HAMBURG).positions(np.array([[x, y, 0.0]]))[0, :2]


def write_tif(path, centre, dtype="uint8", count=3, crs="EPSG:32632"):
    """160 m of dark ground around grid coordinates, 20 cm a pixel, bright within 2 m of them."""
    rasterio = pytest.importorskip("rasterio")
    pixels = np.full((count, 800, 800), 40, dtype)
    pixels[:, 390:410, 390:410] = 250 if dtype == "uint8" else 4000
    place = rasterio.Affine(0.2, 0, centre[0] - 80, 0, -0.2, centre[1] + 80)
    look = {"width": 800, "height": 800, "count": count, "dtype": dtype, "crs": crs, "transform": place}
    with rasterio.open(path, "w", driver="GTiff", **look) as dataset:
        dataset.write(pixels)


def write_tiles(folder, centre):
    """The tiles of :func:`write_tif` in colour, as GDAL cuts them in Web Mercator at some 15 cm a pixel."""
    rasterio, warp, vrt = (pytest.importorskip(f"rasterio{part}") for part in ("", ".warp", ".vrt"))
    write_tif(folder / "aerial.tif", centre)
    zoom, half = 20, 20037508.342789244
    side = 2 * half / 2**zoom
    with rasterio.open(folder / "aerial.tif") as source:
        box = warp.transform_bounds(source.crs, "EPSG:3857", *source.bounds)
        for x in range(int((box[0] + half) // side), int((box[2] + half) // side) + 1):
            for y in range(int((half - box[3]) // side), int((half - box[1]) // side) + 1):
                place = rasterio.Affine(side / 256, 0, x * side - half, 0, -side / 256, half - y * side)
                with vrt.WarpedVRT(source, crs="EPSG:3857", transform=place, width=256, height=256) as cut:
                    path = folder / "tiles" / str(zoom) / str(x) / f"{y}.png"
                    path.parent.mkdir(parents=True, exist_ok=True)
                    cv2.imwrite(str(path), np.moveaxis(cut.read(), 0, 2))
    return folder / "tiles"


@pytest.mark.parametrize(
    ("dtype", "count"), [("uint8", 3), ("uint16", 1), ("uint8", 4), ("tiles", 3)], ids=str
)
def test_a_picture_of_the_users_own_lies_under_the_map_where_it_belongs(result, tmp_path, dtype, count):
    if dtype == "tiles":
        path = write_tiles(tmp_path, in_grid(8.0, -3.0))
    else:
        write_tif(path := tmp_path / "aerial.tif", in_grid(8.0, -3.0), dtype, count)
    facts = read_facts(result, None)
    shown = background_layer(path, replace(facts, hd_map=replace(facts.hd_map, origin=HAMBURG)))
    pixels = cv2.imdecode(np.frombuffer(base64.b64decode(shown["src"]), np.uint8), cv2.IMREAD_COLOR)
    west, south, east, north = shown["bounds"]
    row, column = np.argwhere(pixels[..., 1] > 200).mean(axis=0) + 0.5
    cell_m = (east - west) / pixels.shape[1], (north - south) / pixels.shape[0]
    assert (west + column * cell_m[0], north - row * cell_m[1]) == pytest.approx((8.0, -3.0), abs=0.05)


def test_a_picture_that_cannot_lie_under_the_map_is_refused_with_its_reason(result, tmp_path):
    write_tif(tmp_path / "aerial.tif", in_grid(0.0, 0.0))
    write_tif(tmp_path / "elsewhere.tif", in_grid(5000.0, 0.0))
    write_tif(tmp_path / "nowhere.tif", in_grid(0.0, 0.0), crs=None)
    (tmp_path / "none.tif").write_bytes(b"no picture")
    os.mkfifo(tmp_path / "pipe.tif")
    write_empty(tmp_path / "huge.tif", crs="EPSG:32632")
    facts = read_facts(result, None)
    placed = replace(facts, hd_map=replace(facts.hd_map, origin=HAMBURG))
    for name, of, reason in (
        ("elsewhere", placed, "does not cover this map"),
        ("none", placed, "not a readable GeoTIFF"),
        ("pipe", placed, "not a readable GeoTIFF or folder of XYZ tiles; check"),
        ("nowhere", placed, "no coordinate system"),
        ("aerial", facts, "no position on the earth"),
        ("huge", placed, "more pixels than its bytes could hold"),
    ):
        with pytest.raises(MapFileError, match=f"{name}.tif: .*{reason}"):
            background_layer(tmp_path / f"{name}.tif", of)


def test_no_chart_cuts_off_its_labels(drive, result, monkeypatch):
    ends = []

    def saved(canvas, *arguments, **options):
        save(canvas, *arguments, **options)
        figure = canvas.figure
        box, tight = figure.bbox_inches, figure.get_tightbbox()
        ends.append([box.x0 - tight.x0, box.y0 - tight.y0, tight.x1 - box.x1, tight.y1 - box.y1])

    save = FigureCanvasSVG.print_svg
    monkeypatch.setattr(FigureCanvasSVG, "print_svg", saved)
    document(read_facts(result, drive))
    assert len(ends) >= 6
    assert np.max(ends) < 0.02


def test_a_report_made_again_keeps_the_background_of_the_one_before(tmp_path, monkeypatch):
    make_result(tmp_path)
    shown = {"src": "UklGRg==", "type": "image/webp", "bounds": [0, 0, 1, 1]}
    monkeypatch.setattr(document_module, "background_layer", lambda *_: shown)
    monkeypatch.setattr(document_module.charts, "residual_charts", lambda *_: {})
    for background in (tmp_path / "aerial.tif", None):
        text = write_page(tmp_path / "result", None, background).read_text()
        (map_data,) = re.findall(r'id="map-data">(.*?)</script>', text)
        assert json.loads(map_data)["background"] == shown


def test_a_mosaic_of_the_folder_is_a_layer_within_its_budget(tmp_path, monkeypatch):
    from v2hdm.report.page import layers as ground

    drive = make_result(tmp_path)
    random = np.random.default_rng(0).integers(0, 255, (600, 800, 4), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "result" / "mosaic.webp"), random)
    cv2.imwrite(str(tmp_path / "result" / "mosaic_before_after.png"), random[..., :3])
    mosaic = {"image": "mosaic.webp", "bounds_m": [-1.0, -4.0, 15.0, 8.0]}
    write_json(tmp_path / "result" / "mosaic.json", mosaic)
    monkeypatch.setattr(ground, "LARGEST_BYTES", 60_000)
    page = document(read_facts(tmp_path / "result", drive))
    layer = page.map_data["mosaic"]
    assert layer["bounds"] == [-1.0, -4.0, 15.0, 8.0]
    assert len(layer["src"]) <= 60_000
    shown = cv2.imdecode(np.frombuffer(base64.b64decode(layer["src"]), np.uint8), cv2.IMREAD_UNCHANGED)
    assert shown.shape[1] / shown.shape[0] == pytest.approx(800 / 600, rel=0.02)
    assert page.ground
    (tmp_path / "result" / "mosaic.webp").unlink()
    with pytest.raises(MapFileError, match=r"mosaic\.webp: not a readable picture"):
        document(read_facts(tmp_path / "result", drive))


@pytest.mark.parametrize("name", ["mosaic.png", "mosaic_before_after.png", "overlay_front.png"])
def test_a_picture_of_the_folder_that_would_take_all_of_the_memory_is_refused(name, tmp_path):
    drive = make_result(tmp_path)
    write_json(tmp_path / "result" / "mosaic.json", {"image": "mosaic.png", "bounds_m": [-1, -4, 15, 8]})
    cv2.imwrite(str(tmp_path / "result" / "mosaic.png"), np.zeros((600, 800, 4), np.uint8))
    (tmp_path / "result" / name).write_bytes(png_header(60000, 60000))
    with pytest.raises(DriveError, match=f"{name}: image is 60000 x 60000 px, more than"):
        document(read_facts(tmp_path / "result", drive))


def test_a_map_of_thousands_is_written_in_seconds(tmp_path):
    make_site(tmp_path / "site", 3000)
    assert write_page(tmp_path / "site", None).stat().st_size < 4e6


def test_the_door_finds_the_drive_and_names_what_is_wrong(tmp_path, capsys):
    make_result(tmp_path)
    result = tmp_path / "result"
    assert run(["report", str(result)]) == 0
    assert capsys.readouterr().out.startswith(f"{result / 'report.html'}: ")
    pictures_of = re.compile(r'id="pictures">\{"m1"')
    assert pictures_of.search((result / "report.html").read_text())
    assert run(["report", str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith(f"error: {tmp_path}: has no metrics.json")
    lines = (result / "residuals.csv").read_text().splitlines()
    (result / "residuals.csv").write_text("\n".join([*lines[:3], "front/0.png,front,x"]) + "\n")
    assert run(["report", str(result)]) == 2
    assert "residuals.csv: line 4" in capsys.readouterr().err
    assert run(["report", str(result), "--drive", "nowhere"]) == 2
    assert "nowhere: no such drive folder or bag; check the path" in capsys.readouterr().err
    (result / "residuals.csv").write_text("a,b\n")
    assert run(["report", str(result)]) == 2
    assert ",".join(COLUMNS) in capsys.readouterr().err


def test_another_drive_than_that_of_the_result_is_refused(tmp_path):
    make_result(tmp_path / "a", name="one")
    make_result(tmp_path / "b", name="two")
    result = tmp_path / "a" / "result"
    with pytest.raises(DriveError, match="drive two of 5 images"):
        drive_of(result, tmp_path / "b" / "drive")
    metrics = json.loads((result / "metrics.json").read_text())
    for paths, limit in (([str(tmp_path / "gone")], None), ([], "x")):
        metrics["drive"] |= {"paths": paths, "limit": limit}
        (result / "metrics.json").write_text(json.dumps(metrics))
        if limit is None:
            assert drive_of(result, None) is None
    with pytest.raises(MapFileError, match=r"metrics\.json: its data on the drive are damaged"):
        drive_of(result, None)
    assert read_drive(tmp_path / "a" / "drive").cameras["front"].info.width == INFO.width


def test_tiles_table_and_verdict_state_the_same_radii(result, drive):
    facts = read_facts(result, drive)
    of_page = {figure.name: figure.value for figure in tables.key_figures(facts)}
    *_, last = tables.accuracy_table(facts).rows
    assert last[-2:] == [of_page["In the map’s frame"], of_page["From marking to marking"]]
    assert last[0] == "all without accuracy C"
    best = MethodResult("Opt", ("front",), facts.hd_map)
    (of_map,) = [finding for finding in check_goal(best, 0.05, "poses") if finding.about == "map"]
    in_frame, relative = last[-2:]
    assert (
        f"within {in_frame} cm in the frame of the poses, {relative} cm from marking to marking"
        in of_map.says
    )


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [(0.0004, 1, "0.0004"), (0.04, 1, "0.04"), (0.06, 1, "0.1"), (0.0, 1, "0.0"), (3e-9, None, "3e−09")],
)
def test_what_is_not_zero_never_reads_so(value, digits, text):
    assert tables.number(value, digits) == text


def digests(folder):
    return {path.name: file_digest(path) for path in folder.iterdir()}


def with_digest(result, drive):
    """Note in a result, as ``v2hdm map`` does, which images it is of."""
    metrics = json.loads((result / "metrics.json").read_text())
    metrics["drive"] |= told_of(drive, [drive.root], ReadOptions())
    (result / "metrics.json").write_text(json.dumps(metrics))


@pytest.mark.parametrize("what", ["all images", "one image", "two swapped"])
@pytest.mark.parametrize("command", ["labels", "mosaic", "report", "view"])
def test_other_images_than_those_that_were_mapped_are_refused(command, what, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    drive = make_result(tmp_path)
    result = tmp_path / "result"
    with_digest(result, drive)
    shutil.copytree(drive.root, tmp_path / "other")
    images = sorted((tmp_path / "other" / "front").glob("*.png"))
    if what == "all images":
        for image in images[1:]:
            shutil.copyfile(images[0], image)
    elif what == "one image":
        cv2.imwrite(str(images[2]), cv2.imread(str(images[2])) + 1)
    else:
        images[0].rename(tmp_path / "kept.png")
        images[1].rename(images[0])
        (tmp_path / "kept.png").rename(images[1])
    before = digests(result)
    assert run([command, str(result), "--drive", str(tmp_path / "other")]) == 2
    said = capsys.readouterr().err
    assert f"{tmp_path / 'other'}: its images are not those that the result in {result} was made of" in said
    assert said.count("\n") == 1
    assert digests(result) == before


def test_the_same_images_in_another_place_are_the_drive_of_the_result(tmp_path):
    drive = make_result(tmp_path)
    with_digest(tmp_path / "result", drive)
    shutil.move(drive.root, tmp_path / "moved")
    assert drive_of(tmp_path / "result", None) is None
    assert drive_of(tmp_path / "result", tmp_path / "moved") is not None


def test_pictures_of_a_report_stay_when_it_is_made_again_without_its_drive(tmp_path):
    drive = make_result(tmp_path)
    pictures = [
        path.read_text().split('id="pictures">')[1].split("</script>")[0]
        for path in (write_page(tmp_path / "result", drive), write_page(tmp_path / "result", None))
    ]
    assert '"m1"' in pictures[0]
    assert pictures[0] == pictures[1]
