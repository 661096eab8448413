"""The scripts of 1.0, such as ``v2hdm-map``: they run until 2.0, and say what to type."""

from __future__ import annotations

import sys
from pathlib import Path

from v2hdm.cli.main import main
from v2hdm.errors import one_line

COMMANDS = {
    "calibrate": "calibrate points",
    "extrinsic": "calibrate ground",
    "calibration": "calibrate compare",
}
"""Commands of scripts ``v2hdm-NAME`` that are called otherwise; the others have the script's name."""


def script() -> int:
    """Run the script that was typed as the command that it was."""
    typed = Path(sys.argv[0]).stem
    name = typed.removeprefix("v2hdm-")
    command = COMMANDS.get(name, name)
    line = f"{typed} is deprecated and goes with 2.0: type v2hdm {command}"
    print(one_line(line), file=sys.stderr, flush=True)
    return main([*command.split(), *sys.argv[1:]])
