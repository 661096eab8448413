"""How progress is told."""

import io

from rich.console import Console

from train.bar import share_of_work
from v2hdm.progress import progress_lines


def test_a_log_has_a_line_when_a_task_begins_and_ends():
    lines: list[str] = []
    tell = progress_lines(lines.append)
    for count in range(101):
        tell("detect", count, 100)
    tell("map", 0, 3)
    assert lines == ["detect: 0 of 100", "detect: 100 of 100", "map: 0 of 3"]


def test_a_share_of_work_is_told_in_lines_where_there_is_no_terminal():
    log = io.StringIO()
    with share_of_work(Console(file=log), "reading") as tell:
        for step in range(100):
            tell(step / 100, f"step [{step}]")
        tell(1.0, "done")
    assert log.getvalue().splitlines() == ["  0%  step [0]", "100%  done"]


def test_a_terminal_shows_a_bar():
    screen = io.StringIO()
    with share_of_work(Console(file=screen, force_terminal=True, width=80), "reading") as tell:
        tell(0.5, "halving")
    assert "50 %" in screen.getvalue()
    assert "halving" in screen.getvalue()
