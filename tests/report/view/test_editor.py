"""The editor in the browser: mouse or keyboard alone suffice, and what was corrected is in the file."""

import re

import numpy as np
import pytest

from tests.report.page.browser import opened
from tests.report.page.folder import DIAMOND_M, PLACES
from tests.report.page.test_browser import browser as browser
from v2hdm.io.maps.corrections import Correction, read_corrections, write_corrections
from v2hdm.store.files import file_digest

ON_SCREEN = """([east, north]) => {
    const { view, drawing } = window.v2hdmView;
    Object.assign(view, { east, north, scale: 90 });
    drawing.change();
    const box = document.getElementById("map").getBoundingClientRect();
    return [box.left + view.width / 2, box.top + view.height / 2];
}"""
HANDLES = """async () => {
    const { handlesOf } = await import("./drawing.js");
    const { selected, view } = window.v2hdmView;
    const box = document.getElementById("map").getBoundingClientRect();
    return handlesOf(selected(), view).map(({ at }) => [box.left + at[0], box.top + at[1]]);
}"""


def ready(page):
    page.wait_for_selector("html[data-ready]")
    page.locator("#map").focus()


def saved(page, count):
    page.locator("#saved", has_text=re.compile(rf"^{count} corrections? in .*, all saved$")).wait_for()


def press(page, keys):
    for key in keys.split():
        page.keyboard.press(key)


def digests(folder):
    return {path.name: file_digest(path) for path in folder.iterdir()}


def test_a_person_deletes_reclassifies_and_drags_and_the_result_stays(browser, served):
    address, folder, path = served
    before = digests(folder)
    with opened(browser, address) as watched:
        page = watched.page
        ready(page)

        def choose(number):
            page.mouse.click(*page.evaluate(ON_SCREEN, PLACES[number - 1].tolist()))
            page.locator("#selected h2", has_text=f"Marking {number},").wait_for()

        choose(1)
        page.fill("#edit-reason", "a manhole")
        page.locator("#selected").get_by_role("button", name="Delete").click()
        saved(page, 1)
        choose(2)
        page.select_option("#edit-class", "stop_line")
        saved(page, 2)
        choose(3)
        left, top = page.evaluate(HANDLES)[0]
        page.mouse.move(left, top)
        page.mouse.down()
        page.mouse.move(left + 9, top, steps=4)
        page.mouse.up()
        page.locator(".said", has_text="1 corner moved").wait_for()
        saved(page, 3)
        assert watched.said == []
        assert {url.startswith((address, "data:")) for url in watched.requests} == {True}
    rejected, classed, dragged = read_corrections(path)
    assert (rejected.says, rejected.marking, rejected.reason) == ("rejected", 1, "a manhole")
    assert (classed.marking, classed.new_kind) == (2, "stop_line")
    (corner,) = dragged.moved
    shift = np.array(dragged.moved[corner]) - dragged.outline_map[corner - 1]
    assert shift == pytest.approx([9 / 90, 0.0], abs=2e-3)
    assert digests(folder) == before


def test_ten_corrections_are_made_by_the_keyboard_alone(browser, served):
    address, _, path = served
    with opened(browser, address) as watched:
        page = watched.page
        ready(page)
        press(page, "n Shift+ArrowRight ArrowUp")  # 1: the most suspicious marking, moved
        page.wait_for_timeout(450)
        press(page, "r r")  # 2: and turned
        page.wait_for_timeout(450)
        press(page, "1 Shift+ArrowUp")  # 3: one corner
        saved(page, 1)
        press(page, "c")
        page.keyboard.type("stop")  # 4: its class
        press(page, "Escape")
        press(page, "q a")  # 5: the first question, accepted
        saved(page, 2)
        press(page, "n n Delete")  # 6: the least accurate one, deleted
        saved(page, 3)
        press(page, "Escape i Enter")  # 7: a new one at the crosshair
        saved(page, 4)
        press(page, "Shift+ArrowDown Shift+ArrowDown")  # 8: moved
        page.wait_for_timeout(450)
        press(page, "Shift+R")  # 9: turned
        page.wait_for_timeout(450)
        press(page, "i Enter Delete")  # 10: another one, and away with it
        saved(page, 4)
        press(page, "z z")  # undone: it is neither there nor was it
        saved(page, 4)
        assert watched.said == []
    corrected, accepted, rejected, added = read_corrections(path)
    assert (corrected.marking, corrected.new_kind, len(corrected.moved)) == (2, "stop_line", 4)
    assert (accepted.says, len(accepted.outline_map)) == ("accepted", 1)
    assert (rejected.says, rejected.marking) == ("rejected", 4)
    assert (added.says, added.kind) == ("added", "stop_line")  # as the nearest that is left
    sides = [np.ptp(np.array(outline), axis=0) for outline in (added.outline_map, DIAMOND_M)]
    assert sides[0] == pytest.approx(sides[1], abs=0.02)


def test_what_is_undone_is_out_of_the_file_and_in_it_again_when_done_again(browser, served):
    address, _, path = served
    with opened(browser, address) as watched:
        page = watched.page
        ready(page)
        press(page, "n a")
        saved(page, 1)
        press(page, "n Delete")
        saved(page, 2)
        press(page, "Control+z Control+z")
        saved(page, 0)
        assert read_corrections(path) == []
        press(page, "Control+y")
        saved(page, 1)
        assert [correction.says for correction in read_corrections(path)] == ["accepted"]
        assert watched.said == []


def test_what_another_editor_corrects_is_shown_and_neither_loses_anything(browser, served):
    address, _, path = served
    with opened(browser, address) as first, opened(browser, address) as other:
        for watched in (first, other):
            ready(watched.page)
        press(first.page, "n Delete")
        saved(first.page, 1)
        other.page.evaluate("window.v2hdmView.edits.look(true)")
        saved(other.page, 1)
        press(other.page, "q a")
        saved(other.page, 2)
        # The same marking, before the other's page has shown it.
        first.page.evaluate("window.v2hdmView.edits.look = async () => undefined")
        press(other.page, "n n Delete")
        saved(other.page, 3)
        press(first.page, "n a")
        first.page.locator("#saved.problem", has_text="corrected elsewhere meanwhile").wait_for()
        assert [correction.says for correction in read_corrections(path)] == [
            "rejected",
            "accepted",
            "rejected",
        ]


def test_a_file_that_a_person_edits_is_shown_in_the_page(browser, served):
    address, folder, path = served
    with opened(browser, address) as watched:
        page = watched.page
        ready(page)
        outline = (DIAMOND_M + PLACES[0] + [0.0, 3.0]).tolist()
        write_corrections([Correction(says="added", kind="diamond", outline_map=outline)], str(folder), path)
        saved(page, 1)
        assert "Added, diamond: added" in page.locator("#made").inner_text()
        path.write_text("corrections: [")
        page.locator("#saved.problem", has_text="corrections.yaml").wait_for()
        press(page, "n a")
        page.wait_for_timeout(300)
        assert path.read_text() == "corrections: ["


def test_handles_do_not_overlap_whatever_the_marking_is(browser, served):
    address, _, path = served
    shapes = {"dash": (2.0, 0.12), "dot": (0.02, 0.02), "square": (1.0, 1.0), "line": (8.0, 0.1)}
    added = []
    for number, (length, width) in enumerate(shapes.values()):
        corners = np.array([[-length, -width], [length, -width], [length, width], [-length, width]]) / 2
        added.append(
            Correction(
                says="added", kind="diamond", outline_map=(corners + np.array([0, 6 + 3 * number])).tolist()
            )
        )
    write_corrections(added, "result", path)
    with opened(browser, address) as watched:
        page = watched.page
        ready(page)
        for number in range(len(shapes)):
            page.locator("#made button").nth(number).click()
            for scale in (8, 60, 400):
                page.evaluate(f"window.v2hdmView.view.scale = {scale}")
                handles = np.array(page.evaluate(HANDLES))
                away_px = np.linalg.norm(handles[:, None] - handles, axis=2) + 1e3 * np.eye(5)
                assert away_px.min() >= 22, (list(shapes)[-1 - number], scale)


def test_the_tooltip_lies_beside_what_it_is_about(browser, served):
    address, _, _ = served
    with opened(browser, address) as watched:
        page = watched.page
        ready(page)
        left, top = page.evaluate(ON_SCREEN, PLACES[0].tolist())
        page.mouse.move(left, top)
        page.locator("#tip", has_text="Marking 1, diamond").wait_for()
        tip = page.locator("#tip").bounding_box()
        assert tip["x"] >= left + 0.5 * 90 or tip["x"] + tip["width"] <= left - 0.5 * 90


def test_a_link_leads_to_its_marking(browser, served):
    address, _, _ = served
    with opened(browser, f"{address}#m3") as watched:
        ready(watched.page)
        assert watched.page.locator("#selected h2").inner_text() == "Marking 3, diamond"
        press(watched.page, "n")
        assert watched.page.url == f"{address}#m2"


def test_a_distance_is_measured(browser, served):
    address, _, _ = served
    with opened(browser, address) as watched:
        page = watched.page
        ready(page)
        left, top = page.evaluate(ON_SCREEN, [6.0, 3.5])
        page.keyboard.press("m")
        page.mouse.click(left, top)
        page.mouse.click(left + 180, top)
        # The text follows the pointer, frame by frame: before the second click is drawn it is another length.
        length = page.locator("#told", has_text="Measured: 2.00 m")
        length.wait_for()
        assert length.inner_text().startswith("Measured: 2.00 m")


def test_a_lane_line_is_drawn_split_joined_and_deleted_by_keys(browser, served):
    address, _, path = served
    with opened(browser, address) as watched:
        page = watched.page
        ready(page)
        press(page, "ArrowDown l Enter ArrowRight Enter ArrowRight ArrowUp Enter l")
        page.locator("#selected h2", has_text="Drawn lane line").wait_for()
        saved(page, 1)
        (drawn,) = read_corrections(path)
        assert (drawn.says, drawn.is_line, drawn.kind, len(drawn.outline_map)) == (
            "added",
            True,
            "lane_line",
            3,
        )
        press(page, "Delete")
        saved(page, 0)
        page.mouse.click(*page.evaluate(ON_SCREEN, [5.0, 2.4]))  # the lane line of the map
        page.locator("#selected h2", has_text="Lane line").wait_for()
        press(page, "s")
        saved(page, 3)
        cut, first, second = read_corrections(path)
        assert [cut.says, first.says, second.says] == ["rejected", "added", "added"]
        assert first.outline_map[-1] == pytest.approx([5.0, 2.4], abs=0.02)
        assert second.outline_map[0] == first.outline_map[-1]
        press(page, "j")
        saved(page, 2)
        _, joined = read_corrections(path)
        assert [joined.outline_map[0], joined.outline_map[-1]] == [[0.0, 2.4], [12.0, 2.4]]
        press(page, "z z")
        saved(page, 0)
        assert read_corrections(path) == []
        assert watched.said == []


def test_a_lane_line_that_crosses_itself_is_refused_at_once_and_is_not_lost(browser, served):
    address, _, path = served
    with opened(browser, address) as watched:
        page = watched.page
        ready(page)
        left, top = page.evaluate(ON_SCREEN, [6.0, 4.5])
        page.keyboard.press("l")
        for across, down in ((0, 0), (200, 0), (200, 100), (100, -80)):
            page.mouse.click(left + across, top + down)
        page.keyboard.press("l")
        page.locator("#told", has_text="crosses itself").wait_for()
        assert not path.exists()
        press(page, "Backspace l")
        saved(page, 1)
        assert len(read_corrections(path)[0].outline_map) == 3


def test_each_image_of_a_marking_is_shown_with_its_outline_as_it_is_now(browser, served):
    address, _, _ = served
    with opened(browser, f"{address}#m1") as watched:
        page = watched.page
        ready(page)
        page.locator("#shots figure").nth(3).wait_for()
        assert "4 images, the nearest first" in page.locator("#shots").inner_text()
        outline = page.locator("#shots .mapped").first
        before = outline.get_attribute("points")
        assert page.locator("#shots figure").first.locator(".seen").count() == 4
        press(page, "Shift+ArrowRight")
        page.wait_for_timeout(300)
        page.locator("#shots figure").nth(3).wait_for()
        assert outline.get_attribute("points") != before
        assert watched.said == []
