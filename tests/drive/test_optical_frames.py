"""Cameras by the frames that their messages name: optical ones, bodies' ones, and those that are missing."""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.drive.bags import messages_of, write_ros2
from tests.drive.test_frames import OPTICAL, at
from v2hdm.cli.main import run
from v2hdm.errors import DriveError
from v2hdm.geometry.rigid import quaternion_from_rotation
from v2hdm.io.drive import ReadOptions, read_drive
from v2hdm.io.importers.bag.frames import Frames
from v2hdm.io.importers.bag.mountings import is_optical, mount_of, mounting_of

pytestmark = pytest.mark.usefixtures("working_directory")

BASE = "base_link"
PITCHES_DEG = [0.0, 17.0, 45.0, 60.0, 75.0, 89.0]


def tree(edges):
    """The frames of fixed edges (4, 4)."""
    return Frames(
        {
            edge: np.array(
                [[0.0, *matrix[:3, 3], *quaternion_from_rotation(matrix[None, :3, :3])[0], 1.0]], dtype=float
            )
            for edge, matrix in edges.items()
        }
    )


@pytest.mark.parametrize("pitch_deg", PITCHES_DEG)
@pytest.mark.parametrize("yaw_deg", [0, 90, 180, -120])
@pytest.mark.parametrize("roll_deg", [0, 8, -8])
def test_a_body_s_frame_is_told_from_an_optical_one(roll_deg, pitch_deg, yaw_deg):
    body = at(1, 0, 2, roll_deg, pitch_deg, yaw_deg)
    assert is_optical(body @ OPTICAL)
    assert not is_optical(body)


@pytest.mark.parametrize("roll_deg", [90, -90, 180])
@pytest.mark.parametrize("pitch_deg", [10, 30, 60])
def test_a_camera_that_is_mounted_on_its_side_is_optical(pitch_deg, roll_deg):
    assert is_optical(at(1, 0, 2, 0, pitch_deg, 0) @ at(0, 0, 0, roll_deg, 0, 0) @ OPTICAL)


def test_the_optical_frame_that_hangs_on_the_named_one_is_meant():
    body = at(3.4, -0.1, 2.6, 0, 17, 0)
    for child in ("camera_link_optical", "camera_optical_frame", "r1/camera_rgb_optical_frame"):
        frames = tree({(BASE, "camera_link"): body, ("camera_link", child): OPTICAL})
        mount = mount_of(frames, BASE, ["camera_link"], "camera")
        assert mount.frame == child
        np.testing.assert_allclose(mount.vehicle_from_cam, body @ OPTICAL, atol=1e-9)
    # Behind another frame of the camera, and one of two by the camera's name.
    frames = tree({
        (BASE, "camera_link"): body, ("camera_link", "left_frame"): at(0, 0.1, 0),
        ("left_frame", "left_optical"): OPTICAL, ("camera_link", "depth_optical"): OPTICAL,
    })  # fmt: skip
    assert mount_of(frames, BASE, ["camera_link"], "left").frame == "left_optical"
    answer = mount_of(frames, BASE, ["camera_link"], "front")
    assert answer.vehicle_from_cam is None
    assert "several hang on it: left_optical, depth_optical" in answer.problem.replace(
        "depth_optical, left_optical", "left_optical, depth_optical"
    )


def test_a_frame_that_is_not_optical_is_named_with_the_mounting_that_its_turn_gives():
    mount = mount_of(
        tree({(BASE, "camera_link"): at(3.4, -0.1, 2.6, 0, 17, 5)}), BASE, ["camera_link"], "camera"
    )
    assert (mount.frame, mount.vehicle_from_cam) == ("", None)
    assert (
        "camera_link is not an optical frame: its z axis, along which a camera looks, points 73 deg up"
        in mount.problem
    )
    offer = yaml.safe_load(mount.offer.strip("'"))
    assert offer == {"xyz_m": [3.4, -0.1, 2.6], "rpy_deg": [0.0, 17.0, 5.0]}


def test_images_that_name_the_vehicle_are_not_given_another_camera_s_frame():
    frames = tree({(BASE, "rear_optical"): at(-1, 0, 2, 0, 17, 180) @ OPTICAL})
    mount = mount_of(frames, BASE, [BASE], "front")
    assert (mount.frame, mount.vehicle_from_cam) == ("", None)
    assert "name base_link, the vehicle's own frame" in mount.problem


def test_an_info_s_frame_counts_where_the_images_name_none_that_is_known():
    frames = tree({(BASE, "front_optical"): at(1, 0, 2, 0, 17, 0) @ OPTICAL})
    mount = mount_of(frames, BASE, ["camera", "front_optical"], "camera")
    assert mount.frame == "front_optical"
    np.testing.assert_allclose(mounting_of(mount.vehicle_from_cam)["rpy_deg"], [0, 17, 0], atol=1e-6)


def front_alone(folder, edges, frame="camera_link", infos=True):
    messages = messages_of(folder, fixed_frames=False)
    messages.rows = [
        row
        for row in messages.rows
        if not row[1].startswith("/sensing/rear") and (infos or not row[1].endswith("camera_info"))
    ]
    for _, topic, message in messages.rows:
        if topic.startswith("/sensing"):
            message.header.frame_id = frame
    first_s = messages.rows[0][0]
    messages.add(first_s, "/tf_static", messages.transforms(first_s, edges))
    return messages


BODY = at(1.0, 0.0, 1.5, 0, 15, 0)


def test_a_bag_whose_images_name_the_body_s_frame_is_one_answer_away_from_a_drive(folder, tmp_path, capsys):
    bag = write_ros2(tmp_path / "site", front_alone(folder, {(BASE, "camera_link"): BODY}))
    check = ["check", str(bag), "--no-ground", "--output", "out", "--write", "d"]
    assert run(check) == 2
    error = capsys.readouterr().err
    assert "camera_link is not an optical frame" in error
    assert "roi_vehicle" not in error
    (answer,) = re.findall(r"along its x axis: '(\{.*\})'", error)
    assert run([*check, "--set", f"cameras.front.mounting={answer}"]) in (0, 3)
    entry = yaml.safe_load((tmp_path / "d" / "drive.yaml").read_text())["cameras"]["front"]
    assert "frame" not in entry, "a calibration of that frame would be turned"
    assert entry["mounting"] == {"xyz_m": [1.0, 0.0, 1.5], "rpy_deg": [0.0, 15.0, 0.0]}


def test_a_bag_without_intrinsics_asks_for_these_alone(folder, tmp_path, capsys):
    edges = {(BASE, "camera_link"): BODY, ("camera_link", "camera_link_optical"): OPTICAL}
    bag = write_ros2(tmp_path / "site", front_alone(folder, edges, infos=False))
    check = ["check", str(bag), "--no-ground", "--output", "out", "--write", "d"]
    assert run(check) == 2
    assert re.findall(r"--set (\S+)=", capsys.readouterr().err) == ["cameras.front.camera_info"]
    assert run([*check, "--set", f"cameras.front.camera_info={folder / 'front' / 'camera_info.yaml'}"]) in (
        0,
        3,
    )
    entry = yaml.safe_load((tmp_path / "d" / "drive.yaml").read_text())["cameras"]["front"]
    assert entry["frame"] == "camera_link_optical"
    np.testing.assert_allclose(entry["mounting"]["rpy_deg"], [0, 15, 0], atol=1e-6)


def test_a_frame_that_the_transforms_lack_is_answered_by_naming_one_of_theirs(folder, tmp_path, capsys):
    edges = {(BASE, "roof"): BODY, ("roof", "front_cam_optical"): OPTICAL}
    bag = write_ros2(tmp_path / "site", front_alone(folder, edges, frame="usb_cam"))
    check = ["check", str(bag), "--no-ground", "--output", "out", "--write", "d"]
    assert run(check) == 2
    assert "--set cameras.front.frame=front_cam_optical takes one" in capsys.readouterr().err
    assert run([*check, "--set", "cameras.front.frame=front_cam_optical"]) in (0, 3)
    entry = yaml.safe_load((tmp_path / "d" / "drive.yaml").read_text())["cameras"]["front"]
    assert entry["frame"] == "front_cam_optical"
    np.testing.assert_allclose(entry["mounting"]["xyz_m"], [1.0, 0.0, 1.5], atol=1e-6)


def test_a_mounting_that_looks_away_from_the_ground_is_the_mounting_s_fault(folder):
    content = yaml.safe_load((folder / "drive.yaml").read_text())
    content["poses"] = str(folder / "poses.tum")
    content.pop("truth")
    front = content["cameras"]["front"]
    content["cameras"] = {"front": front}
    front |= {key: str(folder / front[key]) for key in ("camera_info", "images")}
    for key in ("ipm", "initial_ipm", "roi_vehicle"):
        front.pop(key)
    front["mounting"] = {"xyz_m": [1.0, 0.0, 1.5], "rpy_deg": [0, -73, 0]}
    Path("drive.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(DriveError, match=r"'front', mounting: its image shows no ground .* points 73 deg up"):
        read_drive(".", ReadOptions(cache="cache"))
