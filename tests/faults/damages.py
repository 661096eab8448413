"""Damage to single entries and lines of a drive's files, with the line that names it."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from tests.faults.judge import Case
from tests.faults.making import Change, checked, edit, front, remove, write


def shrink_image(root: Path) -> None:
    cv2.imwrite(str(root / "front/images/000001.jpg"), np.zeros((24, 32, 3), np.uint8))


IMAGE = "front/images/000001.jpg"
SINGULAR = [[1.0, 2.0, 3.0], [2.0, 4.0, 6.0], [0.0, 0.1, 1.0]]
ON_THE_GROUND, STRETCHED = np.eye(4).tolist(), np.diag([1, 2, 1, 1]).tolist()
BACKWARDS = "".join(f"{110 - n / 10:.1f} {n} 0 0 0 0 0 1\n" for n in range(30))
DAMAGES: dict[str, tuple[Change, str]] = {
    "no poses": (remove("poses.tum"), r"poses.tum: no such file"),
    "nan poses": (write("poses.tum", "nan 0 0 0 0 0 0 1\n" * 9), r"poses.tum: line 9: .*no finite number"),
    "text in poses": (edit("poses.tum", r"^100\.2\S*", "soon"), r"line 4: 'soon' is not a number"),
    "unsorted poses": (
        write("poses.tum", BACKWARDS),
        r"pose 11: its time 109.000 s is 1.000 s before that of",
    ),
    "poses of one time": (write("poses.tum", "1.7e+09 1 0 0 0 0 0 1\n" * 9), r"1700000000: .*too few digits"),
    "short pose": (edit("poses.tum", r"^(100\.2.*) \S+$", r"\1"), r"line 4: expected 8 columns .* got 7"),
    "long quaternion": (edit("poses.tum", r"^(100\.2.*) \S+$", r"\1 1.7"), r"line 4: quaternion of norm 1"),
    "empty poses": (write("poses.tum", "# nothing\n"), r"poses.tum: holds no pose"),
    "no drive.yaml": (remove("drive.yaml"), r"not a drive in any known format .*drive-format.md"),
    "typo": (edit("drive.yaml", r"^pose_noise", "pose_noize"), r"'pose_noize'; did you mean 'pose_noise'\?"),
    "camera typo": (front(roi_vehicl=[[0, 0]]), r"camera 'front': unknown key 'roi_vehicl'; did you mean"),
    "no cameras": (edit("drive.yaml", r"^cameras:(.|\n)*", "cameras: {}"), r"has no camera"),
    "bad noise": (edit("drive.yaml", r"position_m: 0\.01", "position_m: -1.0"), r"position_m: .*negative"),
    "much drift": (
        edit("drive.yaml", r"drift_m: 0\.008", "drift_m: 0.02"),
        r"is part of position_m, so not above it",
    ),
    "short drift": (
        edit("drive.yaml", r"_over_m: 25\.0", "_over_m: 0"),
        r"an error that fades over 0 m",
    ),
    "bad latitude": (edit("drive.yaml", r"latitude_deg: 53.5", "latitude_deg: 99"), r"latitude must lie"),
    "missing truth": (edit("drive.yaml", r"^truth: truth", "truth: elsewhere"), r"truth: no such folder"),
    "no camera_info": (remove("front/camera_info.yaml"), r"camera_info.yaml: no such file"),
    "eight for five": (edit("front/camera_info.yaml", "plumb_bob", "rational_polynomial"), r"has 8 .*got 5"),
    "bad matrix": (edit("front/camera_info.yaml", r"data: \[60\.0", "data: [-60.0"), r"camera_matrix: not"),
    "no images": (write("front/images.txt", ""), r"images.txt: lists no image"),
    "bad image line": (write("front/images.txt", "100.5\n"), r"line 1: expected 'timestamp filename'"),
    "missing image": (remove(IMAGE), r"000001.jpg: image listed but missing; restore it"),
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
    "no rotation": (front(ipm=None, cam_from_vehicle=STRETCHED), r"not a rigid transform"),
    "two roi points": (front(roi_vehicle=[[0, 0], [1, 0]]), r"roi_vehicle: .*at least 3 points, got 2"),
    "bent roi": (front(roi_vehicle=[[0, 0], [4, 0], [1, 1], [0, 4]]), r"roi_vehicle: polygon is not convex"),
    "flat roi": (front(roi_vehicle=[[0, 0], [1, 0], [2, 0]]), r"polygon is not convex"),
    "bow tie": (front(roi_vehicle=[[0, 0], [1, 1], [1, 0], [0, 1]]), r"polygon is not convex"),
    "sigma": (front(centre_prior={"xyz": [0, 0, 2], "sigma_m": 0}), r"sigma_m: must be positive"),
    "prior typo": (front(centre_prior={"xyz": [0, 0, 2], "sigma": 1}), r"'sigma'; did you mean 'sigma_m'"),
    "negative read-out": (
        front(read_out_s=-0.01),
        r"read_out_s: -0.01 s is not a read-out time; give seconds",
    ),
    "long read-out": (
        front(read_out_s=1.0),
        r"read_out_s: 1 s is not .*, from 0 to 0.6, the time from image",
    ),
    "read-out nan": (front(read_out_s=float("nan")), r"read_out_s: expected a finite number, got nan"),
    "read-out text": (front(read_out_s="fast"), r"read_out_s: expected a finite number"),
    "linear": (front(linear_response="perhaps"), r"linear_response: expected true or false"),
}


def damages() -> Iterator[Case]:
    """All of them."""
    for name, (change, says) in DAMAGES.items():
        yield checked(f"damage: {name}", says, change)
