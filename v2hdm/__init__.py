"""Marking-level HD maps and camera calibration from monocular cameras and RTK-GNSS poses.

What a command does, three lines of Python do::

    result = v2hdm.map_drive("drives/mysite")
    print(result.verdict.lines[0])
    result.save("outputs/mysite")

Names are loaded when they are first used: importing the package loads no other library.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from v2hdm.adjust.problem import Problem as Problem
    from v2hdm.adjust.solve import solve as solve
    from v2hdm.detection.detector import Detector as Detector
    from v2hdm.detection.options import DetectorOptions as DetectorOptions
    from v2hdm.errors import V2hdmError as V2hdmError
    from v2hdm.io.drive import ReadOptions as ReadOptions
    from v2hdm.library import (
        build_problem as build_problem,
    )
    from v2hdm.library import (
        calibrate_from_ground as calibrate_from_ground,
    )
    from v2hdm.library import (
        calibrate_from_points as calibrate_from_points,
    )
    from v2hdm.library import (
        check_drive as check_drive,
    )
    from v2hdm.library import (
        localize as localize,
    )
    from v2hdm.library import (
        read_drive as read_drive,
    )
    from v2hdm.library import (
        read_map as read_map,
    )
    from v2hdm.library import (
        simulate_port as simulate_port,
    )
    from v2hdm.mapping.options import MappingOptions as MappingOptions
    from v2hdm.pipeline.detect_images import detect_images as detect_images
    from v2hdm.pipeline.map_drive import map_drive as map_drive
    from v2hdm.pipeline.result import Result as Result
    from v2hdm.records import Calibration as Calibration
    from v2hdm.records import HdMap as HDMap  # noqa: F401
    from v2hdm.verdict.verdict import Verdict as Verdict

__version__ = "0.1.0"

_NAMES = {
    "v2hdm.adjust.problem": "Problem",
    "v2hdm.adjust.solve": "solve",
    "v2hdm.detection.detector": "Detector",
    "v2hdm.detection.options": "DetectorOptions",
    "v2hdm.errors": "V2hdmError",
    "v2hdm.io.drive": "ReadOptions",
    "v2hdm.library": "build_problem calibrate_from_ground calibrate_from_points check_drive localize "
    "read_drive read_map simulate_port",
    "v2hdm.mapping.options": "MappingOptions",
    "v2hdm.pipeline.detect_images": "detect_images",
    "v2hdm.pipeline.map_drive": "map_drive",
    "v2hdm.pipeline.result": "Result",
    "v2hdm.records": "Calibration HDMap",
    "v2hdm.verdict.verdict": "Verdict",
}
_HOMES = {name: module for module, names in _NAMES.items() for name in names.split()}
_CALLED = {"HDMap": "HdMap"}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'v2hdm' has no attribute '{name}'")
    from v2hdm.extras import of_extra

    with of_extra("map", f"v2hdm.{name}"):
        found = getattr(importlib.import_module(_HOMES[name]), _CALLED.get(name, name))
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
