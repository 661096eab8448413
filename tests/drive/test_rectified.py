"""Images that were rectified have the matrix P, no distortion, and a camera that is turned by R."""

from dataclasses import replace

import numpy as np
import pytest
import yaml

from tests.drive.bags import Messages, messages_of, mountings, read, topics_for, write_ros2
from v2hdm.errors import DriveError
from v2hdm.geometry.frames import edges_of
from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.geometry.rigid import inverse, make_transform, rotation_from_euler
from v2hdm.io.calibration.intrinsics import read_rectified_intrinsics
from v2hdm.io.calibration.reading import Provenance, info_of, read_calibration
from v2hdm.io.calibration.writing import write_calibration, write_calibration_as, write_camera_info
from v2hdm.records import Calibration, CameraFrames, CameraInfo
from v2hdm.verdict.inputs.drive import check_camera

RAW = "/sensing/front/image_raw"
TURN = rotation_from_euler(*np.radians([[0.4], [0.9], [-0.3]]))[0]
LENS = CameraInfo(
    "cam", 64, 48, np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]), "plumb_bob", (-0.2, 0, 0, 0, 0)
)


def renamed(folder, topic):
    """The messages of ``folder`` with its front images on ``topic``."""
    messages = messages_of(folder)
    messages.rows = [(at, topic if name == RAW else name, message) for at, name, message in messages.rows]
    return messages


def rectified_bag(folder, path, topic):
    """The bag of ``folder`` whose front images are on ``topic``, turned by TURN, of a lens that bends."""
    messages = renamed(folder, topic)
    for _, name, message in messages.rows:
        if name == "/sensing/front/camera_info":
            message.d[:] = LENS.distortion
            message.p[[0, 5]] = 47.0, 47.5
            message.p[3] = -9.4  # of a stereo pair's right camera
            message.r[:] = TURN.ravel()
    return write_ros2(path, messages)


def drive_of(folder, tmp_path, topic, **info):
    bag = rectified_bag(folder, tmp_path / "site", topic)
    content = topics_for(folder, bag, vehicle_frame="base_link")
    front = content["cameras"]["front"]
    front.pop("ipm", None)
    guess = mountings()["front"].tolist()
    front |= {"images": {"topic": topic}, "cam_from_vehicle": guess, "frame": "front_optical"}
    front["camera_info"] |= info
    return read(tmp_path / "drive", content).cameras["front"]


@pytest.mark.parametrize(
    ("topic", "info"),
    [("/sensing/front/image_rect_color", {}), ("/sensing/front/image_rect", {}), (RAW, {"rectified": True})],
)
def test_rectified_images_have_p_no_distortion_and_a_turned_camera(topic, info, folder, tmp_path):
    camera = drive_of(folder, tmp_path, topic, **info)
    np.testing.assert_array_equal(camera.info.intrinsic[[0, 1], [0, 1]], [47.0, 47.5])
    assert not any(camera.info.distortion)
    turned = make_transform(TURN, np.zeros(3)) @ mountings()["front"]
    np.testing.assert_allclose(camera.ipm["estimated"], ipm_from_extrinsic(camera.info, turned), rtol=1e-12)


def test_focal_lengths_that_differ_are_a_finding_of_raw_images_alone(folder, tmp_path):
    camera = drive_of(folder, tmp_path, "/sensing/front/image_rect")
    uneven = np.diag([1.0, 1.05, 1.0]) @ camera.info.intrinsic
    camera = replace(camera, info=replace(camera.info, intrinsic=uneven))
    assert "square pixels" not in {finding.check for finding in check_camera("front", camera)}
    raw = replace(camera, frames=CameraFrames())
    assert "square pixels" in {finding.check for finding in check_camera("front", raw)}


def test_their_calibration_goes_back_to_the_frame_of_the_camera_as_it_is_built(folder, tmp_path):
    camera = drive_of(folder, tmp_path, "/sensing/front/image_rect")
    turned = make_transform(TURN, np.zeros(3)) @ mountings()["front"]
    write_calibration(
        Calibration(camera.info, turned, None, camera.frames), tmp_path / "calibration_front.yaml"
    )
    again = read_calibration(tmp_path / "calibration_front.yaml")
    (edge,) = edges_of(again.frames, again.cam_from_vehicle)
    assert (edge.parent, edge.child) == ("base_link", "front_optical")
    np.testing.assert_allclose(edge.parent_from_child, inverse(mountings()["front"]), atol=1e-12)


@pytest.mark.parametrize(("topic", "info"), [(RAW, {}), ("/sensing/front/image_rect", {"rectified": False})])
def test_other_images_keep_their_lens(topic, info, folder, tmp_path):
    camera = drive_of(folder, tmp_path, topic, **info)
    assert camera.info.distortion == LENS.distortion
    assert camera.frames.rectified_from_camera is None


def test_a_driver_that_states_no_p_or_r_is_taken_at_its_word_or_refused():
    message = Messages().info(1.0, replace(LENS, distortion=(0.0,) * 5), "cam")
    message.p[:] = 0
    message.r[:] = 0
    got = info_of(message, "cam", "here", rectified=True)
    np.testing.assert_array_equal(got.info.intrinsic, LENS.intrinsic)
    np.testing.assert_array_equal(got.rectified_from_camera, np.eye(3))
    message.d[:] = LENS.distortion
    with pytest.raises(DriveError, match="here: states no P for its rectified images; set rectified: false"):
        info_of(message, "cam", "here", rectified=True)
    message.p[:] = Messages().info(1.0, LENS, "cam").p
    for wrong in (2.0, 1e308, -1.0):
        message.r[:] = np.diag([1.0, 1.0, wrong]).ravel()
        with pytest.raises(DriveError, match="here, R: is not a rotation"):
            info_of(message, "cam", "here", rectified=True)


def as_file(path, form):
    """The front camera's calibration in a file of ROS: as ``camera_calibration`` writes it, or a message."""
    projection = [47.0, 0, 32, -9.4, 0, 47.5, 24, 0, 0, 0, 1, 0]
    if form == "message":
        message = {
            "header": {"frame_id": "cam"}, "height": 48, "width": 64, "distortion_model": "plumb_bob",
            "d": list(LENS.distortion), "k": LENS.intrinsic.ravel().tolist(), "r": TURN.ravel().tolist(),
            "p": projection,
        }  # fmt: skip
        path.write_text(yaml.safe_dump(message))
        return path
    write_camera_info(LENS, path, TURN)
    content = yaml.safe_load(path.read_text())
    content["projection_matrix"]["data"] = projection
    path.write_text(yaml.safe_dump(content))
    return path


def with_file(folder, tmp_path, topic, file, **info):
    """The front camera of a bag that states no P, with its intrinsics in ``file``."""
    bag = write_ros2(tmp_path / "site", renamed(folder, topic))
    content = topics_for(folder, bag, vehicle_frame="base_link")
    front = content["cameras"]["front"]
    front.pop("ipm", None)
    guess = mountings()["front"].tolist()
    front |= {"images": {"topic": topic}, "cam_from_vehicle": guess, "frame": "front_optical"}
    front["camera_info"] = {"file": str(file), **info} if info else str(file)
    return read(tmp_path / "drive", content).cameras["front"]


@pytest.mark.parametrize("form", ["camera_info", "message"])
@pytest.mark.parametrize(("topic", "info"), [("/front/image_rect", {}), (RAW, {"rectified": True})])
def test_a_file_says_of_rectified_images_what_a_topic_does(topic, info, form, folder, tmp_path):
    camera = with_file(folder, tmp_path, topic, as_file(tmp_path / "front.yaml", form), **info)
    np.testing.assert_array_equal(camera.info.intrinsic, [[47.0, 0, 32], [0, 47.5, 24], [0, 0, 1]])
    assert not any(camera.info.distortion)
    np.testing.assert_allclose(camera.frames.rectified_from_camera, TURN, atol=1e-12)


@pytest.mark.parametrize(("topic", "info"), [(RAW, {}), ("/front/image_rect", {"rectified": False})])
def test_a_file_of_other_images_keeps_its_lens(topic, info, folder, tmp_path):
    camera = with_file(folder, tmp_path, topic, as_file(tmp_path / "front.yaml", "camera_info"), **info)
    assert camera.info.distortion == LENS.distortion
    assert camera.frames.rectified_from_camera is None


def write_lens(path, form, distortion):
    calibration = Calibration(replace(LENS, distortion=distortion), mountings()["front"])
    if form == "own":
        frames = CameraFrames(rectified_from_camera=TURN)
        write_calibration(replace(calibration, frames=frames), path)
        return path
    return write_calibration_as(form, calibration, Provenance(), path.parent, "front")


@pytest.mark.parametrize(("form", "turn"), [("kalibr", np.eye(3)), ("opencv", np.eye(3)), ("own", TURN)])
def test_files_without_p_are_of_the_rectified_images_if_their_lens_has_no_distortion(form, turn, tmp_path):
    plain = write_lens(tmp_path / "front.yaml", form, (0.0,) * 5)
    got = read_rectified_intrinsics(plain)
    np.testing.assert_allclose(got.info.intrinsic, LENS.intrinsic)
    np.testing.assert_allclose(got.rectified_from_camera, turn, atol=1e-12)
    bent = write_lens(tmp_path / "front.yaml", form, LENS.distortion)
    with pytest.raises(DriveError, match=r"states no P for its rectified images; set rectified: false"):
        read_rectified_intrinsics(bent)


@pytest.mark.parametrize(
    ("key", "matrix", "problem"),
    [("projection_matrix", np.eye(3), "projection_matrix: expected 3 x 4"),
     ("projection_matrix", np.zeros((3, 4)), "states no P"),
     ("projection_matrix", -np.eye(3, 4), "front.yaml"),
     ("rectification_matrix", 2 * np.eye(3), "rectification_matrix: is not a rotation")],
)  # fmt: skip
def test_a_file_whose_p_or_r_cannot_be_is_refused(key, matrix, problem, tmp_path):
    path = as_file(tmp_path / "front.yaml", "camera_info")
    content = yaml.safe_load(path.read_text())
    rows, cols = matrix.shape
    content[key] = {"rows": rows, "cols": cols, "data": matrix.ravel().tolist()}
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(DriveError, match=problem):
        read_rectified_intrinsics(path)
