"""A folder in which the documents' commands find what they name, all of it from one small rendered drive."""

import shutil
from pathlib import Path

import cv2
import numpy as np

from tests.drive.bags import messages_of, write_ros2
from v2hdm.geometry.ipm import apply_homography, pinhole_px_from_ground
from v2hdm.geometry.lens import distort_points
from v2hdm.io.drive import read_drive
from v2hdm.io.drive.truth import read_truth
from v2hdm.io.maps.geopackage import write_geopackage
from v2hdm.io.maps.reading import read_geojson
from v2hdm.records import Drive, Truth
from v2hdm.store.results import listed_files

_COPIES = ("mysite", "monday", "friday", "port2_again")
_PLACES = [
    [8.0, 1.5], [8.0, -1.5], [9.0, 0.0], [10.5, 3.0], [10.5, -3.0],
    [13.0, 1.5], [13.0, -1.5], [16.0, 4.0], [16.0, -4.0], [16.0, 0.0],
]  # fmt: skip


def furnish(folder: Path) -> None:
    """Add drives, results, a recording, tables and images to the cache and result of ``+run=port2``."""
    (rendered,) = (folder / "cache").glob("port2-*")
    for name in _COPIES:
        copy = folder / "drives" / name
        shutil.copytree(rendered, copy)
        described = (copy / "drive.yaml").read_text()
        (copy / "drive.yaml").write_text(described.replace("name: port2", f"name: {name}"))
    result = folder / "outputs" / "port2"
    for name in ("monday", "friday"):
        shutil.copytree(result, folder / "outputs" / name)
    drive = read_drive(rendered)
    truth = read_truth(drive)
    _lay_out_recording(folder, rendered)
    survey_camera(folder, drive, truth)
    shutil.copy(result / "map.geojson", folder)
    with listed_files(folder, "--output", "v2hdm export of map.geojson"):
        write_geopackage(read_geojson(result / "map.geojson"), folder / "map.gpkg")
    shutil.copy(result / "calibration_front.yaml", folder)
    guess = {"front": truth.cam_from_vehicle["front"]}
    write_ros2(folder / "site", messages_of(rendered, mounted=guess))


def _lay_out_recording(folder: Path, rendered: Path) -> None:
    """Lay out the recording that a vehicle brings home, and single images of it."""
    recording = folder / "recording"
    shutil.copytree(rendered / "front", recording / "front")
    shutil.copy(rendered / "poses.tum", recording)
    (folder / "images").mkdir()
    for image in sorted((rendered / "front" / "images").iterdir())[:3]:
        shutil.copy(image, folder / "images")
    shutil.copy(rendered / "front" / "camera_info.yaml", folder)
    cv2.imwrite(str(folder / "yard.png"), cv2.imread(str(image)))
    shutil.copy(image, folder / "image.jpg")


def survey_camera(folder: Path, drive: Drive, truth: Truth) -> None:
    """``points.csv``: ten places on the ground, and the pixels that show them."""
    info = drive.cameras["front"].info
    rng = np.random.default_rng(3)
    pinhole = pinhole_px_from_ground(info.intrinsic, truth.cam_from_vehicle["front"])
    places = np.array(_PLACES)
    px = distort_points(info, apply_homography(pinhole, places)) + rng.normal(0, 0.4, places.shape)
    measured = places + rng.normal(0, 0.01, places.shape)
    rows = [
        f"P{n},{u:.2f},{v:.2f},{x:.3f},{y:.3f}" for n, (u, v, x, y) in enumerate(np.hstack([px, measured]), 1)
    ]
    (folder / "points.csv").write_text("\n".join(["name,u,v,x,y", *rows]) + "\n")
