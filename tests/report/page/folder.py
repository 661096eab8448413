"""Result folders to make reports of: a drive past a few diamonds, drawn, and a site of any size."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from tests.cameras import level
from tests.drive.example import looking_forward
from v2hdm.geometry.ipm import ipm_from_extrinsic, project_ground
from v2hdm.io.calibration.writing import write_calibration
from v2hdm.io.drive import Trajectory
from v2hdm.io.drive.writing import write_drive
from v2hdm.io.maps.evidence import Residuals, write_exclusions, write_residuals
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.trajectory import write_tum
from v2hdm.records import (
    ARROW,
    DIAMOND,
    LANE_LINE,
    Calibration,
    Camera,
    CameraInfo,
    Drive,
    Exclusion,
    HDMap,
    Image,
    Lane,
    Marking,
    Symbol,
)
from v2hdm.store.files import write_json
from v2hdm.store.results import result_folder

INFO = CameraInfo("front", 640, 480, np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]]))
DIAMOND_M = np.array([[0.5, 0.0], [0.0, 0.35], [-0.5, 0.0], [0.0, -0.35]])
PLACES = np.array([[6.0, 0.0], [7.5, 1.2], [7.5, -1.2], [9.0, 0.0]])
NASTY = "</script><img src=x onerror=alert(1)>&\"'"
NASTY_NAME = NASTY.replace("/", "")
"""The part of :data:`NASTY` that a file's name may have."""
SHIFT_PX = np.array([0.3, -0.2])


def covariance(sigma_m: float = 0.01) -> np.ndarray:
    """Covariance of corners that share half of their variance."""
    return sigma_m**2 * (0.5 * np.eye(8) + 0.5 * np.tile(np.eye(2), (4, 4)))


def small_map(names: str = DIAMOND) -> HDMap:
    markings = [
        Marking(names, DIAMOND_M + place, 4, covariance(), 0.004, accuracy=grade)
        for place, grade in zip(PLACES, "AABC", strict=True)
    ]
    lane = Lane(LANE_LINE, np.column_stack([np.linspace(0, 12, 25), np.full(25, 2.4)]), 4)
    arrow = Symbol(ARROW, np.array([[4.5, -0.2], [5.2, 0.0], [4.5, 0.2]]), 3, 0.02, accuracy="A")
    return HDMap(tuple(markings), (lane,), symbols=(arrow,))


def verdict(status: str = "PASS") -> dict[str, object]:
    finding = {
        "check": "clock", "status": status, "value": 31.25, "limit": 15.0, "unit": "ms",
        "says": f"images are late: {NASTY}", "about": "front",
    }  # fmt: skip
    raised = [finding] if status != "PASS" else []
    passed = {**finding, "status": "PASS", "value": 0.0004, "says": "on one clock"}
    unobservable = {**finding, "status": "PASS", "value": None, "says": "constant speed: include a turn"}
    headline = f"{status}: 95 % of 12 markings within 2.1 cm; goal 5 cm"
    lists = {"findings": raised, "unobservable": [unobservable], "passed": [passed]}
    return {"status": status, "headline": headline, **lists}


GONE = (DIAMOND_M + np.array([4.5, 1.2])).tolist()


def changes() -> dict[str, object]:
    """As ``metrics.json`` lists them: the first marking has come 30 cm north, another one is gone."""
    sighted = {"class": DIAMOND, "probability": 0.99, "found": 0, "views": 7}
    now = DIAMOND_M + PLACES[0]
    before = (now - np.array([0.0, 0.3])).tolist()
    moved = {"id": 1, "fate": "moved", "before_map": before, "after_map": now.tolist()}
    gone = {"id": 9, "fate": "vanished", "before_map": GONE, "after_map": None}
    by = {"shift_m": [0.0, 0.3], "shift_sigma_m": [0.01, 0.01]}
    return {"listed": [{**sighted, **moved, **by}, {**sighted, **gone, **dict.fromkeys(by)}]}


def make_result(folder: Path, name: str = "small", kind: str = DIAMOND, status: str = "PASS") -> Drive:
    """Write a result into ``folder/result`` and its drive into ``folder/drive``, which is returned."""
    hd_map, cam_from_vehicle = small_map(kind), looking_forward(2.0, 0.25)
    poses = level(0.8 * np.arange(5))
    drive = _write_drive(folder / "drive", name, hd_map, poses, cam_from_vehicle)
    with result_folder(folder / "result") as result:
        write_geojson(hd_map, result / "map.geojson", verdict(status))
        excluded = [Exclusion(kind, np.array([8.0, 2.0]), 2, f"its place is unsure {NASTY}", "front")]
        write_exclusions(excluded, result / "excluded.geojson", None, None)
        calibration = Calibration(INFO, cam_from_vehicle, np.diag([4e-6] * 3 + [1e-8] * 3))
        write_calibration(calibration, result / "calibration_front.yaml", clock_s=(0.001, 0.0005))
        stamp_s = np.array([image.stamp_s for image in drive.images])
        write_tum(Trajectory(stamp_s, poses), result / "trajectory.tum")
        rows = [f"{stamp:.9f},1,0.01,0.01,0.002,0.0002,0.0002,0.0003" for stamp in stamp_s]
        heading = "stamp_s,seen,forward_m,left_m,up_m,roll_rad,pitch_rad,heading_rad"
        (result / "trajectory_sigma.csv").write_text("\n".join([heading, *rows]) + "\n")
        write_residuals(_residuals(drive, hd_map, poses, cam_from_vehicle), result / "residuals.csv")
        (result / "config.yaml").write_text(f"name: {name}\n")
        columns = ("marking", "p", "p_shape", "p_residuals", "p_sightings", "disputed")
        suspicious = [(2, 3e-5, 1e-5, 0.4, 0.2, 0.25), (99, 1.0, 1.0, 1.0, 1.0, 0.0)]
        figures = {
            "markings": len(hd_map.markings), "reprojection_rmse_px": 0.36, "lanes": {"length_m": 12.0},
            "suspicious": [dict(zip(columns, row, strict=True)) for row in suspicious],
        }  # fmt: skip
        metrics = {
            "name": name, "version": "0.1.0", "date": "2026-11-23", "verdict": verdict(status),
            "drive": {"name": name, "paths": [str(drive.root)], "cameras": ["front"], "images": 5},
            "results": {"front": {"Opt": figures}}, "seconds": {"detect": 1.5},
            "extrinsics": {"front": {"certainty": "front: the drive determines both", "x_change_m": 0.1}},
            "changes": changes(),
        }  # fmt: skip
        write_json(result / "metrics.json", metrics)
    return drive


def _write_drive(
    folder: Path, name: str, hd_map: HDMap, poses: np.ndarray, cam_from_vehicle: np.ndarray
) -> Drive:
    """Grey ground, white diamonds."""
    (folder / "front").mkdir(parents=True)
    images = []
    for i, pose in enumerate(poses):
        pixels = np.full((480, 640, 3), 90, np.uint8)
        for marking in hd_map.markings:
            px, depth_m = project_ground(
                INFO.intrinsic, cam_from_vehicle @ np.linalg.inv(pose), marking.corners_map
            )
            if (depth_m > 0).all():
                cv2.fillPoly(pixels, [np.round(px).astype(np.int32)], (235, 235, 235))
        path = folder / "front" / f"{i}.png"
        cv2.imwrite(str(path), pixels)
        images.append(Image("front", 10.0 + 0.2 * i, path, pose))
    roi = np.array([[3.0, -3], [12, -3], [12, 3], [3, 3]])
    camera = Camera(INFO, {"estimated": ipm_from_extrinsic(INFO, cam_from_vehicle)}, "estimated", roi)
    drive = Drive(name, folder, {"front": camera}, images)
    stamp_s = np.array([image.stamp_s for image in images])
    write_drive(folder, drive, Trajectory(stamp_s, poses))
    return drive


def _residuals(drive: Drive, hd_map: HDMap, poses: np.ndarray, cam_from_vehicle: np.ndarray) -> Residuals:
    """All corners in all images, each :data:`SHIFT_PX` off."""
    rows, observed_px = [], []
    for i, pose in enumerate(poses):
        for j, marking in enumerate(hd_map.markings):
            px, _ = project_ground(
                INFO.intrinsic, cam_from_vehicle @ np.linalg.inv(pose), marking.corners_map
            )
            rows += [(i, j + 1, c) for c in range(4)]
            observed_px += list(px - SHIFT_PX)
    table, count = np.array(rows), len(rows)
    return Residuals(
        image=tuple(image.path.relative_to(drive.root).as_posix() for image in drive.images),
        camera=("front",) * len(poses),
        taken_s=np.array([image.stamp_s for image in drive.images]),
        row_image=table[:, 0],
        marking=table[:, 1],
        corner=table[:, 2],
        is_point=np.ones(count, dtype=bool),
        observed_px=np.array(observed_px),
        residual_px=np.tile(SHIFT_PX, (count, 1)),
        distance_sigma=np.full(count, 1.2),
    )


def make_site(folder: Path, count: int) -> None:
    """Write the result of a site of ``count`` diamonds and its lane lines, without a drive."""
    side = int(np.ceil(np.sqrt(count)))
    random = np.random.default_rng(7)
    places = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)[:count] * 4.5
    marking = Marking(DIAMOND, DIAMOND_M, 12, covariance(), 0.004)
    markings = [
        replace(marking, corners_map=DIAMOND_M + place + random.normal(0, 0.1, 2)) for place in places
    ]
    along = np.arange(0, side * 4.5, 0.5)
    lanes = [
        Lane(LANE_LINE, np.column_stack([along, np.full(len(along), row * 9.0 + 2.2)]), 9)
        for row in range(side // 2)
    ]
    hd_map = HDMap(tuple(markings), tuple(lanes))
    metrics = {
        "name": f"{count} markings", "version": "0.1.0", "verdict": verdict(),
        "results": {"front": {"Opt": {"markings": count}}},
    }  # fmt: skip
    with result_folder(folder) as result:
        write_geojson(hd_map, result / "map.geojson")
        write_json(result / "metrics.json", metrics)
