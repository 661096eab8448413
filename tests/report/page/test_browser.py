"""The report in a browser: it draws, answers the pointer, and asks for nothing beyond itself."""

import time
from dataclasses import replace

import numpy as np
import pytest

from tests.report.page.browser import browser_path, opened
from tests.report.page.folder import NASTY, NASTY_NAME, PLACES, make_result, make_site
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.maps.reading import read_geojson
from v2hdm.records import Reading, Symbol
from v2hdm.report.page.document import write_page

WINDOWS = [(1280, 800, "light"), (1280, 800, "dark"), (390, 844, "light"), (390, 844, "dark")]

ON_SCREEN = """([east, north]) => {
    const { map } = window.v2hdmMap;
    map.setView([north, east], 6, { animate: false });
    const box = map.getContainer().getBoundingClientRect();
    const point = map.latLngToContainerPoint([north, east]);
    return [box.left + point.x, box.top + point.y];
}"""
PAINTED = """() => [...document.querySelectorAll("#map canvas")].map((canvas) => {
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    let painted = 0;
    for (let n = 3; n < data.length; n += 4) painted += data[n] > 0;
    return painted;
}).reduce((sum, painted) => sum + painted, 0)"""


LONGEST_S = 30.0


def wait_until_painted(page, least):
    """Wait until the map shows more than ``least`` pixels.

    Playwright's own wait evaluates text from its second look on, which the page's security policy forbids.
    """
    end_s = time.monotonic() + LONGEST_S
    while page.evaluate(PAINTED) <= least:
        assert time.monotonic() < end_s
        page.wait_for_timeout(20)


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    drive = make_result(folder)
    return write_page(folder / "result", drive)


@pytest.fixture(scope="module")
def browser():
    path = browser_path()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield launched
        launched.close()


def is_quiet(watched):
    """No error on the console, no request but that for the page itself."""
    assert watched.said == []
    assert [url for url in watched.requests if not url.startswith(("file:", "data:"))] == []
    assert len([url for url in watched.requests if url.startswith("file:")]) == 1


@pytest.mark.parametrize(("width", "height", "scheme"), WINDOWS)
def test_the_map_is_drawn_and_fits_its_window(browser, report, width, height, scheme):
    with opened(browser, report, width, height, scheme) as watched:
        page = watched.page
        wait_until_painted(page, 300)  # the map is drawn a frame after the page has loaded
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        paper = page.evaluate("getComputedStyle(document.body).backgroundColor")
        assert (paper == "rgb(255, 255, 255)") == (scheme == "light")
        is_quiet(watched)


RIGHT_ENDS = """() => {
    for (const one of document.querySelectorAll("details")) one.open = true;
    return [...document.querySelectorAll(".findings td:last-child, .chart svg")]
        .map((one) => one.getBoundingClientRect().right);
}"""


def test_a_phone_shows_findings_and_charts_to_their_right_ends(browser, report):
    with opened(browser, report, 390, 844) as watched:
        ends = watched.page.evaluate(RIGHT_ENDS)
        assert len(ends) > 5
        assert max(ends) <= 390


def test_every_layer_changes_the_picture_when_it_is_switched(browser, report):
    with opened(browser, report) as watched:
        page = watched.page
        page.evaluate(ON_SCREEN, PLACES[0].tolist())
        boxes = page.locator("#layers input")
        assert boxes.count() == 7  # no truth, no mosaic
        for number in range(boxes.count()):
            if not boxes.nth(number).is_checked():
                boxes.nth(number).check()
        page.wait_for_timeout(100)
        for number in range(boxes.count()):
            wait_until_painted(page, 0)
            before = page.evaluate(PAINTED)
            boxes.nth(number).uncheck()
            page.wait_for_timeout(100)
            assert page.evaluate(PAINTED) < before, boxes.nth(number).get_attribute("id")
        is_quiet(watched)


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (390, 844)])
def test_pointing_names_the_marking_and_selecting_shows_its_images(browser, report, width, height):
    with opened(browser, report, width, height) as watched:
        page = watched.page
        assert page.locator("#suspicious .shots figure").count() == 1
        page.locator("#map").scroll_into_view_if_needed()
        for number, place in enumerate(PLACES, start=1):
            page.mouse.move(*page.evaluate(ON_SCREEN, place.tolist()))
            page.wait_for_timeout(100)
            tooltip = page.locator(".leaflet-tooltip:not(.corner)")
            assert tooltip.locator("b").inner_text() == f"Marking {number}, diamond"
            text = tooltip.inner_text()
            assert "sightings: 4 images" in text
            assert f"accuracy: {'AABC'[number - 1]}" in text
            assert "95 % radius from marking to marking: 1.0 cm" in text
            assert "95 % radius in the map’s frame: 2.5 cm (worst corner)" in text
            assert f"1: {place[0] + 0.5:.3f} E" in text
            page.mouse.down()
            page.mouse.up()
            assert page.locator(f"#details [data-key=m{number}]").count() == 1
            shots = page.locator("#details .shots figure")
            assert shots.count() == 2
            assert "front/" in shots.first.inner_text()
            size = page.evaluate("document.querySelector('#details .shots image').getBBox().width")
            assert size > 30
        is_quiet(watched)


def test_the_outline_lies_on_the_paint_of_its_picture(browser, report):
    with opened(browser, report) as watched:
        page = watched.page
        shots = page.evaluate("JSON.parse(document.getElementById('pictures').textContent).m1")
        brightness = page.evaluate(
            """async ({ src, size, map }) => {
                const image = new Image();
                image.src = `data:image/jpeg;base64,${src}`;
                await image.decode();
                const canvas = document.createElement("canvas");
                [canvas.width, canvas.height] = size;
                const draw = canvas.getContext("2d");
                draw.drawImage(image, 0, 0);
                const at = ([u, v]) => draw.getImageData(Math.floor(u), Math.floor(v), 1, 1).data[0];
                const [u, v] = [0, 1].map((a) => map.reduce((sum, point) => sum + point[a], 0) / map.length);
                const out = map.map((point) => at([u + 1.25 * (point[0] - u), v + 1.25 * (point[1] - v)]));
                const inside = map.map((point) => at([u + 0.7 * (point[0] - u), v + 0.7 * (point[1] - v)]));
                return { out, inside };
            }""",
            shots[0],
        )
        assert min(brightness["inside"]) > 180
        assert max(brightness["out"]) < 140
        outline_px, mapped = np.array(shots[0]["seen"]), np.array(shots[0]["map"])
        assert np.abs(np.sort(outline_px[:, 0]) - np.sort(mapped[:, 0])).max() < 1.0


def test_what_was_left_out_tells_its_reason_and_a_number_finds_its_marking(browser, report):
    with opened(browser, report) as watched:
        page = watched.page
        page.locator("#map").scroll_into_view_if_needed()
        page.mouse.move(*page.evaluate(ON_SCREEN, [8.0, 2.0]))
        page.wait_for_timeout(100)
        tooltip = page.locator(".leaflet-tooltip:not(.corner)")
        assert f"reason: its place is unsure {NASTY}" in tooltip.inner_text()
        page.mouse.move(*page.evaluate(ON_SCREEN, [4.5, 1.2]))  # what is gone since an earlier map
        page.wait_for_timeout(400)  # the tooltip before it fades
        assert "vanished: with probability 0.990; seen in 0 of 7 images" in tooltip.inner_text()
        page.fill("#find-id", "1")
        page.click("#find button")
        assert "30.0 cm ± 1.0 cm" in page.locator("#details dl").inner_text()
        page.fill("#find-id", "3")
        page.click("#find button")
        assert page.locator("#details h3").inner_text() == "Marking 3, diamond"
        page.fill("#find-id", "77")
        page.click("#find button")
        assert page.locator("#details h3").inner_text() == "Marking 3, diamond"
        is_quiet(watched)


def test_names_of_people_are_text_and_never_markup(browser, tmp_path):
    drive = make_result(tmp_path, name=NASTY_NAME, kind=NASTY_NAME, status="FAIL")
    path = write_page(tmp_path / "result", drive)
    with opened(browser, path) as watched:
        page = watched.page
        assert page.locator("h1").inner_text() == NASTY_NAME
        assert NASTY in page.locator(".findings").first.inner_text()
        page.locator("#map").scroll_into_view_if_needed()
        page.mouse.move(*page.evaluate(ON_SCREEN, PLACES[1].tolist()))
        page.wait_for_timeout(100)
        assert NASTY_NAME in page.locator(".leaflet-tooltip:not(.corner)").inner_text()
        assert page.locator("img[onerror]").count() == 0
        is_quiet(watched)


def test_colours_by_accuracy_have_a_scale_in_centimetres(browser, report):
    with opened(browser, report) as watched:
        page = watched.page
        page.select_option("#colour", "absolute")
        assert page.locator("#legend .ends").inner_text().startswith("2.5 cm")
        is_quiet(watched)


def test_the_table_is_sorted_searched_and_leads_to_the_map(browser, report):
    with opened(browser, report) as watched:
        page = watched.page

        def rows():
            return page.locator("#list tbody th").all_inner_texts()

        assert rows() == ["1", "2", "3", "4", "6"]
        page.locator("#list thead button").first.click()
        assert rows() == ["6", "4", "3", "2", "1"]
        page.fill("#search", "diamond")
        assert rows() == ["4", "3", "2", "1"]
        assert page.locator("#listed").inner_text() == "4 of 5"
        page.locator("#list tbody button").first.click()
        assert page.locator("#details h3").inner_text() == "Marking 4, diamond"
        with page.expect_download() as download:
            page.click("#save")
        lines = download.value.path().read_text().splitlines()
        assert lines[0].startswith('"marking","class","sightings","accuracy"')
        assert [line.split(",")[3] for line in lines[1:]] == ['"C"', '"B"', '"A"', '"A"']
        assert lines[0].split(",")[4:6] == ['"east (m)"', '"north (m)"']
        assert lines[1].split(",")[4:6] == ["9.000", "0.000"]  # the fourth marking's centre, to a millimetre
        assert len(lines) == 5
        assert page.locator("#files a").first.get_attribute("href") == "calibration_front.yaml"
        assert watched.said == []


def test_a_word_is_labelled_found_and_searched_by_what_it_says_or_may_say(browser, tmp_path):
    drive = make_result(tmp_path)
    path = tmp_path / "result" / "map.geojson"
    hd_map = read_geojson(path)
    word = Symbol("text", np.array([[6.0, 2.0], [6.0, 1.0], [7.0, 1.0], [7.0, 2.0]])[::-1], 5, id=70)
    said = replace(word, reading=Reading("EBH", 0.9, NASTY, 0.07))
    write_geojson(replace(hd_map, symbols=(*hd_map.symbols, said)), path)
    with opened(browser, write_page(tmp_path / "result", drive)) as watched:
        page = watched.page
        page.fill("#find-id", "ebh")
        page.press("#find-id", "Enter")
        assert page.locator("#details h3").inner_text() == "Symbol 70, text \u201cEBH\u201d"
        assert "EBH, with probability 0.90" in page.locator("#details").inner_text()
        assert NASTY in page.locator("#details").inner_text()
        page.locator(".leaflet-tooltip.corner").first.wait_for()
        assert "EBH" in page.locator(".leaflet-tooltip.corner").all_inner_texts()
        page.fill("#search", "ebh")
        assert page.locator("#list tbody th").all_inner_texts() == ["70"]
        assert "EBH" in page.locator("#list tbody tr").inner_text()
        page.fill("#find-id", "no such")
        page.press("#find-id", "Enter")
        assert page.evaluate("document.getElementById('find-id').validationMessage").startswith("No marking")
        is_quiet(watched)


THOUSANDS = 3200


@pytest.fixture(scope="module")
def large(tmp_path_factory):
    """The report of a site of thousands of markings in rows 4.5 m apart."""
    site = tmp_path_factory.mktemp("large") / "site"
    make_site(site, THOUSANDS)
    return write_page(site, None)


def test_thousands_of_markings_take_a_kilobyte_each_and_no_element_each(browser, large):
    assert large.stat().st_size < 1000 * THOUSANDS
    with opened(browser, large) as watched:
        assert watched.page.evaluate("document.querySelectorAll('*').length") < THOUSANDS
        is_quiet(watched)


def test_a_site_seen_from_afar_is_dots_that_are_named_and_selected(browser, large):
    with opened(browser, large) as watched:
        page = watched.page
        page.locator("#map").scroll_into_view_if_needed()
        wait_until_painted(page, THOUSANDS)
        place = page.evaluate(
            """() => {
                const { map, things } = window.v2hdmMap;
                const [x, y] = [0, 1].map((n) => things[77].points.reduce((sum, p) => sum + p[n], 0) / 4);
                const box = map.getContainer().getBoundingClientRect();
                const point = map.latLngToContainerPoint([y, x]);
                return [box.left + point.x, box.top + point.y];
            }"""
        )
        page.mouse.move(*place)
        named = page.locator(".leaflet-tooltip:not(.corner) b").inner_text()
        number = int(named.split()[1].rstrip(","))
        assert abs(number - 78) in (0, 1, round(THOUSANDS**0.5), round(THOUSANDS**0.5) + 1)
        page.mouse.down()
        page.mouse.up()
        assert page.locator("#details h3").inner_text() == named
        is_quiet(watched)


def test_a_panned_map_is_drawn_where_it_was_not_before(browser, large):
    with opened(browser, large) as watched:
        page = watched.page
        page.evaluate("window.v2hdmMap.map.setView([20, 20], 5, { animate: false })")
        for _ in range(4):
            page.evaluate("window.v2hdmMap.map.panBy([600, 0], { animate: false })")
        wait_until_painted(page, 5000)
        assert "drawn" in page.locator("#map").get_attribute("data-detail")
        is_quiet(watched)
