"""``v2hdm check DRIVE``: one line per finding, a verdict, and pictures of the route and of sample images.

docs/check.md says what each finding means. No torch is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.main import add_drive, parser_of
from v2hdm.errors import EXIT_FAILED_VERDICT


def run(arguments: Sequence[str]) -> int:
    """Check a drive; 0 for PASS and WARN, 3 for FAIL."""
    parser = parser_of("check")
    add_drive(parser, "check")
    parser.add_argument(
        "--no-ground", dest="ground", action="store_false", help="do not match bare ground: faster, says less"
    )
    parser.add_argument(
        "--list-topics", action="store_true", help="only list a bag's topics, and the drive.yaml for it"
    )
    parser.add_argument("--all", action="store_true", help="also print the checks that passed")
    parsed = parser.parse_args(arguments)
    if parsed.list_topics:
        from v2hdm.io.drive import ReadOptions
        from v2hdm.io.importers.bag.describe import list_topics

        print(list_topics(parsed.drive, Path(ReadOptions().cache)))
        return 0
    from v2hdm.verdict.check import check_up

    return EXIT_FAILED_VERDICT if check_up(parsed) else 0
