"""A drive written as nuScenes' four tables is the same drive."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.drive.bags import assert_mounted, assert_same_poses, mountings
from tests.drive.example import make_drive
from v2hdm.errors import DriveError
from v2hdm.io.drive import read_drive
from v2hdm.records import Drive, FloatArray

Tables = dict[str, list[dict[str, Any]]]


def placed(pose: FloatArray) -> dict[str, Any]:
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    return {"translation": pose[:3, 3].tolist(), "rotation": [w, x, y, z]}


def tables(drive: Drive, root: Path) -> Tables:
    assert drive.recorded is not None
    out: Tables = {name: [] for name in ("sensor", "calibrated_sensor", "ego_pose", "sample_data")}
    for name, cam_from_vehicle in mountings().items():
        out["sensor"].append({"token": f"s{name}", "channel": name, "modality": "camera"})
        intrinsic = drive.cameras[name].info.intrinsic.tolist()
        out["calibrated_sensor"].append(
            {"token": f"c{name}", "sensor_token": f"s{name}", "camera_intrinsic": intrinsic}
            | placed(np.linalg.inv(cam_from_vehicle))
        )
    poses = zip(drive.recorded.stamp_s, drive.recorded.map_from_vehicle, strict=True)
    for k, (stamp_s, pose) in enumerate(poses):
        out["ego_pose"].append({"token": f"e{k}", "timestamp": round(stamp_s * 1e6)} | placed(pose))
    for k, image in enumerate(drive.images):
        out["sample_data"].append({
            "token": f"d{k}", "ego_pose_token": "e0", "calibrated_sensor_token": f"c{image.camera}",
            "timestamp": round(image.stamp_s * 1e6), "width": 64, "height": 48,
            "filename": image.path.relative_to(root).as_posix(),
        })  # fmt: skip
    return out


def write(root: Path, change: Callable[[Tables], object]) -> Drive:
    make_drive(root)
    drive = read_drive(root)
    content = tables(drive, root)
    change(content)
    (root / "v1.0-mini").mkdir()
    for name, rows in content.items():
        (root / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows))
    (root / "drive.yaml").unlink()
    return drive


def test_four_tables_are_the_same_drive(tmp_path: Path) -> None:
    expected = write(tmp_path, lambda content: None)
    got = read_drive(tmp_path)
    assert [image.path for image in got.images] == [image.path for image in expected.images]
    assert_same_poses(got, expected)
    assert_mounted(got)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: content["sample_data"].clear(), "no image of a camera"),
        (lambda content: content["sensor"].clear(), "sensor_token names no row"),
        (lambda content: content["ego_pose"].clear(), "ego_pose: holds no pose"),
        (lambda content: content["ego_pose"][3].update(rotation=[1, 1, 0, 0]), "quaternion of norm 1.41421"),
        (lambda content: content["sample_data"][0].update(timestamp="now"), "timestamp: expected a finite"),
        (lambda content: content["sample_data"][0].pop("token"), "a list of rows with a 'token' each"),
        (lambda content: content["calibrated_sensor"][0].update(camera_intrinsic=[]), "expected 3 x 3"),
        (
            lambda content: (
                content["calibrated_sensor"].append(content["calibrated_sensor"][0] | {"token": "other"}),
                content["sample_data"][0].update(calibrated_sensor_token="other"),
            ),
            "2 calibrations: these are several recordings",
        ),
    ],
)
def test_damaged_tables_are_refused_in_one_line(
    change: Callable[[Tables], object], message: str, tmp_path: Path
) -> None:
    write(tmp_path, change)
    with pytest.raises(DriveError, match=message) as caught:
        read_drive(tmp_path)
    assert "\n" not in str(caught.value)
