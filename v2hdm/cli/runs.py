"""``v2hdm map``, ``experiment`` and ``fleet``: commands whose settings are Hydra overrides or run files."""

from __future__ import annotations

import logging
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from v2hdm.cli.main import COMMANDS, exit_code, parser_of
from v2hdm.errors import ConfigError

if TYPE_CHECKING:
    from v2hdm.cli.compose import Job

_RUNS = "choose a run (+run=port1, +run=port2, +run=kitti drive.path=...) or set it on the command line"
_STYLES = {"PASS": "bold green", "WARN": "bold yellow", "FAIL": "bold red"}


def map_drive(arguments: Sequence[str]) -> int:
    """Map a drive; 0 for PASS and WARN, 3 for FAIL."""
    from v2hdm.cli.compose import work_on
    from v2hdm.pipeline.config import RunConfig

    return work_on(COMMANDS["map"], "map", RunConfig, _map, arguments, _RUNS)


def _map(job: Job) -> int:
    from rich.console import Console
    from rich.logging import RichHandler

    from v2hdm.pipeline.context import logging_to
    from v2hdm.pipeline.run import run
    from v2hdm.progress import patient, progress_bars
    from v2hdm.report.terminal import changes_table, results_table

    config = job.settings
    console = Console(file=patient(sys.stdout))
    handler = RichHandler(logging.INFO, console, show_path=False, show_level=False, log_time_format="%X")
    # The verdict's lines, which stand at the end, once and unbroken.
    handler.addFilter(lambda record: record.levelno > logging.INFO or record.msg != "%s")
    with logging_to(handler), progress_bars(console) as progress:
        result = run(config, job.yaml, progress)
    console.print()
    for line in result.headlines:
        console.print(line, highlight=False)
    if result.metrics["results"]:
        console.print(results_table(result.metrics["name"], result.metrics["results"]))
    if "changes" in result.metrics:
        console.print(changes_table(result.metrics["changes"]))
    first, *lines = result.verdict.lines
    for line in [*lines, f"results in {result.place}: open report.html"]:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    # Last, where it is in sight: how good the map is.
    style = _STYLES[result.verdict.status.value]
    console.print(first, style=style, highlight=False, markup=False, soft_wrap=True)
    return exit_code(result.verdict)


_PORTS = "name ports (+run@ports.port1=port1) or set the missing keys on the command line"


def experiment(arguments: Sequence[str]) -> int:
    """Compare all methods."""
    import torch  # noqa: F401  # its absence is reported before that of what is built on it

    from v2hdm.cli.compose import work_on
    from v2hdm.experiment.plan import ExperimentConfig

    return work_on(COMMANDS["experiment"], "experiment", ExperimentConfig, _compare, arguments, _PORTS)


def _compare(job: Job) -> None:
    from v2hdm.experiment.run import experiment_on_terminal

    experiment_on_terminal(job.settings, job.yaml)


def fleet(arguments: Sequence[str]) -> int:
    """Map many drives on the cores of this machine, or a share of them.

    A drive whose result is finished and was made of the same is not done again; one that fails is a row of
    the table that says why. Returns 0, 2 where a drive gave no result, or 3 where a verdict is FAIL.
    """
    parser = parser_of("fleet")
    parser.add_argument("drives", nargs="+", help="run files, as for v2hdm map; or key=value for all of them")
    parser.add_argument("--workers", type=int, default=0, metavar="N", help="cores to use (default: all)")
    tables = "folder for the verdicts, fleet.csv and fleet.json (default: outputs/fleet)"
    parser.add_argument("--table", type=Path, default=Path("outputs/fleet"), metavar="DIR", help=tables)
    every = "map every N-th drive, starting with the K-th; table in DIR-K-of-N"
    parser.add_argument("--share", metavar="K/N", help=every)
    parser.add_argument("--again", action="store_true", help="map finished drives again")
    parsed = parser.parse_intermixed_args(arguments)
    from v2hdm.fleet import FleetOptions, fleet_on_terminal
    from v2hdm.fleet import exit_code as code_of
    from v2hdm.settings import check_workers

    check_workers(parsed.workers)
    overrides = [one for one in parsed.drives if "=" in one and not Path(one).exists()]
    files = [Path(one) for one in dict.fromkeys(parsed.drives) if one not in overrides]
    if not files:
        raise ConfigError("no drives given: name run files, as in v2hdm fleet drives/*.yaml")
    table = parsed.table
    share = (1, 1)
    if parsed.share is not None:
        share = _share(parsed.share)
        table = table.with_name(f"{table.name}-{share[0]}-of-{share[1]}")
    options = FleetOptions(table, parsed.workers, parsed.again, share)
    return code_of(fleet_on_terminal(files, overrides, options))


def _share(given: str) -> tuple[int, int]:
    numbers = re.fullmatch(r"(\d{1,6})/(\d{1,6})", given, re.ASCII)
    k, n = (int(one) for one in numbers.groups()) if numbers else (0, 0)
    if not 1 <= k <= n:
        raise ConfigError(f"--share {given}: give K/N, such as 1/4 to 4/4")
    return k, n
