"""``v2hdm fleet drives/*.yaml`` (docs/fleet.md)."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.command import GO_ON, Command
from v2hdm.errors import ConfigError


def _run(arguments: Sequence[str]) -> int:
    """Map many drives on the cores of this machine, or on a Dask cluster.

    A drive whose result is finished and was made of the same is not done again; one that fails is a row of
    the table that says why. Returns 0, 2 where a drive gave no result, or 3 where a verdict is FAIL.
    """
    parser = COMMAND.parser()
    parser.add_argument("drives", nargs="+", help="run files, as for v2hdm map; or key=value for all of them")
    parser.add_argument("--workers", type=int, default=0, metavar="N", help="cores to use (default: all)")
    tables = "folder for the verdicts, fleet.csv and fleet.json (default: outputs/fleet)"
    parser.add_argument("--table", type=Path, default=Path("outputs/fleet"), metavar="DIR", help=tables)
    machines = "machines to work on: the address of a Dask scheduler, or a batch system; as cluster=ADDRESS"
    parser.add_argument("--cluster", metavar="ADDRESS", help=machines)
    parser.add_argument("--again", action="store_true", help="map finished drives again")
    parser.add_argument("--share", metavar="K/N", help=argparse.SUPPRESS)  # of 1.0, taken until 2.0
    parsed = parser.parse_intermixed_args(arguments)
    from v2hdm.cli.old_names import share_of
    from v2hdm.fleet import FleetOptions, exit_code, fleet_on_terminal
    from v2hdm.settings import check_workers

    check_workers(parsed.workers)
    overrides = [word for word in parsed.drives if "=" in word and not Path(word).exists()]
    files = [Path(word) for word in dict.fromkeys(parsed.drives) if word not in overrides]
    if not files:
        raise ConfigError("no drives given: name run files, as in v2hdm fleet drives/*.yaml")
    if parsed.cluster is not None:
        overrides.append(f"cluster={parsed.cluster}")
    missing = [file for file in files if not file.exists()]
    # A pattern that matches nothing comes as it is.
    if unmatched := [file for file in missing if missing == files or set("*?[") & set(str(file))]:
        raise ConfigError(f"{unmatched[0]}: no such run file; check the path")
    table = parsed.table
    if parsed.share is not None:
        share = share_of(parsed.share)
        files = files[share.first - 1 :: share.every]
        table = table.with_name(f"{table.name}-{share.first}-of-{share.every}")
    options = FleetOptions(table, parsed.workers, parsed.again)
    return exit_code(fleet_on_terminal(files, overrides, options))


COMMAND = Command(
    "v2hdm fleet",
    "Map many drives, each described by a run file.",
    _run,
    interrupted=f"interrupted; finished drives are kept, {GO_ON}",
)
