"""Parts that several commands share: arguments on a drive or result, its folder, progress, the exit code."""

from __future__ import annotations

import argparse
import json
import logging
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from v2hdm.errors import EXIT_FAILED_VERDICT, ConfigError, masked
from v2hdm.progress import Steps, patient, progress_lines

if TYPE_CHECKING:
    from v2hdm.records import Drive
    from v2hdm.verdict import Verdict


def add_drive(parser: argparse.ArgumentParser, result: str) -> None:
    """Add the arguments of commands that read a drive; ``result`` ends the name of the default folder."""
    parser.add_argument("drive", type=Path, help="a drive folder or a bag; see docs/drive-format.md")
    parser.add_argument(
        "--camera", action="append", default=[], metavar="NAME", help="use only this camera; repeatable"
    )
    parser.add_argument("--format", default="auto", metavar="NAME", help="folder, kitti, bag (default: auto)")
    parser.add_argument("--output", type=Path, metavar="DIR", help=f"default: outputs/<drive>-{result}")
    parser.add_argument("--workers", type=int, default=0, metavar="N", help="processes (default: all cores)")


def drive_of(parsed: argparse.Namespace) -> Drive:
    """Read the drive of :func:`add_drive`; ``parsed.workers``, if 0, becomes the number of cores."""
    import cv2

    from v2hdm.io.drive import ReadOptions, read_drive
    from v2hdm.settings import check_workers

    check_workers(parsed.workers)
    parsed.workers = parsed.workers or os.cpu_count() or 1
    log_to_terminal()
    cv2.setNumThreads(1)
    return read_drive(parsed.drive, ReadOptions(format=parsed.format, cameras=parsed.camera))


def log_to_terminal() -> None:
    """Show warnings, and the choices of the drive's reader, on stderr."""
    terminal = logging.StreamHandler()
    terminal.setFormatter(logging.Formatter("%(message)s"))
    terminal.addFilter(_Once())
    logging.basicConfig(handlers=[terminal])
    logging.getLogger("v2hdm.io").setLevel(logging.INFO)  # an import may take minutes and logs its progress


class _Once(logging.Filter):
    """Lets each line pass once: a command that writes a drive.yaml reads the recording twice."""

    def __init__(self) -> None:
        super().__init__()
        self._lines: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        line = record.getMessage()
        is_new = line not in self._lines
        self._lines.add(line)
        return is_new


def add_result(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of commands on a finished result."""
    parser.add_argument("result", type=Path, help="result folder of v2hdm map")
    where = "the drive's folder (default: where it was when mapped)"
    parser.add_argument("--drive", type=Path, metavar="DIR", help=where)


def add_site(parser: argparse.ArgumentParser) -> None:
    """Add a site of the benchmark, or a layout of a user's and the way along it."""
    sites = "port1, port2, streets or quay, or an OpenDRIVE file (.xodr) with --way"
    parser.add_argument("site", metavar="SITE", help=sites)
    way = "trajectory (TUM) along an OpenDRIVE file, in its coordinates"
    parser.add_argument("--way", type=Path, metavar="FILE", help=way)


@contextmanager
def result_of(folder: Path, maker: str, settings: Mapping[str, object]) -> Iterator[Path]:
    """The unfinished folder of a command's results, with the settings that they were made of."""
    from v2hdm.store.results import result_folder

    with result_folder(folder, "--output", maker) as unfinished:
        (unfinished / "config.yaml").write_text(masked(json.dumps(settings)) + "\n", encoding="utf-8")
        yield unfinished


def kinds_of(pairs: Sequence[str]) -> dict[str, str]:
    """Our classes by the names of a file, of options --class NAME=CLASS; ConfigError where one is not so."""
    kind_of = {}
    for pair in pairs:
        name, separator, kind = pair.rpartition("=")
        if not separator or not name or not kind:
            raise ConfigError(f"--class {pair}: give it as NAME=CLASS, such as MARK_02=lane_dash")
        kind_of[name] = kind
    return kind_of


def steps_of(task: str) -> Steps:
    """Progress of a task as lines on stderr."""
    return partial(progress_lines(partial(print, file=patient(sys.stderr), flush=True)), task)


def exit_code(verdict: Verdict) -> int:
    """3 for FAIL, 0 for PASS and WARN."""
    return EXIT_FAILED_VERDICT if verdict.status.value == "FAIL" else 0
