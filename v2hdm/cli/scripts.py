"""The doors as console scripts: ``v2hdm-map`` is ``python -m v2hdm.map``, and so are the others."""

from __future__ import annotations

import importlib
from collections.abc import Callable

from v2hdm.cli.door import answer_signals


def _script(door: str) -> Callable[[], int]:
    """The script that opens a door as ``python -m`` does; the door is imported when it is run."""

    def run() -> int:
        answer_signals()
        return int(importlib.import_module(f"v2hdm.{door}").main())

    return run


map_ = _script("map")
detect = _script("detect")
check = _script("cli.check")
extrinsic = _script("cli.extrinsic")
export = _script("cli.export")
localize = _script("cli.localize")
calibration = _script("cli.calibration")
calibrate = _script("cli.calibrate")
mosaic = _script("cli.mosaic")
report = _script("report.__main__")
experiment = _script("experiment.__main__")
cache = _script("cli.cache")
fleet = _script("fleet.__main__")
