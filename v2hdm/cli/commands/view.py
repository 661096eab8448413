"""``v2hdm view RESULT`` (docs/report.md)."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from v2hdm.cli.arguments import add_result
from v2hdm.cli.command import Command


def _run(arguments: Sequence[str]) -> None:
    """Serve the report, to correct markings in, until Ctrl-C; every correction is written at once."""
    parser = COMMAND.parser()
    add_result(parser)
    parser.add_argument("--corrections", type=Path, metavar="FILE", help="default: RESULT.corrections.yaml")
    parsed = parser.parse_args(arguments)
    from v2hdm.io.drive import drive_of
    from v2hdm.report.view.server import server_of
    from v2hdm.report.view.session import file_beside

    path = parsed.corrections or file_beside(parsed.result)
    server, address, session = server_of(parsed.result, drive_of(parsed.result, parsed.drive), path)
    serving = threading.Thread(target=server.serve_forever, daemon=True)
    try:
        print(f"open {address}; Ctrl-C ends it", flush=True)
        # Loaded and drawn while the browser starts; a damaged result ends the command here. In a
        # thread of its own: Ctrl-C within an import would end Python with the signal's
        # code, even where it is caught.
        with ThreadPoolExecutor(1) as preparing:
            preparing.submit(server.load).result()
            serving.start()
            preparing.submit(server.prepare).result()
        serving.join()
    except KeyboardInterrupt:
        count = len(session.corrections)
        print(f"{count} corrections in {path}: map.corrections={path} in the next run" if count else "ended")
    finally:
        if serving.is_alive():
            server.shutdown()
        server.server_close()


COMMAND = Command(
    "v2hdm view", "View a result in the browser, and correct its markings for the next run.", _run
)
