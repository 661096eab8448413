"""``v2hdm view RESULT``: the report as a page of this machine, to correct markings in for the next run.

docs/report.md describes it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.main import parser_of


def run(arguments: Sequence[str]) -> None:
    """Serve the page until Ctrl-C; every correction is written at once."""
    parser = parser_of("view")
    parser.add_argument("result", type=Path, help="result folder of v2hdm map")
    parser.add_argument("--drive", type=Path, help="the drive that it mapped (default: where it was then)")
    parser.add_argument("--corrections", type=Path, metavar="FILE", help="(RESULT.corrections.yaml)")
    parsed = parser.parse_args(arguments)
    from v2hdm.io.drive.of_result import drive_of
    from v2hdm.report.view import file_beside, server_of

    path = parsed.corrections or file_beside(parsed.result)
    server, address, session = server_of(parsed.result, drive_of(parsed.result, parsed.drive), path)
    try:
        print(f"open {address}; Ctrl-C ends it", flush=True)
        server.serve_forever()
    except KeyboardInterrupt:
        count = len(session.corrections)
        print(f"{count} corrections in {path}: map.corrections={path} in the next run" if count else "ended")
    finally:
        server.server_close()
