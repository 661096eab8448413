"""``v2hdm fleet drives/*.yaml``: many drives on the cores of this machine, or a share of them.

A drive whose result is finished and was made of the same is not done again; one that fails is a row of the
table that says why, and the others go on (docs/fleet.md).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.main import parser_of
from v2hdm.errors import ConfigError


def run(arguments: Sequence[str]) -> int:
    """Map a fleet; 0, 2 where a drive gave no result, or 3 where a verdict is FAIL."""
    parser = parser_of("fleet")
    parser.add_argument("drives", nargs="+", help="run files, as for v2hdm map; or key=value for all of them")
    parser.add_argument("--workers", type=int, default=0, help="cores of this machine; 0 (default): all")
    parser.add_argument(
        "--table",
        type=Path,
        default=Path("outputs/fleet"),
        metavar="FOLDER",
        help="takes the table of verdicts, fleet.csv and fleet.json (default: outputs/fleet)",
    )
    parser.add_argument(
        "--share", metavar="K/N", help="map every N-th drive, from the K-th on; its table is FOLDER-K-of-N"
    )
    parser.add_argument("--again", action="store_true", help="do what is finished again")
    parsed = parser.parse_intermixed_args(arguments)
    from v2hdm.fleet import FleetOptions, exit_code, fleet_on_terminal
    from v2hdm.settings import check_workers

    check_workers(parsed.workers)
    overrides = [one for one in parsed.drives if "=" in one and not Path(one).exists()]
    files = [Path(one) for one in dict.fromkeys(parsed.drives) if one not in overrides]
    if not files:
        raise ConfigError("no drive is named: give run files, as in v2hdm fleet drives/*.yaml")
    table, share = parsed.table, (1, 1)
    if parsed.share is not None:
        share = _share(parsed.share)
        table = table.with_name(f"{table.name}-{share[0]}-of-{share[1]}")
    options = FleetOptions(table, parsed.workers, parsed.again, share)
    return exit_code(fleet_on_terminal(files, overrides, options))


def _share(given: str) -> tuple[int, int]:
    numbers = re.fullmatch(r"(\d{1,6})/(\d{1,6})", given, re.ASCII)
    k, n = (int(one) for one in numbers.groups()) if numbers else (0, 0)
    if not 1 <= k <= n:
        raise ConfigError(f"--share {given}: say which share of how many, from 1/4 to 4/4")
    return k, n
