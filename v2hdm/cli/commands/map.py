"""``v2hdm map +run=port2``: map a drive by settings that are Hydra overrides or a run file."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from v2hdm import __version__
from v2hdm.cli.arguments import exit_code
from v2hdm.cli.command import Command
from v2hdm.errors import one_line
from v2hdm.progress import patient

if TYPE_CHECKING:
    from v2hdm.cli.compose import Job

_STYLES = {"PASS": "bold green", "WARN": "bold yellow", "FAIL": "bold red"}  # of rich, by verdict


def _run(arguments: Sequence[str]) -> int:
    """Map a drive; 0 for PASS and WARN, 3 for FAIL."""
    from v2hdm.cli.compose import Door, work_on
    from v2hdm.pipeline.config import RunConfig

    advice = "choose a run (+run=port1, +run=port2, +run=kitti drive.path=...) or set it on the command line"
    further = "\nThose of a rendered port, simulate.*, are listed by v2hdm simulate --help."
    door = Door("map", RunConfig, advice, lambda key: not key.startswith("simulate."), further)
    return work_on(COMMAND, door, _map, arguments)


def _map(job: Job) -> int:
    config = job.settings
    out = patient(sys.stdout)
    of_drives = [str(path) for path in config.drive.paths]
    mapped = config.simulate.name if config.simulate is not None else ", ".join(of_drives)
    if mapped:  # before the libraries of all that follows are loaded, which takes seconds
        print(f"{time.strftime('%X')} v2hdm {__version__} maps {one_line(mapped)}", file=out, flush=True)
    from rich.console import Console
    from rich.logging import RichHandler

    from v2hdm.pipeline.context import logging_to
    from v2hdm.pipeline.run import run
    from v2hdm.progress import progress_bars
    from v2hdm.report.terminal import changes_table, results_table

    console = Console(file=out)
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
    summary, *findings = result.verdict.lines
    for line in [*findings, f"results in {result.place}: open report.html"]:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    # Last, where it is in sight: how good the map is.
    style = _STYLES[result.verdict.status.value]
    console.print(summary, style=style, highlight=False, markup=False, soft_wrap=True)
    return exit_code(result.verdict)


COMMAND = Command(
    "v2hdm map",
    "Turn a drive into a map, calibrations and a verdict.",
    _run,
    interrupted="interrupted; finished stages are kept in the cache, no result was written",
)
