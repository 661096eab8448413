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
    from v2hdm.adjust.problem import Problem
    from v2hdm.adjust.solve import solve
    from v2hdm.calibration.from_ground import calibrate_from_ground
    from v2hdm.calibration.from_points import calibrate_from_points
    from v2hdm.detection.detector import Detector
    from v2hdm.detection.options import DetectorOptions
    from v2hdm.errors import V2hdmError
    from v2hdm.io.drive import ReadOptions, read_drive
    from v2hdm.library import build_problem, read_map, simulate_port
    from v2hdm.localization.run import localize
    from v2hdm.mapping.options import MappingOptions
    from v2hdm.pipeline.detect_images import detect_images
    from v2hdm.pipeline.map_drive import map_drive
    from v2hdm.pipeline.result import Result
    from v2hdm.records import Calibration, HDMap
    from v2hdm.verdict.inputs.drive import check_drive
    from v2hdm.verdict.verdict import Verdict

__version__ = "1.0.0"
__all__ = [
    "Calibration", "Detector", "DetectorOptions", "HDMap", "MappingOptions", "Problem", "ReadOptions",
    "Result", "V2hdmError", "Verdict", "build_problem", "calibrate_from_ground", "calibrate_from_points",
    "check_drive", "detect_images", "localize", "map_drive", "read_drive", "read_map", "simulate_port",
    "solve",
]  # fmt: skip

_HOMES = {
    "adjust.problem": "Problem", "adjust.solve": "solve", "calibration.from_ground": "calibrate_from_ground",
    "calibration.from_points": "calibrate_from_points", "detection.detector": "Detector",
    "detection.options": "DetectorOptions", "errors": "V2hdmError", "io.drive": "ReadOptions read_drive",
    "library": "build_problem read_map simulate_port", "localization.run": "localize",
    "mapping.options": "MappingOptions", "pipeline.detect_images": "detect_images",
    "pipeline.map_drive": "map_drive", "pipeline.result": "Result", "records": "Calibration HDMap",
    "verdict.inputs.drive": "check_drive", "verdict.verdict": "Verdict",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    module = next((one for one, names in _HOMES.items() if name in names.split()), None)
    if module is None:
        raise AttributeError(f"module 'v2hdm' has no attribute '{name}'")
    try:
        home = importlib.import_module(f"v2hdm.{module}")
    except ModuleNotFoundError as missing:
        if (missing.name or "v2hdm").split(".")[0] == "v2hdm":
            raise
        line = f"v2hdm.{name} needs {missing.name}: install the map extra, pip install 'v2hdm[map]'"
        raise ModuleNotFoundError(line, name=missing.name) from None
    globals()[name] = found = getattr(home, name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
