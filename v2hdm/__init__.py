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
    from v2hdm.library import build_problem, compare_maps, read_map, simulate_port
    from v2hdm.localization.localizer import Localizer
    from v2hdm.localization.run import localize
    from v2hdm.mapping.options import MappingOptions
    from v2hdm.pipeline.detect_images import detect_images
    from v2hdm.pipeline.map_drive import map_drive
    from v2hdm.pipeline.result import Result
    from v2hdm.records import Calibration, HDMap
    from v2hdm.verdict.inputs.drive import check_drive
    from v2hdm.verdict.verdict import Verdict

__version__ = "1.1.0"
__all__ = [
    "Calibration", "Detector", "DetectorOptions", "HDMap", "Localizer", "MappingOptions", "Problem",
    "ReadOptions", "Result", "V2hdmError", "Verdict", "build_problem", "calibrate_from_ground",
    "calibrate_from_points", "check_drive", "compare_maps", "detect_images", "localize", "map_drive",
    "read_drive", "read_map", "simulate_port", "solve",
]  # fmt: skip

_MODULES = {
    "Calibration": "v2hdm.records",
    "Detector": "v2hdm.detection.detector",
    "DetectorOptions": "v2hdm.detection.options",
    "HDMap": "v2hdm.records",
    "Localizer": "v2hdm.localization.localizer",
    "MappingOptions": "v2hdm.mapping.options",
    "Problem": "v2hdm.adjust.problem",
    "ReadOptions": "v2hdm.io.drive",
    "Result": "v2hdm.pipeline.result",
    "V2hdmError": "v2hdm.errors",
    "Verdict": "v2hdm.verdict.verdict",
    "build_problem": "v2hdm.library",
    "calibrate_from_ground": "v2hdm.calibration.from_ground",
    "calibrate_from_points": "v2hdm.calibration.from_points",
    "check_drive": "v2hdm.verdict.inputs.drive",
    "compare_maps": "v2hdm.library",
    "detect_images": "v2hdm.pipeline.detect_images",
    "localize": "v2hdm.localization.run",
    "map_drive": "v2hdm.pipeline.map_drive",
    "read_drive": "v2hdm.io.drive",
    "read_map": "v2hdm.library",
    "simulate_port": "v2hdm.library",
    "solve": "v2hdm.adjust.solve",
}
"""The module of each public name, which is imported when the name is first used."""


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'v2hdm' has no attribute '{name}'")
    try:
        module = importlib.import_module(_MODULES[name])
    except ModuleNotFoundError as missing:
        if (missing.name or "v2hdm").split(".")[0] == "v2hdm":
            raise
        line = f"v2hdm.{name} needs {missing.name}: install the map extra, pip install 'v2hdm[map]'"
        raise ModuleNotFoundError(line, name=missing.name) from None
    globals()[name] = getattr(module, name)
    return globals()[name]


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
