"""Which results are finished: those in whose folder the key of all that they are made of is kept."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from v2hdm.errors import V2hdmError
from v2hdm.files import load_json
from v2hdm.fleet.plan import Job
from v2hdm.outputs import added_to, is_whole

KEY_FILE = "fleet.json"
"""Beside the results of a drive: what they are made of."""


def finish(job: Job) -> None:
    """Note in the folder of a result of which key it is.

    Raises:
        ConfigError: it cannot be written, or the file there is not ours.
    """
    with added_to(job.folder, [KEY_FILE], "output=") as folder:
        (folder / KEY_FILE).write_text(json.dumps({"key": job.key}) + "\n", encoding="utf-8")


def metrics_of(folder: Path) -> dict[str, Any]:
    """What a run has written about itself.

    Raises:
        V2hdmError: it is missing or damaged.
    """
    return load_json(folder / "metrics.json", V2hdmError)


def finished_metrics(job: Job) -> dict[str, Any] | None:
    """The ``metrics.json`` of a finished, unchanged result of a job's key; None where there is none."""
    try:
        if not is_whole(job.folder) or load_json(job.folder / KEY_FILE, V2hdmError).get("key") != job.key:
            return None
        return metrics_of(job.folder)
    except (V2hdmError, OSError):
        return None
