"""Writes the manifest of the detector's fitted files: ``train.ship`` and ``export`` call it."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from v2hdm.detection import weights
from v2hdm.errors import DetectorError
from v2hdm.store.files import replace_text


def record(names: Sequence[str], command: str, folder: Path = weights.FOLDER) -> None:
    """Note in the manifest that files are as they are now, and go with the network as it is now.

    Args:
        names: of :data:`v2hdm.detection.weights.COMMANDS`.
        command: made them.
        folder: holds the files and the manifest.

    Raises:
        DetectorError: there is no such fitted file, or the manifest is damaged.
    """
    unknown = [name for name in names if name not in weights.COMMANDS or not (folder / name).is_file()]
    if unknown:
        fitted = ", ".join(weights.COMMANDS)
        raise DetectorError(f"{folder / unknown[0]}: no fitted file of the detector; give one of {fitted}")
    manifest_file = folder / weights.MANIFEST_FILE.name
    manifest = weights.read_manifest(folder) if manifest_file.is_file() else {"files": {}}
    network = weights.digest(folder / weights.NETWORK_FILE.name)
    today = datetime.now(UTC).date().isoformat()
    for name in names:
        sha256 = weights.digest(folder / name)
        manifest["files"][name] = {"sha256": sha256, "network": network, "made": today, "command": command}
    manifest = {"commit": _commit(), "files": manifest["files"]}
    replace_text(manifest_file, json.dumps(manifest, indent=1) + "\n")


def record_network(output: Path, command: str) -> None:
    """:func:`record` a network that was exported to ``output``, if that is the shipped one."""
    if output.resolve() == weights.NETWORK_FILE.resolve():
        record([weights.NETWORK_FILE.name], command)


def _commit() -> str | None:
    """The id of the commit checked out, with ``-dirty`` if files were changed since; None outside of git."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        answer = subprocess.run(
            command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return answer.stdout.strip()
