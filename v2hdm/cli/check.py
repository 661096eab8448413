"""``v2hdm check DRIVE``: one line per finding, a verdict, and pictures of the route and of sample images.

docs/check.md says what each finding means. No torch is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.main import add_drive, drive_of, exit_code, parser_of, result_of


def run(arguments: Sequence[str]) -> int:
    """Check a drive; 0 for PASS and WARN, 3 for FAIL."""
    parser = parser_of("check")
    add_drive(parser, "check")
    parser.add_argument("--no-ground", dest="ground", action="store_false", help="match no ground: faster")
    parser.add_argument("--list-topics", action="store_true", help="only list a bag's topics and drive.yaml")
    parser.add_argument("--all", action="store_true", help="also print the checks that passed")
    parsed = parser.parse_args(arguments)
    if parsed.list_topics:
        from v2hdm.io.drive import ReadOptions
        from v2hdm.io.importers.bag.describe import list_topics

        print(list_topics(parsed.drive, Path(ReadOptions().cache)))
        return 0
    from v2hdm.ground import estimate_cameras
    from v2hdm.report.outputs import write_json
    from v2hdm.verdict import check_drive
    from v2hdm.verdict.check import draw_check

    drive = drive_of(parsed)
    folder = parsed.output or Path("outputs") / f"{drive.name}-check"
    settings = {"drive": str(parsed.drive), "cameras": list(drive.cameras), "ground": parsed.ground}
    with result_of(folder, f"v2hdm check of {parsed.drive.resolve()}", settings) as unfinished:
        ground = estimate_cameras(drive, parsed.workers) if parsed.ground else {}
        verdict = check_drive(drive, ground=ground)
        write_json(unfinished / "verdict.json", verdict.as_json())
        draw_check(drive, unfinished, ground)
    passed = [finding.line for finding in verdict.passed if parsed.all]
    print(*passed, *verdict.lines[1:], verdict.lines[0], f"pictures in {folder}", sep="\n")
    return exit_code(verdict)
