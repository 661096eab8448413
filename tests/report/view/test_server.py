"""Corrections are written at once and none is lost, and no other page can make them."""

import http.client
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
from contextlib import contextmanager
from urllib.parse import urlsplit

import pytest
import yaml

from tests.report.page.folder import make_result
from v2hdm.cli.main import run
from v2hdm.errors import MapFileError
from v2hdm.io.maps.corrections import Correction, read_corrections, write_corrections
from v2hdm.report.view.server import server_of
from v2hdm.report.view.session import file_beside


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
    assert (status, "expected one of accepted, rejected, corrected, added" in said) == (400, True)
    assert ask(address, "POST", place, sent, Origin=f"http://{parts.netloc}")[0] == 200
    assert [correction.says for correction in read_corrections(path)] == ["rejected"]


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
        assert ask(address, "POST", f"{urlsplit(address).path}correct", sent)[0] == 200
        os.kill(process.pid, signal.SIGINT)
        said, failed = process.communicate(timeout=30)
    line = f"2 corrections in {path}: map.corrections={path} in the next run\n"
    assert (process.returncode, said, failed) == (0, line, "")
    assert [correction.says for correction in read_corrections(path)] == ["accepted", "rejected"]


OUTLINE = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]


def entry_at(place, **changes):
    """A correction of a marking of its own, as the page sends it."""
    outline = [[x + 10.0 * place, y] for x, y in OUTLINE]
    return {"says": "rejected", "class": "diamond", "outline_map": outline, **changes}


def send(address, entry, key="m1", **more):
    sent = json.dumps({"key": key, "correction": entry, **more})
    return ask(address, "POST", f"{urlsplit(address).path}correct", sent)


@contextmanager
def viewed(folder, path):
    """The address of one more ``view`` of a result."""
    server, address, _ = server_of(folder, None, path)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield address
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def test_two_views_of_one_file_keep_what_both_have_said(served):
    address, folder, path = served
    with viewed(folder, path) as other:

        def say(where, number):
            assert send(where, entry_at(number))[0] == 200

        threads = [threading.Thread(target=say, args=((address, other)[n % 2], n)) for n in range(16)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        places = {round(correction.outline_map[0][0]) for correction in read_corrections(path)}
        assert places == {10 * number for number in range(16)}
    assert not list(path.parent.glob(".*.lock"))


def test_two_who_correct_the_same_marking_do_not_overwrite_each_other(served):
    address, folder, path = served
    with viewed(folder, path) as other:
        assert send(other, entry_at(0, reason="a shadow"))[0] == 200
        status, said = send(address, entry_at(0, says="accepted"))
        assert (status, "this was corrected elsewhere meanwhile; reload the page" in said) == (409, True)
        assert [correction.says for correction in read_corrections(path)] == ["rejected"]
        assert ask(address, "GET", "")[0] == 200
        assert send(address, entry_at(0, says="accepted"), before=None)[0] == 409  # from a page of before
        before = entry_at(0, reason="a shadow")
        assert send(address, entry_at(0, says="accepted"), before=before)[0] == 200
    assert [correction.says for correction in read_corrections(path)] == ["accepted"]


def test_a_file_that_a_person_edits_meanwhile_is_not_overwritten_before_the_page_shows_it(served):
    address, _, path = served
    assert send(address, entry_at(0))[0] == 200
    by_hand = yaml.safe_dump({"corrections": [entry_at(0), entry_at(3, reason="by hand")]})
    path.write_text(f"# mine\n{by_hand}")
    status, said = send(address, entry_at(5))
    assert (status, "corrections.yaml: was edited meanwhile; reload the page" in said) == (409, True)
    assert path.read_text() == f"# mine\n{by_hand}"
    ask(address, "GET", "")
    assert send(address, entry_at(5))[0] == 200
    assert [round(correction.outline_map[0][0]) for correction in read_corrections(path)] == [0, 30, 50]
    path.write_text("corrections: [")
    assert send(address, entry_at(6))[0] == 400
    assert path.read_text() == "corrections: ["
    path.unlink()
    assert send(address, entry_at(6)) == (
        409,
        f"{path}: was removed meanwhile; put it back, or start view again",
    )


def test_a_link_to_a_file_of_corrections_stays_one(tmp_path):
    make_result(tmp_path)
    (tmp_path / "real").mkdir()
    real = tmp_path / "real" / "mine.yaml"
    path = tmp_path / "link.yaml"
    path.symlink_to(real)
    with viewed(tmp_path / "result", path) as address:
        assert send(address, entry_at(0))[0] == 200
        assert send(address, entry_at(1))[0] == 200
    assert path.is_symlink()
    assert len(read_corrections(real)) == 2


HALF = "\ud800"
UNREADABLE = {
    "a lone surrogate": {"reason": HALF},
    "one in its class": {"class": HALF},
    "a huge number": {"marking": 1e308},
    "a number of many digits": {"marking": 10**100},
    "nothing that is a number": {"sigma_m": float("nan")},
    "a place beyond the earth": {"outline_map": [[1e308, 0.0]]},
    "an infinite place": {"outline_map": [[float("inf"), 0.0]]},
    "a path as a class": {"new_class": "../x"},
    "a line's end in a class": {"new_class": "a\nb"},
    "a corner of many digits": {"moved": {"9" * 9999: [0.0, 0.0]}},
    "a corner in other digits": {"moved": {"\u0663": [0.0, 0.0]}},
    "crossed corners": {"moved": {"1": OUTLINE[1], "2": OUTLINE[0]}},
    "a mapping as a reason": {"reason": {"a": 1}},
    "an endless reason": {"reason": "x" * 50_000},
}


@pytest.mark.parametrize("kind", UNREADABLE)
def test_what_the_next_run_could_not_read_is_refused_at_once(kind, served, capfd):
    address, _, path = served
    assert send(address, entry_at(0))[0] == 200
    before = path.read_bytes()
    status, said = send(address, entry_at(0) | UNREADABLE[kind])
    assert status == 400
    assert len(said) < 400
    assert path.read_bytes() == before
    assert capfd.readouterr() == ("", "")


def test_what_is_kept_is_read_again_whatever_its_letters_are(served):
    address, _, path = served
    reasons = ["\0", "\x85", "\u2028", "---\n...", "'\"{}[]: #", "\U0001f600", "\ufeff", " yes ", "\x1b[31m"]
    for number, reason in enumerate(reasons):
        status, _ = send(address, entry_at(number, reason=reason))
        assert len(read_corrections(path)) == number + 1 if status == 200 else status == 400
    assert {correction.reason for correction in read_corrections(path)} >= {"---\n...", "\U0001f600"}


def test_no_page_may_frame_ours(served):
    address, _, _ = served
    parts = urlsplit(address)
    for place in (parts.path, "/"):
        connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=10)
        connection.request("GET", place)
        answer = connection.getresponse()
        assert answer.headers["Content-Security-Policy"] == "frame-ancestors 'none'"
        assert answer.headers["X-Frame-Options"] == "DENY"
        connection.close()


def test_a_reader_who_hangs_up_and_absurd_lengths_print_nothing(served, capfd):
    address, _, path = served
    parts = urlsplit(address)
    for _ in range(4):
        with socket.create_connection((parts.hostname, parts.port)) as stream:
            stream.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            stream.sendall(f"GET {parts.path} HTTP/1.0\r\nHost: {parts.netloc}\r\n\r\n".encode())
    place = f"{parts.path}correct"
    for length in ("9" * 5000, "-1", "\u00b2", "0x10", ""):
        with socket.create_connection((parts.hostname, parts.port), timeout=10) as stream:
            head = f"POST {place} HTTP/1.0\r\nHost: {parts.netloc}\r\nContent-Length: {length}\r\n\r\n"
            stream.sendall(head.encode("latin-1"))
            assert b" 400 " in stream.recv(100)
    assert send(address, entry_at(0))[0] == 200
    assert capfd.readouterr() == ("", "")
    assert path.is_file()


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("s3://bucket/corrections.yaml", "URLs are allowed only as output="),
        ("{0}/file/below.yaml", "cannot be written (Not a directory)"),
        ("{0}/file/deep/below.yaml", "cannot be written (Not a directory)"),
        ("{0}", "is not a regular file and is not replaced"),
        ("/proc/corrections.yaml", "cannot be written"),
        ("{0}/" + "x" * 250, "cannot be written (File name too long)"),
    ],
)
def test_a_file_that_cannot_be_written_is_refused_before_the_page_is_served(place, message, tmp_path, capfd):
    make_result(tmp_path)
    (tmp_path / "file").write_text("text")
    before = sorted(tmp_path.rglob("*"))
    assert run(["view", str(tmp_path / "result"), "--corrections", place.format(tmp_path)]) == 2
    printed = capfd.readouterr()
    assert printed.out == ""
    assert message in printed.err
    assert printed.err.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_a_file_that_says_two_things_of_one_marking_is_refused(tmp_path):
    drive = make_result(tmp_path)
    path = file_beside(tmp_path / "result")
    moved = {"says": "corrected", "moved": {"1": [0.1, 0.0]}}
    for second in (entry_at(0, says="accepted"), entry_at(0, new_class="arrow"), entry_at(0, **moved)):
        path.write_text(yaml.safe_dump({"corrections": [entry_at(0), entry_at(1), second]}))
        with pytest.raises(
            MapFileError, match=r"corrections\[0\] and corrections\[2\] contradict each other"
        ):
            server_of(tmp_path / "result", drive, path)
    again = entry_at(0, reason="once more")
    path.write_text(yaml.safe_dump({"corrections": [entry_at(0), again]}))
    assert len(read_corrections(path)) == 2
