"""Every way in which a drive can be damaged gets one line: what, where, what to do."""

import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from tests.drive.example import make_drive
from v2hdm.errors import DriveError, MapFileError
from v2hdm.io.drive import ReadOptions, read_drive, truth
from v2hdm.io.drive.truth import read_truth
from v2hdm.report.page import facts

Damage = Callable[[Path], None]


def edit(file, pattern, replacement):
    def damage(root):
        text = (root / file).read_text()
        changed = re.sub(pattern, replacement, text, count=1, flags=re.MULTILINE)
        assert changed != text
        (root / file).write_text(changed)

    return damage


def front(**changes):
    """Change entries of the front camera in ``drive.yaml``; None removes one."""

    def damage(root):
        content = yaml.safe_load((root / "drive.yaml").read_text())
        entry = content["cameras"]["front"]
        for key, value in changes.items():
            entry.pop(key, None)
            if value is not None:
                entry[key] = value
        (root / "drive.yaml").write_text(yaml.safe_dump(content))

    return damage


def write(file, text):
    return lambda root: (root / file).write_text(text) and None


def remove(file):
    return lambda root: (root / file).unlink()


def truncate(file, size):
    return lambda root: (root / file).write_bytes((root / file).read_bytes()[:size]) and None


def shrink_image(root):
    cv2.imwrite(str(root / "front/images/000001.jpg"), np.zeros((24, 32, 3), np.uint8))


IMAGE = "front/images/000001.jpg"
SINGULAR = [[1.0, 2.0, 3.0], [2.0, 4.0, 6.0], [0.0, 0.1, 1.0]]
ON_THE_GROUND = np.eye(4).tolist()
CASES: dict[str, tuple[Damage, str]] = {
    "no poses": (remove("poses.tum"), r"poses.tum: no such file"),
    "nan pose": (edit("poses.tum", r"^(100\.2\S*) \S+", r"\1 nan"), r"poses.tum: line 4: 'nan' is not a"),
    "text in poses": (edit("poses.tum", r"^100\.2\S*", "soon"), r"line 4: 'soon' is not a number"),
    "unsorted poses": (edit("poses.tum", r"^100\.3\S*", "99.5"), r"line 5: time 99.5\d* is earlier than"),
    "repeated pose": (edit("poses.tum", r"^100\.3\S*", "100.200000000"), r"line 5: .* repeats .* line 4"),
    "short pose": (edit("poses.tum", r"^(100\.2.*) \S+$", r"\1"), r"line 4: expected 8 columns .* got 7"),
    "long quaternion": (edit("poses.tum", r"^(100\.2.*) \S+$", r"\1 1.7"), r"line 4: quaternion of norm 1"),
    "empty poses": (write("poses.tum", "# nothing\n"), r"poses.tum: holds no pose"),
    "binary poses": (lambda root: (root / "poses.tum").write_bytes(b"\xff\xfe\x00") and None, r"not a UTF-8"),
    "no drive.yaml": (remove("drive.yaml"), r"not a drive in any known format .*drive-format.md"),
    "yaml syntax": (edit("drive.yaml", r"^name: example", "name: [exa"), r"drive.yaml: line \d+ YAML syntax"),
    "yaml list": (write("drive.yaml", "- a\n"), r"expected 'key: value' entries"),
    "typo": (edit("drive.yaml", r"^pose_noise", "pose_noize"), r"'pose_noize'; did you mean 'pose_noise'\?"),
    "camera typo": (front(roi_vehicl=[[0, 0]]), r"camera 'front': unknown key 'roi_vehicl'; did you mean"),
    "no cameras": (edit("drive.yaml", r"^cameras:(.|\n)*", "cameras: {}"), r"names no camera"),
    "bad noise": (edit("drive.yaml", r"position_m: 0\.01", "position_m: -1.0"), r"position_m: .*negative"),
    "more drift than error": (
        edit("drive.yaml", r"position_drift_m: 0\.008", "position_drift_m: 0.02"),
        r"position_drift_m: is part of position_m and cannot be above it",
    ),
    "drift over nothing": (
        edit("drive.yaml", r"position_drift_over_m: 25\.0", "position_drift_over_m: 0"),
        r"position_drift_over_m: an error that fades over no way",
    ),
    "bad latitude": (edit("drive.yaml", r"latitude_deg: 53.5", "latitude_deg: 99"), r"latitude must lie"),
    "missing truth": (edit("drive.yaml", r"^truth: truth", "truth: elsewhere"), r"truth: no such folder"),
    "no camera_info": (remove("front/camera_info.yaml"), r"camera_info.yaml: no such file"),
    "unknown lens": (edit("front/camera_info.yaml", "plumb_bob", "fisheye62"), r"unknown distortion_model"),
    "eight for five": (edit("front/camera_info.yaml", "plumb_bob", "rational_polynomial"), r"has 8 .*got 5"),
    "bad matrix": (edit("front/camera_info.yaml", r"data: \[60\.0", "data: [-60.0"), r"camera_matrix: not"),
    "no images": (write("front/images.txt", ""), r"images.txt: lists no image"),
    "bad image line": (write("front/images.txt", "100.5\n"), r"line 1: expected 'timestamp filename'"),
    "missing image": (remove(IMAGE), r"000001.jpg: image listed but missing; restore it"),
    "empty image": (truncate(IMAGE, 0), r"000001.jpg: image file is empty"),
    "truncated image": (truncate(IMAGE, 500), r"000001.jpg: image is truncated"),
    "wrong size": (shrink_image, r"000001.jpg: image is 32 x 24, but camera_info of 'front' says 64 x 48"),
    "singular ipm": (front(ipm={"estimated": SINGULAR}), r"ipm, estimated: IPM matrix is not invertible"),
    "zero ipm": (front(ipm={"estimated": np.zeros((3, 3)).tolist()}), r"not invertible"),
    "small ipm": (front(ipm={"estimated": [[1, 0], [0, 1]]}), r"expected 3 x 3 numbers, got 2 x 2"),
    "ragged ipm": (front(ipm={"estimated": [[1, 0], [0]]}), r"expected 3 x 3 numbers"),
    "nan ipm": (front(ipm={"estimated": [[float("nan")] * 3] * 3}), r"not finite"),
    "ipm name": (front(ipm={"estimate": SINGULAR}), r"unknown key 'estimate'; did you mean 'estimated'"),
    "initial ipm": (front(initial_ipm="calib"), r"initial_ipm 'calib' is not given"),
    "no initial ipm": (front(initial_ipm=None), r"missing key 'initial_ipm'"),
    "no ipm": (front(ipm=None), r"give one of 'mounting', 'cam_from_vehicle' and 'ipm'"),
    "both": (front(cam_from_vehicle=ON_THE_GROUND), r"give one of 'mounting', 'cam_from_vehicle' and 'ipm'"),
    "guess": (front(ipm=None, initial_ipm=None, cam_from_vehicle=ON_THE_GROUND), r"0 m above the ground"),
    "no rotation": (
        front(ipm=None, cam_from_vehicle=np.diag([1, 2, 1, 1]).tolist()),
        r"not a rigid transform",
    ),
    "two roi points": (front(roi_vehicle=[[0, 0], [1, 0]]), r"roi_vehicle: .*at least 3 points, got 2"),
    "bent roi": (front(roi_vehicle=[[0, 0], [4, 0], [1, 1], [0, 4]]), r"roi_vehicle: polygon is not convex"),
    "flat roi": (front(roi_vehicle=[[0, 0], [1, 0], [2, 0]]), r"polygon is not convex"),
    "bow tie": (front(roi_vehicle=[[0, 0], [1, 1], [1, 0], [0, 1]]), r"polygon is not convex"),
    "sigma": (front(centre_prior={"xyz": [0, 0, 2], "sigma_m": 0}), r"sigma_m: must be positive"),
    "prior typo": (front(centre_prior={"xyz": [0, 0, 2], "sigma": 1}), r"'sigma'; did you mean 'sigma_m'"),
    "negative read-out": (front(read_out_s=-0.01), r"read_out_s: -0.01 s is no read-out time; give seconds"),
    "long read-out": (front(read_out_s=1.0), r"read_out_s: 1 s is no .*, from 0 to 0.6, the time from image"),
    "read-out nan": (front(read_out_s=float("nan")), r"read_out_s: expected a finite number, got nan"),
    "read-out text": (front(read_out_s="fast"), r"read_out_s: expected a finite number"),
    "linear": (front(linear_response="perhaps"), r"linear_response: expected true or false"),
}


@pytest.mark.parametrize(("damage", "message"), CASES.values(), ids=CASES.keys())
def test_a_damaged_drive_is_refused_in_one_line(tmp_path, damage, message):
    make_drive(tmp_path)
    damage(tmp_path)
    with pytest.raises(DriveError, match=message) as caught:
        read_drive(tmp_path)
    assert "\n" not in str(caught.value)


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(DriveError, match="nowhere: no such drive folder"):
        read_drive(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (ReadOptions(cameras=["left"]), "no camera 'left'; choose from: front, rear"),
        (ReadOptions(format="foldr"), "unknown drive format 'foldr'; choose from: auto, folder, kitti"),
        (ReadOptions(max_gap_s=0.0), "max_gap_s is 0"),
    ],
)
def test_impossible_wishes_are_refused(tmp_path, options, message):
    make_drive(tmp_path)
    with pytest.raises(DriveError, match=message):
        read_drive(tmp_path, options)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (write("truth/sightings.csv", "a,b\n"), "line 1: expected the header"),
        (edit("truth/sightings.csv", r",0,1\.0000$", ",7,1.0"), "marking must be below 2"),
        (edit("truth/lane_visible.csv", r"^0,2", "0,9"), "line 3: no vertex 9"),
        (edit("truth/poses.tum", r"^100\.05.*\n", ""), "no true pose at the time 100.05"),
        (edit("truth/cameras.yaml", "rear", "back"), "camera 'rear': missing"),
    ],
)
def test_damaged_truth_is_refused(tmp_path, damage, message):
    make_drive(tmp_path)
    damage(tmp_path)
    with pytest.raises(DriveError, match=message):
        read_truth(read_drive(tmp_path))


@pytest.mark.parametrize(
    ("roi", "cause"),
    [
        ([[-9.0, -3.0], [-3.0, -3.0], [-3.0, 3.0], [-9.0, 3.0]], "lies behind the camera"),
        ([[3.0, 20.0], [9.0, 20.0], [9.0, 26.0], [3.0, 26.0]], "lies outside the image"),
        ([[0.5, -1.0], [1.5, -1.0], [1.5, 1.0], [0.5, 1.0]], "lies outside the image"),
    ],
)
def test_a_region_that_the_camera_does_not_see_is_named_for_that(tmp_path, roi, cause):
    make_drive(tmp_path)
    front(roi_vehicle=roi)(tmp_path)
    with pytest.raises(DriveError, match=f"camera 'front', roi_vehicle: {cause}"):
        read_drive(tmp_path)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_region_of_which_the_image_shows_a_part_is_taken_whatever_the_sign_of_the_ipm(tmp_path, sign):
    make_drive(tmp_path)
    content = yaml.safe_load((tmp_path / "drive.yaml").read_text())
    ipm = {name: (sign * np.array(m)).tolist() for name, m in content["cameras"]["front"]["ipm"].items()}
    front(ipm=ipm, roi_vehicle=[[-1.0, -9.0], [30.0, -9.0], [30.0, 9.0], [-1.0, 9.0]])(tmp_path)
    assert read_drive(tmp_path).images


@pytest.mark.parametrize(
    ("read", "error"),
    [(lambda path: list(truth._rows(path, ["a", "b"])), DriveError), (facts._table, MapFileError)],
    ids=["truth", "result"],
)
def test_a_cell_that_is_longer_than_csv_takes_is_one_line(read, error, tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("a,b\n1," + "x" * 140_000 + "\n")
    with pytest.raises(error, match=r"a\.csv: .*larger than field limit"):
        read(path)
