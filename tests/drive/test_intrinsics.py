"""Intrinsics as Kalibr, OpenCV, ROS and COLMAP write them, judged by the projection of cv2."""

import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from tests.drive.example import camera_info, description, make_drive
from v2hdm.errors import DriveError
from v2hdm.geometry.lens import distort_points
from v2hdm.io.calibration.intrinsics import COLMAP_MODELS, read_intrinsics
from v2hdm.io.calibration.reading import Provenance
from v2hdm.io.calibration.writing import write_calibration, write_calibration_as
from v2hdm.io.drive import ReadOptions, read_drive
from v2hdm.records import Calibration, CameraInfo, FloatArray

SIZE = (1280, 720)
MATRIX = np.array([[905.5, 0.0, 641.25], [0.0, 903.25, 352.75], [0.0, 0.0, 1.0]])
LENSES = {
    4: [-0.11, 0.021, 0.0009, -0.0007],
    5: [-0.11, 0.021, 0.0009, -0.0007, 0.003],
    8: [0.31, 0.02, 0.0009, -0.0007, 0.001, 0.42, 0.03, 0.002],
}
FISHEYE = [0.012, -0.004, 0.0011, -0.0003]
RAYS = np.array([[x, y, 1.0] for x in np.linspace(-0.6, 0.6, 7) for y in np.linspace(-0.35, 0.35, 5)])


def seen(info):
    """Where a camera of ours sees :data:`RAYS`, recorded px."""
    return distort_points(info, (RAYS @ info.intrinsic.T)[:, :2])


def as_opencv(coefficients, matrix=MATRIX):
    """Where OpenCV says they are."""
    points, _ = cv2.projectPoints(RAYS, np.zeros(3), np.zeros(3), matrix, np.array(coefficients))
    return np.asarray(points.reshape(-1, 2))


def as_fisheye(coefficients):
    points, _ = cv2.fisheye.projectPoints(
        RAYS[:, None], np.zeros(3), np.zeros(3), MATRIX, np.array(coefficients)
    )
    return np.asarray(points.reshape(-1, 2))


def write_opencv(path, coefficients, **more):
    """Write the file of OpenCV's calibration programs, by OpenCV itself."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Mon Nov 23 10:01:02 2026")
    storage.write("image_width", SIZE[0])
    storage.write("image_height", SIZE[1])
    storage.write("flags", 0)
    for key, value in more.items():
        storage.write(key, value)
    storage.write("camera_matrix", MATRIX)
    storage.write("distortion_coefficients", np.array([coefficients]).T)
    storage.write("avg_reprojection_error", 0.21)
    storage.release()
    return path


@pytest.mark.parametrize("suffix", [".yml", ".json", ".xml"])
@pytest.mark.parametrize("count", LENSES)
def test_what_opencv_writes_projects_as_in_opencv(tmp_path, suffix, count):
    info = read_intrinsics(write_opencv(tmp_path / f"left{suffix}", LENSES[count]))
    assert (info.name, info.width, info.height) == ("left", *SIZE)
    np.testing.assert_allclose(seen(info), as_opencv(LENSES[count]), atol=1e-9)


@pytest.mark.parametrize("suffix", [".yml", ".json", ".xml"])
def test_opencv_s_fisheye_is_told_by_its_mark(tmp_path, suffix):
    info = read_intrinsics(write_opencv(tmp_path / f"left{suffix}", FISHEYE, fisheye_model=1))
    np.testing.assert_allclose(seen(info), as_fisheye(FISHEYE), atol=1e-9)


def test_the_directive_of_opencv_4_and_the_names_of_opencv_2_are_read(tmp_path):
    text = write_opencv(tmp_path / "a.yml", LENSES[5]).read_text()
    body = text.split("---\n", 1)[1]
    for old, new in (("camera_matrix", "Camera_Matrix"), ("image_w", "image_W"), ("image_h", "image_H"),
                     ("distortion_coefficients", "Distortion_Coefficients")):  # fmt: skip
        body = body.replace(old, new)
    (tmp_path / "a.yml").write_text("%YAML:1.0\n---\n" + body)
    np.testing.assert_allclose(seen(read_intrinsics(tmp_path / "a.yml")), as_opencv(LENSES[5]), atol=1e-9)


def test_twelve_coefficients_are_eight_where_the_prism_is_none(tmp_path):
    info = read_intrinsics(write_opencv(tmp_path / "a.yml", [*LENSES[8], 0, 0, 0, 0]))
    assert info.distortion_model == "rational_polynomial"
    np.testing.assert_allclose(seen(info), as_opencv(LENSES[8]), atol=1e-9)


CAMCHAIN = """\
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.11, 0.021, 0.0009, -0.0007]
  distortion_model: radtan
  intrinsics: [905.5, 903.25, 641.25, 352.75]
  resolution: [1280, 720]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [0.99998, 0.00176, -0.0054, -0.0299]
  - [-0.00177, 0.99999, 0.00197, -0.00027]
  - [0.00542, -0.00198, 0.99998, 0.00036]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [0.012, -0.004, 0.0011, -0.0003]
  distortion_model: equidistant
  intrinsics: [905.5, 903.25, 641.25, 352.75]
  resolution: [1280, 720]
  rostopic: /cam1/image_raw
  timeshift_cam_imu: -0.0043
"""
"""As Kalibr writes it: PyYAML's keys in the order of the alphabet, flow lists."""


def write_chain(folder, *changes):
    text = CAMCHAIN
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path = folder / "site-camchain.yaml"
    path.write_text(text)
    return path


def test_a_camchain_of_kalibr_projects_as_opencv_s_models_do(tmp_path):
    path = write_chain(tmp_path)
    np.testing.assert_allclose(seen(read_intrinsics(path, "cam0")), as_opencv(LENSES[4]), atol=1e-9)
    np.testing.assert_allclose(seen(read_intrinsics(path, "cam1")), as_fisheye(FISHEYE), atol=1e-9)


def test_a_single_camera_need_not_be_named(tmp_path):
    content = {"cam0": yaml.safe_load(CAMCHAIN)["cam0"]}
    (tmp_path / "one.yaml").write_text("%YAML:1.0\n---\n" + yaml.safe_dump(content))
    info = read_intrinsics(tmp_path / "one.yaml")
    assert (info.name, info.width, info.height) == ("cam0", *SIZE)


COLMAP_LENSES: dict[str, tuple[list[float], Callable[[], FloatArray]]] = {
    "SIMPLE_PINHOLE": ([905.5], lambda: as_opencv([0.0] * 4, one_focal())),
    "PINHOLE": ([905.5, 903.25], lambda: as_opencv([0.0] * 4)),
    "SIMPLE_RADIAL": ([905.5, -0.11], lambda: as_opencv([-0.11, 0, 0, 0], one_focal())),
    "RADIAL": ([905.5, -0.11, 0.021], lambda: as_opencv([-0.11, 0.021, 0, 0], one_focal())),
    "OPENCV": ([905.5, 903.25, *LENSES[4]], lambda: as_opencv(LENSES[4])),
    "FULL_OPENCV": ([905.5, 903.25, *LENSES[8]], lambda: as_opencv(LENSES[8])),
    "OPENCV_FISHEYE": ([905.5, 903.25, *FISHEYE], lambda: as_fisheye(FISHEYE)),
    "SIMPLE_RADIAL_FISHEYE": ([903.25, 0.012], lambda: theta_polynomial([0.012])),
    "RADIAL_FISHEYE": ([903.25, 0.012, -0.004], lambda: theta_polynomial([0.012, -0.004])),
}
"""Focal lengths and coefficients of each model, and where it sees the rays, in OpenCV's pixels."""


def one_focal():
    matrix = MATRIX.copy()
    matrix[1, 1] = matrix[0, 0]
    return matrix


def theta_polynomial(coefficients):
    """COLMAP's fisheyes by hand: theta (1 + k1 theta^2 + k2 theta^4) along the ray's direction."""
    radius = np.hypot(*RAYS[:, :2].T)
    theta = np.arctan(radius)
    scale = theta * (1 + sum(k * theta ** (2 * n + 2) for n, k in enumerate(coefficients)))
    direction = RAYS[:, :2] / np.where(radius > 0, radius, 1.0)[:, None]
    return np.asarray(903.25 * scale[:, None] * direction + MATRIX[:2, 2])


def write_colmap(path, *lines):
    path.write_text(
        "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"# Number of cameras: {len(lines)}\n" + "".join(f"{line}\n" for line in lines)
    )
    return path


@pytest.mark.parametrize("model", COLMAP_MODELS)
def test_colmap_s_pixels_begin_at_the_corner_of_the_first(tmp_path, model):
    values, expected = COLMAP_LENSES[model]
    focals = 2 if model == "PINHOLE" or "OPENCV" in model else 1
    # In COLMAP the centre of the first pixel is (0.5, 0.5).
    numbers = [*values[:focals], *(MATRIX[:2, 2] + 0.5), *values[focals:]]
    path = write_colmap(
        tmp_path / "cameras.txt", f"1 {model} 1280 720 {' '.join(map(repr, map(float, numbers)))}"
    )
    info = read_intrinsics(path)
    assert (info.name, info.width, info.height) == ("1", *SIZE)
    np.testing.assert_allclose(seen(info), expected(), atol=1e-9)


ECHO = """\
header:
  stamp:
    sec: 1715934630
    nanosec: 250000000
  frame_id: front_optical
height: 720
width: 1280
distortion_model: {model}
d: {d}
k: {k}
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [905.5, 0.0, 641.25, 0.0, 0.0, 903.25, 352.75, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
binning_y: 0
roi:
  x_offset: 0
  y_offset: 0
  height: 0
  width: 0
  do_rectify: false
---
"""


def write_ros(path, model, lens):
    """Write a file of ROS's ``camera_info_manager``; its path."""
    matrices = {"camera_matrix": MATRIX, "distortion_coefficients": np.array([lens])}
    matrices |= {"rectification_matrix": np.eye(3), "projection_matrix": np.eye(3, 4)}
    content = {"image_width": 1280, "image_height": 720, "camera_name": "front", "distortion_model": model}
    for name, of in matrices.items():
        content[name] = {"rows": of.shape[0], "cols": of.shape[1], "data": of.ravel().tolist()}
    path.write_text(yaml.safe_dump(content))
    return path


@pytest.mark.parametrize(
    ("model", "lens", "expected"),
    [
        ("plumb_bob", LENSES[5], lambda: as_opencv(LENSES[5])),
        ("rational_polynomial", LENSES[8], lambda: as_opencv(LENSES[8])),
        ("equidistant", FISHEYE, lambda: as_fisheye(FISHEYE)),
        # Names of OpenCV and Kalibr, and numbers as OpenCV counts them.
        ("fisheye", FISHEYE, lambda: as_fisheye(FISHEYE)),
        ("Brown-Conrady", LENSES[4], lambda: as_opencv(LENSES[4])),
        ("rational_polynomial", [*LENSES[8], *[0.0] * 6], lambda: as_opencv(LENSES[8])),
    ],
)
def test_an_echoed_message_and_a_camera_info_file_of_ros_are_read(tmp_path, model, lens, expected):
    echo = tmp_path / "echo.yaml"
    echo.write_text(ECHO.format(model=model, d=lens, k=MATRIX.ravel().tolist()))
    assert read_intrinsics(echo).name == "front_optical"
    np.testing.assert_allclose(seen(read_intrinsics(echo)), expected(), atol=1e-9)
    file = write_ros(tmp_path / "front.yaml", model, lens)
    np.testing.assert_allclose(seen(read_intrinsics(file)), expected(), atol=1e-9)


@pytest.mark.parametrize(
    ("model", "lens"), [("rational_polynomial", LENSES[5]), ("equidistant", FISHEYE[:3])]
)
def test_a_file_that_lacks_numbers_of_its_lens_is_refused(tmp_path, model, lens):
    with pytest.raises(DriveError, match=f"{model} has .*, got {len(lens)}; complete them"):
        read_intrinsics(write_ros(tmp_path / "front.yaml", model, lens))


@pytest.mark.parametrize("form", ["camera_info", "kalibr", "opencv", "own"])
def test_what_we_write_for_other_tools_is_read_back(tmp_path, form):
    info = CameraInfo("front", *SIZE, MATRIX, "plumb_bob", (*LENSES[4], 0.0))
    cam_from_vehicle = np.eye(4)
    cam_from_vehicle[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    cam_from_vehicle[1, 3] = 2.0
    calibration = Calibration(info, cam_from_vehicle)
    if form == "own":
        path = tmp_path / "calibration_front.yaml"
        write_calibration(calibration, path)
    else:
        path = write_calibration_as(form, calibration, Provenance(), tmp_path, "front")
    got = read_intrinsics(path)
    np.testing.assert_allclose(seen(got), as_opencv(LENSES[4]), atol=1e-9)
    assert (got.width, got.height) == SIZE


def kalibr_mistake(*changes):
    return lambda folder: write_chain(folder, *changes)


def colmap_mistake(line):
    return lambda folder: write_colmap(folder / "cameras.txt", line)


def opencv_mistake(old, new):
    def write(folder):
        path = write_opencv(folder / "a.yml", LENSES[5])
        text = path.read_text()
        assert re.search(old, text, re.DOTALL)
        path.write_text(re.sub(old, new, text, flags=re.DOTALL))
        return path

    return write


def text_mistake(name, text):
    def write(folder):
        (folder / name).write_text(text)
        return folder / name

    return write


MISTAKES: dict[str, tuple[Callable[[Path], Path], str]] = {
    "omni": (
        kalibr_mistake(("camera_model: pinhole", "camera_model: omni"), ("[905.5", "[0.8, 905.5")),
        "omnidirectional",
    ),
    "double sphere": (kalibr_mistake(("camera_model: pinhole", "camera_model: ds")), "double sphere"),
    "eucm": (kalibr_mistake(("camera_model: pinhole", "camera_model: eucm")), "extended unified"),
    "fov": (kalibr_mistake(("distortion_model: radtan", "distortion_model: fov")), "'fov' is not supported"),
    "no resolution": (kalibr_mistake(("  resolution: [1280, 720]\n", "")), "missing key 'resolution'"),
    "three intrinsics": (kalibr_mistake(("[905.5, 903.25,", "[905.5,")), "expected 4 numbers"),
    "nan": (kalibr_mistake(("[905.5", "[.nan")), "not finite"),
    "colmap fov": (colmap_mistake("1 FOV 1280 720 900 900 640 360 0.9"), "COLMAP's FOV is not supported"),
    "colmap prism": (
        colmap_mistake("1 THIN_PRISM_FISHEYE 1280 720 900 900 640 360 0 0 0 0 0 0 0 0"),
        "THIN_PRISM_FISHEYE is not supported",
    ),
    "colmap short": (colmap_mistake("1 OPENCV 1280 720 900 900 640 360 0 0"), "OPENCV has 8 parameters"),
    "colmap binary": (text_mistake("cameras.bin", ""), "model_converter"),
    "thin prism": (
        lambda folder: write_opencv(folder / "a.yml", [*LENSES[8], 0.01, 0, 0, 0]),
        "thin prism .* is not supported",
    ),
    "tilted": (
        lambda folder: write_opencv(folder / "a.yml", [*LENSES[8], 0, 0, 0, 0, 0.1, 0]),
        "tilted sensor .* is not supported",
    ),
    "opencv omnidir": (
        lambda folder: write_opencv(folder / "a.yml", LENSES[4], xi=0.9),
        r"omnidirectional",
    ),
    "no size": (opencv_mistake("image_width: 1280\n", ""), "missing key 'image_width'; add the size"),
    "six": (lambda folder: write_opencv(folder / "a.yml", [0.0] * 6), "6 distortion coefficients; expected"),
    "zero focal": (opencv_mistake(r"905\.5", "0."), "positive fx, fy"),
    "cut yaml": (text_mistake("a.yaml", "cam0: {camera_model: pinhole"), "line 1 YAML syntax error"),
    "cut json": (text_mistake("a.json", '{"camera_matrix": {"rows": 3'), "line 1 JSON syntax error"),
    "cut xml": (text_mistake("a.xml", "<?xml version='1.0'?>\n<opencv_storage><a>"), "XML syntax error"),
    "xml bomb": (
        text_mistake("a.xml", '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "c">]><opencv_storage/>'),
        "XML declarations",
    ),
    "other xml": (text_mistake("a.xml", "<robot/>"), "expected OpenCV's <opencv_storage>, got <robot>"),
    "empty": (text_mistake("a.yaml", ""), "no intrinsics of a known format"),
    "something else": (text_mistake("a.yaml", "poses: poses.tum\n"), "no intrinsics of a known format"),
    "missing": (lambda folder: folder / "none.yaml", "no such file"),
    "folder": (lambda folder: folder, "is a folder"),
    "radial alone": (
        text_mistake("a.yaml", ECHO.format(model="plumb_bob", d=LENSES[4][:3], k=[1] * 9)),
        "3 distortion coefficients leave open which they are; give k1 k2 p1 p2 and k3",
    ),
    "uncalibrated message": (
        text_mistake("a.yaml", ECHO.format(model="plumb_bob", d=[], k=[0] * 9)),
        "not calibrated",
    ),
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_lens_beyond_ours_or_a_damaged_file_is_one_line(tmp_path, mistake):
    write, expected = MISTAKES[mistake]
    path = write(tmp_path)
    with pytest.raises(DriveError, match=expected) as caught:
        read_intrinsics(path, "cam0" if "camchain" in path.name else None)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_file_with_several_cameras_asks_for_the_name(tmp_path):
    path = write_chain(tmp_path)
    with pytest.raises(DriveError, match="holds the cameras cam0, cam1; choose one with --camera-name"):
        read_intrinsics(path, name_by="--camera-name")
    with pytest.raises(DriveError, match="no camera 'cam7' in this file; it holds: cam0, cam1"):
        read_intrinsics(path, "cam7")


def drive_with(folder, described):
    """The example drive, its front camera's intrinsics described otherwise."""
    make_drive(folder)
    with description(folder) as content:
        content["cameras"]["front"]["camera_info"] = described
    return folder


def test_a_drive_takes_intrinsics_of_any_format_by_file_and_camera(tmp_path):
    pinhole = camera_info("front")
    (fx, _, cx), (_, fy, cy), _ = pinhole.intrinsic.tolist()
    lens = {"distortion_model": "radtan", "distortion_coeffs": list(pinhole.distortion[:4])}
    size = {"camera_model": "pinhole", "resolution": [pinhole.width, pinhole.height]}
    chain = {f"cam{n}": {**size, **lens, "intrinsics": [fx + n, fy, cx, cy]} for n in range(2)}
    drive_with(tmp_path, {"file": "chain.yaml", "camera": "cam1"})
    (tmp_path / "chain.yaml").write_text(yaml.safe_dump(chain))
    info = read_drive(tmp_path).cameras["front"].info
    assert (info.name, info.intrinsic[0, 0], info.distortion) == ("front", fx + 1, pinhole.distortion)


def test_a_drive_asks_which_camera_of_a_chain_and_names_the_key(tmp_path):
    drive_with(tmp_path, "site-camchain.yaml")
    write_chain(tmp_path)
    with pytest.raises(
        DriveError, match=r"choose one with camera_info: \{file: site-camchain.yaml, camera: NAME\}"
    ):
        read_drive(tmp_path)


def test_a_drive_whose_images_are_of_another_size_than_the_intrinsics_is_refused(tmp_path):
    drive_with(tmp_path, {"file": "cameras.txt", "camera": 1})
    write_colmap(tmp_path / "cameras.txt", "1 PINHOLE 128 96 120 122 64 48", "2 PINHOLE 64 48 60 61 32 24")
    with pytest.raises(DriveError, match="image is 64 x 48, but camera_info of 'front' says 128 x 96"):
        read_drive(tmp_path, ReadOptions(cameras=["front"]))
