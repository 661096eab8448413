"""``v2hdm check DRIVE``: examine a drive before it is mapped (docs/check.md)."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.arguments import add_drive, drive_of, exit_code, log_to_terminal, result_of, steps_of
from v2hdm.cli.command import Command
from v2hdm.errors import EXIT_USER_ERROR, DriveError, one_line


def _run(arguments: Sequence[str]) -> int:
    """One line per finding, a verdict and pictures, without torch; 0 for PASS and WARN, 3 for FAIL."""
    parser = _parser()
    parsed = parser.parse_args(arguments)
    if parsed.list_topics:
        from v2hdm.io.drive import ReadOptions
        from v2hdm.io.importers.bag.describe import list_topics

        print(list_topics(parsed.drive, Path(ReadOptions().cache)))
        return 0
    from v2hdm.executor import open_executor
    from v2hdm.ground.estimate import estimate_cameras
    from v2hdm.io.description import DRIVE_FILE
    from v2hdm.store.files import write_json
    from v2hdm.store.names import VERDICT
    from v2hdm.verdict import check_drive
    from v2hdm.verdict.check import draw_check, ground_seen
    from v2hdm.verdict.inputs.origin import HEIGHT, frame_of, height_to_state

    if parsed.set and not parsed.write:
        parser.error("--set is for --write")
    if parsed.write:
        if not _is_drafted(parsed):
            return EXIT_USER_ERROR
        parsed.drive = parsed.write
    drive = drive_of(parsed)
    folder = parsed.output or Path("outputs") / f"{drive.name}-check"
    settings = {"drive": str(parsed.drive), "cameras": list(drive.cameras), "ground": parsed.ground}
    with result_of(folder, f"v2hdm check of {_recording_of(parsed.drive)}", settings) as unfinished:
        matched = steps_of("match bare ground, cameras")
        with open_executor(parsed.workers) as executor:
            ground = estimate_cameras(drive, executor, matched) if parsed.ground else {}
        print("check the drive", file=sys.stderr, flush=True)
        verdict = check_drive(drive, ground=ground)
        is_asked = parsed.write and not any(setting.startswith(f"{HEIGHT}=") for setting in parsed.set)
        if is_asked and (height_m := height_to_state(drive, verdict)) is not None:
            (parsed.write / DRIVE_FILE).unlink()
            raise DriveError(
                f"{parsed.write / DRIVE_FILE}: not written: bare ground contradicts the cameras' heights; "
                f"also give the height of {frame_of(drive)} above the ground, such as the axle's, or 0: "
                f"--set {HEIGHT}={height_m:.2f}"
            )
        write_json(unfinished / VERDICT, verdict.as_json())
        draw_check(drive, unfinished, ground)
    passed = [finding.line for finding in verdict.passed if parsed.all]
    summary, *findings = verdict.lines
    of_ground = ground_seen(drive, ground)
    print("\n".join([*passed, *findings, *of_ground, summary, one_line(f"pictures in {folder}")]))
    return exit_code(verdict)


def _parser() -> argparse.ArgumentParser:
    """The options of the command."""
    parser = COMMAND.parser()
    add_drive(parser, "check")
    parser.add_argument("--no-ground", dest="ground", action="store_false", help="skip bare ground: faster")
    parser.add_argument("--list-topics", action="store_true", help="only print a bag's topics and drive.yaml")
    written = "write a drive.yaml for a bag, video or image folder"
    values = "with --write: values that it asks for"
    parser.add_argument("--write", type=Path, metavar="DIR", help=written)
    parser.add_argument("--set", nargs="+", action="extend", default=[], metavar="KEY=VALUE", help=values)
    parser.add_argument("--all", action="store_true", help="also print passed checks")
    return parser


def _is_drafted(parsed: argparse.Namespace) -> bool:
    """Write drive.yaml, or print the missing settings; returns whether it was written."""
    from v2hdm.io.drive.draft import draft_drive

    log_to_terminal()
    if missing := draft_drive(parsed.drive, parsed.write, parsed.set, parsed.camera):
        asked = [f"  {one_line(f'--set {key}=... {why}')}" for key, why in missing.items()]
        problem = one_line(f"error: {parsed.drive}: nothing written; also give:")
        print("\n".join([problem, *asked]), file=sys.stderr)
        return False
    print(one_line(f"{parsed.write / 'drive.yaml'} written"), file=sys.stderr)
    return True


def _recording_of(drive: Path) -> Path:
    """The bag that a drive folder describes, so that both have one result; else the drive itself."""
    from v2hdm.io.description import DRIVE_FILE
    from v2hdm.safe.texts import read_yaml

    file = drive / DRIVE_FILE
    return (drive / (read_yaml(file, DriveError).get("bag", "") if file.is_file() else "")).resolve()


COMMAND = Command("v2hdm check", "Find in seconds what is wrong with a drive.", _run)
