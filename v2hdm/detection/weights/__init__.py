"""The four fitted files of the detector, and the manifest that says that they belong together.

``default.onnx`` is the network. Three files were fitted to the claims of that network: ``judge.onnx`` and
``confidence.json`` give a marking its probability, ``lane_score.json`` a line of a lane. ``manifest.json``
holds one commit id and, for each file, its SHA-256, the SHA-256 of the network that it goes with, the day and
the command that made it. :mod:`export.manifest` writes it.
"""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from v2hdm.errors import DetectorError

FOLDER = Path(__file__).parent
NETWORK_FILE = FOLDER / "default.onnx"
JUDGE_FILE = FOLDER / "judge.onnx"
CONFIDENCE_FILE = FOLDER / "confidence.json"
LANE_SCORE_FILE = FOLDER / "lane_score.json"
MANIFEST_FILE = FOLDER / "manifest.json"

_FIT = f"python -m train.ship v2hdm/detection/weights/{NETWORK_FILE.name}"
COMMANDS: Mapping[str, str] = {
    NETWORK_FILE.name: "python -m train.ship runs/gpu",
    JUDGE_FILE.name: _FIT,
    CONFIDENCE_FILE.name: _FIT,
    LANE_SCORE_FILE.name: _FIT,
}
"""The command that makes each file, from a training or for the network that is there."""


def check_weights(folder: Path = FOLDER) -> None:
    """Raise DetectorError for fitted files that do not belong together; they are read once per process."""
    if (problem := _problem(folder)) is not None:
        raise DetectorError(problem)


def unknown_network(model: str | Path, folder: Path = FOLDER) -> str | None:
    """One line on a network that the judge was not fitted to; None for ours. DetectorError without a file."""
    path = Path(model)
    if not path.is_file():
        raise DetectorError(f"{path}: no such detector model; give the path of an ONNX file")
    if digest(path) == read_manifest(folder)["files"][NETWORK_FILE.name]["sha256"]:
        return None
    return (
        f"{path}: scores come from the judge of the shipped network, which was not fitted to this one; "
        f"fit it with `python -m train.ship {shlex.quote(str(path))}`"
    )


def read_manifest(folder: Path = FOLDER) -> dict[str, Any]:
    """The content of ``manifest.json``: ``commit``, ``files`` by name; raises DetectorError where damaged."""
    path = folder / MANIFEST_FILE.name
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        for name in COMMANDS:
            content["files"][name]["sha256"], content["files"][name]["network"]
    except (OSError, ValueError, TypeError, KeyError) as failure:
        raise DetectorError(
            f"{path}: missing or damaged; install v2hdm again, or restore the folder from version control"
        ) from failure
    return content


def digest(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


@cache
def _problem(folder: Path) -> str | None:
    """The defect of a folder's files, in one line; None if they belong together."""
    files = read_manifest(folder)["files"]
    for name, command in COMMANDS.items():
        path = folder / name
        problem = None
        if not path.is_file():
            problem = f"no such file; install v2hdm again, or make it with `{command}`"
        elif digest(path) != files[name]["sha256"]:
            problem = "not the file in the manifest beside it; restore both from one commit, or make it with "
            problem += f"`{command}`"
        elif files[name]["network"] != files[NETWORK_FILE.name]["sha256"]:
            problem = f"was fitted to a network other than {NETWORK_FILE.name}; run `{command}`"
        if problem:
            return f"{path}: {problem}"
    return None
