"""The public names with wrong arguments: one sentence names the argument, and none is taken silently."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import v2hdm
from v2hdm.adjust.problem import SolveOptions
from v2hdm.doors import checked
from v2hdm.errors import ConfigError, V2hdmError
from v2hdm.records import Drive
from v2hdm.simulate.port.config import PortConfig


class Door(NamedTuple):
    """A public name as it is called rightly, and the arguments of which each is replaced by wrong ones."""

    call: Callable[..., Any]
    right: Mapping[str, Any]


WRONG: Mapping[str, Any] = {
    "nothing": None,
    "a number": 3,
    "a fraction": 0.5,
    "not a number": float("nan"),
    "below zero": -1,
    "a text": "x",
    "a dict": {},
    "a list of numbers": [1, 2],
    "bytes": b"x",
    "a truth": True,
    "an array": np.zeros(2),
    "an object": object(),
}

TAKEN = {
    # Values of the table that an argument may well have.
    "workers": {"a number"},
    "limit": {"a number", "nothing"},
    "linear": {"a truth"},
    "live": {"a truth"},
    "ground": {"a truth", "a dict"},
    "all_maps": {"a truth"},
    "mosaic": {"a truth"},
    "accuracy_goal_cm": {"a number", "a fraction"},
    "tolerance_m": {"a number", "a fraction"},
    "pixel_sigma": {"a number", "a fraction"},
    "survey_sigma": {"a number", "a fraction"},
    "max_gap_s": {"a number", "a fraction"},
    "max_range_m": {"a number", "a fraction"},
    "threads": {"a number"},
    "corner_count": {"a number"},
    "image_bgr": {"an array"},
    "blur_px": {"a number", "a fraction"},
    "centre_vehicle": {"nothing", "an array"},
    "crs": {"nothing"},
    "covariance": {"nothing", "an array"},
    "origin": {"nothing"},
    "name": {"nothing", "a text"},
    "cache": {"nothing", "a text"},
    "camera_name": {"nothing"},
    "mounting": {"nothing"},
    "largest_id": {"a number", "below zero"},
    "estimate_read_out": {"a truth"},
    "intrinsic": {"an array"},
    "cam_from_vehicle": {"an array"},
}
OPTIONAL = {
    "options", "detector", "reading", "base", "corrections", "progress", "config", "detections", "camera",
    "stopwatch", "path", "model", "blur_px", "results",
}  # fmt: skip
"""Arguments that None leaves out."""

FILES = {
    "drive",
    "path",
    "points",
    "folder",
    "source",
    "base",
    "corrections",
    "camera",
    "model",
    "design",
    "results",
}
"""Arguments that may be a path: that of no file is refused as such."""


def doors_of_classes(drive: Drive) -> Mapping[str, Door]:
    """The constructors and methods, with arguments of a drive."""
    info = drive.cameras["front"].info
    detector = v2hdm.Detector.load()
    pixels = np.zeros((info.height, info.width, 3), np.uint8)
    return {
        "Detector": Door(v2hdm.Detector, {"network": detector.network, "options": detector.options}),
        "Detector.load": Door(v2hdm.Detector.load, {"path": None, "options": None}),
        "Detector.detect": Door(detector.detect, {"image_bgr": pixels, "camera": drive.cameras["front"]}),
        "DetectorOptions": Door(
            v2hdm.DetectorOptions,
            {"model": None, "device": "cpu", "threads": 1, "blur_px": None, "max_range_m": 22.0},
        ),
        "HDMap": Door(v2hdm.HDMap, {"markings": (), "lanes": (), "origin": None, "largest_id": 0}),
        "Calibration": Door(
            v2hdm.Calibration, {"info": info, "cam_from_vehicle": np.eye(4), "covariance": None}
        ),
        "Verdict": Door(v2hdm.Verdict, {"findings": ()}),
        "Verdict.of": Door(v2hdm.Verdict.of, {"findings": []}),
    }  # fmt: skip


@pytest.fixture(scope="module")
def doors(small_drive, tmp_path_factory) -> Mapping[str, Door]:
    folder = tmp_path_factory.mktemp("doors")
    drive = v2hdm.read_drive(small_drive)
    info = drive.cameras["front"].info
    calibration = v2hdm.Calibration(info, np.eye(4))
    empty = v2hdm.HDMap(())
    return {
        "read_drive": Door(v2hdm.read_drive, {"path": drive.root, "options": None}),
        "read_map": Door(v2hdm.read_map, {"path": folder}),
        "compare_maps": Door(
            v2hdm.compare_maps, {"built": empty, "design": empty, "tolerance_m": 0.05, "results": None}
        ),
        "check_drive": Door(
            v2hdm.check_drive, {"drive": drive, "ground": False, "workers": 1, "progress": None}
        ),
        "calibrate_from_ground": Door(
            v2hdm.calibrate_from_ground, {"drive": drive, "workers": 1, "progress": None}
        ),
        "calibrate_from_points": Door(
            v2hdm.calibrate_from_points,
            {"points": folder / "points.csv", "info": info, "pixel_sigma": 0.5, "survey_sigma": 0.01},
        ),
        "detect_images": Door(
            v2hdm.detect_images,
            {
                "source": drive.root, "camera": None, "camera_name": None, "mounting": None, "linear": False,
                "detector": None, "limit": None, "live": False, "stopwatch": None,
            },
        ),
        "localize": Door(
            v2hdm.localize,
            {
                "hd_map": empty, "drive": drive, "calibrations": {"front": calibration}, "detections": None,
                "workers": 1, "progress": None,
            },
        ),
        "map_drive": Door(
            v2hdm.map_drive,
            {
                "drive": drive, "options": None, "detector": None, "reading": None, "base": None,
                "corrections": None, "accuracy_goal_cm": 5.0, "name": None, "cache": None, "workers": 1,
            },
        ),
        "build_problem": Door(v2hdm.build_problem, {"drive": drive, "detections": [], "options": None}),
        "simulate_port": Door(
            v2hdm.simulate_port, {"folder": folder, "config": None, "workers": 1, "progress": None}
        ),
        "solve": Door(v2hdm.solve, {"problem": problem_of(), "options": None}),
        **doors_of_classes(drive),
    }  # fmt: skip


NAMES = {
    "read_drive": ("path", "options"),
    "read_map": ("path",),
    "compare_maps": ("built", "design", "tolerance_m", "results"),
    "check_drive": ("drive", "ground", "workers", "progress"),
    "calibrate_from_ground": ("drive", "workers", "progress"),
    "calibrate_from_points": ("points", "info", "pixel_sigma", "survey_sigma"),
    "detect_images": (
        "source", "camera", "camera_name", "mounting", "linear", "detector", "limit", "live", "stopwatch",
    ),
    "localize": ("hd_map", "drive", "calibrations", "detections", "workers", "progress"),
    "map_drive": (
        "drive", "options", "detector", "reading", "base", "corrections", "accuracy_goal_cm", "name", "cache",
        "workers",
    ),
    "build_problem": ("drive", "detections", "options"),
    "simulate_port": ("folder", "config", "workers", "progress"),
    "solve": ("problem", "options"),
    "Detector": ("network", "options"),
    "Detector.load": ("path", "options"),
    "Detector.detect": ("image_bgr", "camera"),
    "DetectorOptions": ("model", "device", "threads", "blur_px", "max_range_m"),
    "HDMap": ("markings", "lanes", "origin", "largest_id"),
    "Calibration": ("info", "cam_from_vehicle", "covariance"),
    "Verdict": ("findings",),
    "Verdict.of": ("findings",),
}  # fmt: skip


def is_right(argument, wrong):
    allowed = set(TAKEN.get(argument, ()))
    if argument in OPTIONAL:
        allowed.add("nothing")
    return wrong in allowed


TABLE = [
    (name, argument, wrong)
    for name, arguments in NAMES.items()
    for argument in arguments
    for wrong in WRONG
    if not is_right(argument, wrong)
    # A folder that is not there is made, and the source of images may be a live camera's number.
    and (argument, wrong) not in {("folder", "a text"), ("source", "a number"), ("source", "below zero")}
    and (name, argument, wrong)
    not in {("DetectorOptions", "model", "a text"), ("localize", "calibrations", "a dict")}
]


@pytest.mark.parametrize(("name", "argument", "wrong"), TABLE)
def test_a_wrong_argument_is_one_sentence_that_names_it(name, argument, wrong, doors, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    door = doors[name]
    with pytest.raises(V2hdmError) as refused:
        door.call(**{**door.right, argument: WRONG[wrong]})
    said = str(refused.value)
    assert "\n" not in said
    assert len(said) < 400
    is_path = argument in FILES and wrong == "a text"
    assert is_path or argument in said or f"--{argument.replace('_', '-')}" in said
    assert not any(tmp_path.iterdir())


def test_the_table_has_more_than_200_wrong_calls_at_every_public_function():
    assert len(TABLE) > 200
    functions = {name for name in v2hdm.__all__ if name[0].islower()}
    assert functions <= NAMES.keys()


@pytest.mark.parametrize("kind", [v2hdm.ReadOptions, v2hdm.MappingOptions, SolveOptions, PortConfig])
def test_settings_of_a_wrong_type_are_refused_where_they_are_used(kind, doors, tmp_path):
    drive = doors["check_drive"].right["drive"]
    uses = {
        v2hdm.ReadOptions: lambda: v2hdm.read_drive(drive.root, v2hdm.ReadOptions(cameras="front")),
        v2hdm.MappingOptions: lambda: v2hdm.map_drive(drive, options=v2hdm.MappingOptions(rounds="2")),
        SolveOptions: lambda: v2hdm.solve(problem_of(), SolveOptions(max_refreshes="x")),
        PortConfig: lambda: v2hdm.simulate_port(tmp_path, PortConfig(name="port", seed="x")),
    }
    with pytest.raises(V2hdmError, match=r"(cameras|rounds|max_refreshes|seed) is '"):
        uses[kind]()


def problem_of():
    from v2hdm.adjust.problem import Observations

    none = np.zeros(0, dtype=np.int64)
    observations = Observations(none, none, none, np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0))
    poses = np.eye(4)[None]
    return v2hdm.Problem(np.array([[500.0, 500, 320, 240]]), poses, poses, observations, 0)


@pytest.mark.parametrize("device", ["x", "cuda:99", "tpu"])
def test_a_device_that_is_not_there_is_named(device, doors):
    drive = doors["check_drive"].right["drive"]
    with pytest.raises(V2hdmError, match=f"device is '{device}'"):
        v2hdm.solve(problem_of(), SolveOptions(device=device))
    with pytest.raises(ConfigError, match=f"device is '{device}'"):
        v2hdm.map_drive(drive, options=v2hdm.MappingOptions(device=device))


def test_a_number_of_corners_below_zero_is_refused():
    with pytest.raises(ConfigError, match="corner_count is -1: give a whole number, 0 or more"):
        replace(problem_of(), corner_count=-1)


def test_no_drive_at_all_is_named():
    with pytest.raises(ConfigError, match="no drive is given"):
        v2hdm.map_drive([])


def test_a_function_shows_progress_and_nothing_else_does():
    with pytest.raises(ConfigError, match="no drive is given"):
        v2hdm.map_drive([], progress=lambda task, done, total: None)
    with pytest.raises(ConfigError, match="progress is 3: give a function"):
        v2hdm.map_drive([], progress=3)


def test_a_drive_without_images_is_named(doors):
    none = replace(doors["check_drive"].right["drive"], images=())
    for door in (v2hdm.check_drive, v2hdm.calibrate_from_ground, v2hdm.map_drive):
        with pytest.raises(V2hdmError, match="drive port: has no image"):
            door(none)


def test_detections_of_another_drive_are_named(doors):
    from v2hdm.records import ImageDetections

    drive = doors["check_drive"].right["drive"]
    other = [ImageDetections(len(drive.images), (), ())]
    with pytest.raises(V2hdmError, match="detections of image 22 are not of drive port: the drive"):
        v2hdm.build_problem(drive, other)


def test_a_file_is_no_cache(doors, tmp_path):
    (tmp_path / "cache").touch()
    with pytest.raises(ConfigError, match="cache: is a file; give a folder"):
        v2hdm.map_drive(doors["check_drive"].right["drive"], cache=tmp_path / "cache")


def test_a_mounting_of_two_numbers_is_named(doors):
    with pytest.raises(ConfigError, match="--mounting: 2 numbers"):
        v2hdm.detect_images(doors["check_drive"].right["drive"].root, mounting=(1.5, 10.0))


def test_numbers_of_numpy_are_numbers():
    @checked
    def door(count: int, share: float, is_on: bool, names: list[str], path: str | Path) -> None:
        """Nothing."""

    door(np.int64(3), np.float32(0.5), np.bool_(True), ["a"], Path())
    with pytest.raises(ConfigError, match=r"names is \[1, 2\]: give a list of a text"):
        door(1, 0.5, True, [1, 2], "x")
