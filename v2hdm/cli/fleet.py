"""``v2hdm fleet drives/*.yaml``: many drives on the cores of this machine or of a cluster, by Ray.

A drive whose result is finished and was made of the same is not done again; one that fails is a row of the
table that says why, and the others go on. With --site all drives are mapped together (docs/fleet.md).
"""

from __future__ import annotations

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
        "--address", default="local", help="of a running Ray cluster, or auto (default: a new one)"
    )
    parser.add_argument(
        "--table",
        type=Path,
        default=Path("outputs/fleet"),
        metavar="FOLDER",
        help="takes the table of verdicts, fleet.csv and fleet.json (default: outputs/fleet)",
    )
    parser.add_argument("--site", metavar="NAME", help="map all drives together, as one site of that name")
    parser.add_argument("--again", action="store_true", help="do what is finished again")
    parsed = parser.parse_intermixed_args(arguments)
    import ray  # noqa: F401  # its absence is reported before that of what is built on it

    from v2hdm.fleet.plan import exit_code
    from v2hdm.fleet.run import FleetOptions, fleet_on_terminal
    from v2hdm.settings import check_workers
    from v2hdm.store.remote import is_url

    check_workers(parsed.workers)
    overrides = [one for one in parsed.drives if "=" in one and not Path(one).exists()]
    files = [Path(one) for one in dict.fromkeys(parsed.drives) if one not in overrides]
    if not files:
        raise ConfigError("no drive is named: give run files, as in v2hdm fleet drives/*.yaml")
    if any(is_url(one) for one in parsed.drives if one not in overrides):
        raise ConfigError("run files lie on this machine; their drive.path may be a URL (docs/fleet.md)")
    options = FleetOptions(parsed.table, parsed.workers, parsed.address, parsed.again, parsed.site)
    return exit_code(fleet_on_terminal(files, overrides, options))
