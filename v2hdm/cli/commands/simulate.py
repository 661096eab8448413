"""``v2hdm simulate +run=port2``: render a port's drive, with its truth, where ``v2hdm map`` looks for it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from v2hdm.cli.arguments import steps_of
from v2hdm.cli.command import GO_ON, Command

if TYPE_CHECKING:
    from v2hdm.cli.compose import Job

_LISTED = ("simulate", "cache", "workers")  # keys, and those below them, that make a difference here


def _run(arguments: Sequence[str]) -> int:
    """Render a port."""
    from v2hdm.cli.compose import Door, work_on
    from v2hdm.pipeline.config import RunConfig

    door = Door("map", RunConfig, "choose a port: +run=port2", lambda key: key.split(".")[0] in _LISTED)
    return work_on(COMMAND, door, _render, arguments)


def _render(job: Job) -> None:
    from pathlib import Path

    from v2hdm.executor import open_executor
    from v2hdm.pipeline.config import admit_port
    from v2hdm.simulate.survey.drive import simulated_drives

    config = job.settings
    port = admit_port(config)
    with open_executor(config.workers, config.cluster, writable=[config.cache]) as executor:
        for folder in simulated_drives(port, Path(config.cache), executor, steps_of("render images")):
            print(folder)


COMMAND = Command(
    "v2hdm simulate",
    "Render a drive through a port, with its truth, into the cache.",
    _run,
    interrupted=f"interrupted; finished images are kept, {GO_ON}",
)
