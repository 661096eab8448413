"""Questions on lanes are answered in the page, directions are stated by hand, and no answer is lost."""

import http.client
import json
from urllib.parse import urlsplit

import numpy as np
import pytest

from examples.lanes.site import main as write_site
from examples.lanes.site import trajectory
from tests.report.page.browser import opened
from tests.report.page.folder import make_result, small_map, verdict
from tests.report.page.test_browser import browser as browser
from tests.report.view.conftest import serving
from tests.report.view.test_editor import ON_SCREEN, press, ready, saved
from v2hdm.io.maps.corrections import Correction, read_corrections, write_corrections
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.maps.questions import read_answers
from v2hdm.io.maps.reading import read_geojson
from v2hdm.io.trajectory import read_tum, write_tum
from v2hdm.records import HDMap, Lane
from v2hdm.store.files import write_json
from v2hdm.topology.build import lane_graph

X = np.linspace(0.0, 60.0, 121)
LINES = {-1.75: "lane_line", 1.75: "lane_dash", 5.25: "lane_line"}


@pytest.fixture
def street(tmp_path):
    """A street of two lanes, of which a drive went eastwards along the southern one, and its corrections."""
    drive = make_result(tmp_path)
    folder = tmp_path / "result"
    lanes = tuple(Lane(kind, np.column_stack([X, np.full(len(X), y)]), 3) for y, kind in LINES.items())
    write_geojson(HDMap(small_map().markings, lanes), folder / "map.geojson")
    write_tum(trajectory([(0, 0), (60, 0)], np.random.default_rng(0)), folder / "trajectory_east.tum")
    with serving(folder, drive) as result:
        yield result


@pytest.fixture
def crossing(tmp_path):
    """The made site of a crossing and a T, and its corrections."""
    folder = tmp_path / "site"
    write_site(folder)
    write_json(folder / "metrics.json", {"name": "site", "version": "1", "verdict": verdict(), "results": {}})
    with serving(folder, None) as result:
        yield result


def ask(address, method, name, content=None):
    parts = urlsplit(address)
    connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=20)
    connection.request(method, f"{parts.path}{name}", None if content is None else json.dumps(content))
    answer = connection.getresponse()
    said = answer.status, answer.read().decode()
    connection.close()
    return said


def test_questions_are_answered_by_keys_alone_and_are_in_the_file(browser, street):
    address, _, path = street
    with opened(browser, address) as watched:
        page = watched.page
        ready(page)
        page.locator("#questions-title", has_text="(3 open)").wait_for()
        press(page, "q")
        page.locator("#selected h2", has_text="Question, direction").wait_for()
        press(page, "2")
        saved(page, 1)
        page.locator("#questions-title", has_text="(2 open)").wait_for()
        press(page, "q")
        page.locator("#selected h2", has_text="Question, speed").wait_for()
        press(page, "c")
        page.keyboard.type("30")
        press(page, "Enter")
        saved(page, 2)
        assert page.evaluate("document.activeElement.id") != "answer"  # the next key is the map's
        assert watched.said == []
    direction, speed = read_corrections(path)
    assert (direction.says, direction.kind, direction.answer) == ("answered", "direction", "against")
    assert (speed.kind, speed.answer, len(speed.outline_map)) == ("speed", "30", 1)
    assert [answer.subject for answer in read_answers(path, None)] == ["direction", "speed"]


def test_who_gives_way_is_answered_by_keys_and_is_a_rule_of_the_next_lanes(browser, crossing):
    address, folder, path = crossing
    with opened(browser, address) as watched:
        page = watched.page
        ready(page)
        page.locator("#questions-title", has_text="(13 open)").wait_for()
        for number in range(1, 5):  # the four arms of the crossing; the other questions stay open
            for _ in range(13):
                if "Question, right of way" in page.locator("#selected h2").all_inner_texts():
                    break
                press(page, "q")
            press(page, "1" if number == 1 else "2")
            saved(page, number)
            page.locator("#questions-title", has_text=f"({13 - number} open)").wait_for()
            press(page, "q")
        assert watched.said == []
    answers = read_answers(path, None)
    assert [answer.answer for answer in answers] == ["yes", "no", "no", "no"]
    hd_map = read_geojson(folder / "map.geojson")
    graph = lane_graph(hd_map, [read_tum(file) for file in sorted(folder.glob("*.tum"))], answers)
    (right,) = graph.stated_rights
    assert len(right.yields_to) > 1


def test_a_lane_gets_its_direction_by_hand_and_what_is_stated_can_be_undone(browser, street):
    address, _, path = street
    with opened(browser, address) as watched:
        page = watched.page
        ready(page)
        page.locator("#questions-title", has_text="(3 open)").wait_for()
        page.mouse.click(*page.evaluate(ON_SCREEN, [40.0, 3.5]))
        page.locator("#selected h2", has_text="Lane, direction open").wait_for()
        before = page.evaluate("window.v2hdmView.selected().places")
        page.locator("#selected").get_by_role("button", name="against").click()
        saved(page, 1)
        page.locator("#selected h2", has_text="Lane, direction stated").wait_for()
        after = page.evaluate("window.v2hdmView.selected().places")
        assert after == before[::-1]
        press(page, "z")
        saved(page, 0)
        page.locator("#selected h2", has_text="Lane, direction open").wait_for()
        assert read_corrections(path) == []
        assert watched.said == []


def test_a_direction_against_a_drive_is_refused_at_once_and_nothing_is_lost(browser, street):
    address, _, path = street
    with opened(browser, address) as watched:
        page = watched.page
        ready(page)
        page.locator("#questions-title", has_text="(3 open)").wait_for()
        press(page, "q 1")
        saved(page, 1)
        page.mouse.click(*page.evaluate(ON_SCREEN, [40.0, 0.0]))
        page.locator("#selected h2", has_text="Lane, driven").wait_for()
        press(page, "2")
        page.locator("#saved.problem", has_text="a drive went the other way along the lane").wait_for()
        assert [correction.answer for correction in read_corrections(path)] == ["along"]
        press(page, "3")
        saved(page, 2)


def test_a_line_that_is_drawn_makes_a_lane_that_is_asked_about(browser, street):
    address, _, _ = street
    with opened(browser, address) as watched:
        page = watched.page
        ready(page)
        page.locator("#questions-title", has_text="(3 open)").wait_for()
        assert page.evaluate("window.v2hdmView.lanes.lanes.length") == 2
        page.evaluate("Object.assign(window.v2hdmView.view, { east: 30, north: 6, scale: 12 })")
        page.evaluate("window.v2hdmView.drawing.change()")
        box = page.locator("#map").bounding_box()
        middle = np.array([box["x"] + box["width"] / 2, box["y"] + box["height"] / 2])
        page.locator("#map").focus()
        page.keyboard.press("l")
        for east, north in ((2.0, 8.75), (30.0, 8.75), (58.0, 8.75)):
            page.mouse.click(*(middle + 12 * np.array([east - 30, 6 - north])))
        page.keyboard.press("l")
        saved(page, 1)
        page.locator("#questions-title", has_text="(4 open)").wait_for()
        assert page.evaluate("window.v2hdmView.lanes.lanes.length") == 3


def test_an_answer_that_no_lane_follows_is_refused_and_one_in_the_file_is_told(street):
    address, folder, path = street
    places = [[9.0, 90.0], [12.0, 90.0]]
    nowhere = {"says": "answered", "subject": "direction", "answer": "along", "places_map": places}
    status, text = ask(address, "POST", "correct", {"key": "x", "correction": nowhere})
    assert status == 400
    assert "no lane lies at (9.0, 90.0)" in text
    assert not path.exists()
    stated = Correction(says="answered", kind="direction", outline_map=places, answer="along")
    write_corrections([stated], str(folder), path)
    ask(address, "GET", "state.json")
    lanes = json.loads(ask(address, "GET", "lanes.json")[1])
    assert "no lane lies at" in lanes["refused"][0]
    assert len(lanes["lanes"]) == 2
