"""A run on the terminal: progress bars, the log, and the table that ends it."""

from __future__ import annotations

import logging

from rich.console import Console
from rich.logging import RichHandler

from v2hdm.pipeline.config import RunConfig, run_name
from v2hdm.pipeline.context import logging_to
from v2hdm.pipeline.run import run
from v2hdm.progress import progress_bars
from v2hdm.report.terminal import changes_table, results_table
from v2hdm.verdict import Status, Verdict
from v2hdm.viewer import RerunViewer, check_viewer

_STYLES = {Status.PASS: "bold green", Status.WARN: "bold yellow", Status.FAIL: "bold red"}


def run_on_terminal(config: RunConfig, config_yaml: str) -> Verdict:
    """Run the pipeline, show what it does and found, and return the verdict on it."""
    console = Console()
    handler = RichHandler(logging.INFO, console, show_path=False, show_level=False, log_time_format="%X")
    viewer = RerunViewer(run_name(config)) if check_viewer(config.viewer) else None
    with logging_to(handler), progress_bars(console) as progress:
        result = run(config, config_yaml, progress, viewer)
    console.print()
    for line in result.headlines:
        console.print(line, highlight=False)
    if result.metrics["results"]:
        console.print(results_table(result.metrics["name"], result.metrics["results"]))
    if "changes" in result.metrics:
        console.print(changes_table(result.metrics["changes"]))
    summary, *findings = result.verdict.lines
    for line in findings:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    console.print(f"results in {result.place}: open report.html", highlight=False, soft_wrap=True)
    # last, where it is in sight: how good the map is
    console.print(
        summary, style=_STYLES[result.verdict.status], highlight=False, markup=False, soft_wrap=True
    )
    return result.verdict
