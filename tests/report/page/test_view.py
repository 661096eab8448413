"""Corrections in the browser are written at once, beside a result that stays, and from no other page."""

import http.client
import json
import os
import signal
import subprocess
import sys
import threading
from urllib.parse import urlsplit

import pytest

from tests.report.page.browser import opened
from tests.report.page.folder import PLACES, make_result
from tests.report.page.test_browser import ON_SCREEN
from tests.report.page.test_browser import browser as browser
from v2hdm.errors import MapFileError
from v2hdm.io.maps.corrections import Correction, read_corrections, write_corrections
from v2hdm.report.page.document import write_page
from v2hdm.report.view import file_beside, server_of
from v2hdm.store.files import file_digest


@pytest.fixture
def served(tmp_path):
    """The address of a result, the result, and its file of corrections."""
    drive = make_result(tmp_path)
    folder = tmp_path / "result"
    server, address, _ = server_of(folder, drive, file_beside(folder))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield address, folder, file_beside(folder)
    server.shutdown()
    server.server_close()
    thread.join()


def digests(folder):
    return {path.name: file_digest(path) for path in folder.iterdir()}


def test_a_person_rejects_reclassifies_and_drags_and_the_result_stays(browser, served):
    address, folder, path = served
    before = digests(folder)
    with opened(browser, address) as watched:
        page = watched.page
        page.locator("#map").scroll_into_view_if_needed()

        def choose(number):
            page.mouse.click(*page.evaluate(ON_SCREEN, PLACES[number - 1].tolist()))
            page.locator(f"#details [data-key=m{number}] form.edit").wait_for()

        choose(1)
        page.fill("#edit-reason", "a manhole")
        page.get_by_role("button", name="Reject").click()
        page.locator(".said", has_text="rejected").wait_for()
        choose(2)
        page.select_option("#edit-class", "stop_line")
        page.locator(".said", has_text="corrected").wait_for()
        choose(3)
        handle = page.locator(".handle").nth(0)
        handle.hover()
        page.mouse.down()
        box = handle.bounding_box()
        page.mouse.move(box["x"] + 13 + 12, box["y"] + 13, steps=4)
        page.mouse.up()
        page.locator(".said", has_text="1 corner").wait_for()
        assert "3 corrections in result.corrections.yaml" in page.locator(".editing").inner_text()
        assert watched.said == []
        assert {url.startswith((address, "data:")) for url in watched.requests} == {True}
    rejected, classed, dragged = read_corrections(path)
    assert (rejected.says, rejected.marking, rejected.reason) == ("rejected", 1, "a manhole")
    assert (classed.marking, classed.new_kind) == (2, "stop_line")
    (corner,) = dragged.moved
    shift = dragged.moved[corner][0] - dragged.outline_map[corner - 1][0]
    assert shift == pytest.approx(12 / 64, abs=0.05)  # 64 px a metre at that zoom
    assert digests(folder) == before


def test_undoing_takes_it_out_of_the_file_and_an_earlier_file_is_gone_on_with(browser, served):
    address, _, path = served
    with opened(browser, address) as watched:
        page = watched.page
        page.locator("#map").scroll_into_view_if_needed()
        page.mouse.click(*page.evaluate(ON_SCREEN, PLACES[0].tolist()))
        page.get_by_role("button", name="Accept").click()
        page.locator(".said").wait_for()
        assert len(read_corrections(path)) == 1
        with page.expect_navigation():
            page.get_by_role("button", name="Undo").click()
        assert read_corrections(path) == []


def ask(address, method, path, body=None, **headers):
    parts = urlsplit(address)
    connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=10)
    connection.request(method, path or parts.path, body, headers)
    answer = connection.getresponse()
    said = answer.status, answer.read().decode()
    connection.close()
    return said


def test_other_pages_other_names_and_guesses_are_refused(served):
    address, _, path = served
    parts = urlsplit(address)
    outline = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
    entry = {"says": "rejected", "class": "diamond", "outline_map": outline}
    sent = json.dumps({"key": "m1", "correction": entry})
    place = f"{parts.path}correct"
    assert ask(address, "POST", place, sent, Origin="http://elsewhere.example")[0] == 404
    assert ask(address, "POST", place, sent, Host="elsewhere.example")[0] == 404
    assert ask(address, "POST", "/correct", sent)[0] == 404
    assert ask(address, "GET", "/")[0] == 404
    assert ask(address, "GET", "", Host="elsewhere.example")[0] == 404
    assert ask(address, "POST", place, "x" * 200_000) == (400, "a correction has at most 100 kB")
    assert not path.exists()
    status, said = ask(
        address, "POST", place, json.dumps({"key": "m1", "correction": entry | {"says": "no"}})
    )
    assert (status, "expected one of accepted, rejected, corrected" in said) == (400, True)
    assert ask(address, "POST", place, sent, Origin=f"http://{parts.netloc}") == (200, "kept")
    assert [one.says for one in read_corrections(path)] == ["rejected"]


def test_nobody_on_another_machine_can_ask(tmp_path):
    server, _, _ = server_of(tmp_path / "result", make_result(tmp_path), file_beside(tmp_path / "result"))
    server.server_close()
    assert server.server_address[0] == "127.0.0.1"


def test_a_file_that_is_not_ours_is_not_replaced(tmp_path):
    drive = make_result(tmp_path)
    file_beside(tmp_path / "result").write_text("shopping: [milk]\n")
    with pytest.raises(MapFileError, match="unknown key 'shopping'"):
        server_of(tmp_path / "result", drive, file_beside(tmp_path / "result"))


def test_a_signal_ends_it_in_one_line_and_what_was_said_before_is_gone_on_with(tmp_path):
    make_result(tmp_path)
    path = file_beside(tmp_path / "result")
    write_corrections([Correction(says="accepted", kind="diamond", outline_map=[[1.0, 2.0]])], "r", path)
    command = [sys.executable, "-m", "v2hdm", "view", str(tmp_path / "result")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        address = process.stdout.readline().split()[1].rstrip(";")
        entry = {"says": "rejected", "class": "diamond", "outline_map": [[3.0, 4.0]]}
        sent = json.dumps({"key": "x0", "correction": entry})
        assert ask(address, "POST", f"{urlsplit(address).path}correct", sent) == (200, "kept")
        os.kill(process.pid, signal.SIGINT)
        said, failed = process.communicate(timeout=30)
    line = f"2 corrections in {path}: map.corrections={path} in the next run\n"
    assert (process.returncode, said, failed) == (0, line, "")
    assert [one.says for one in read_corrections(path)] == ["accepted", "rejected"]


def test_pictures_of_a_report_stay_when_it_is_made_again_without_its_drive(tmp_path):
    drive = make_result(tmp_path)
    pictures = [
        path.read_text().split('id="pictures">')[1].split("</script>")[0]
        for path in (write_page(tmp_path / "result", drive), write_page(tmp_path / "result", None))
    ]
    assert '"m1"' in pictures[0]
    assert pictures[0] == pictures[1]
