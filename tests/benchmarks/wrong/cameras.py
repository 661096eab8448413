"""Wrong cameras, images and settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tests.benchmarks.wrong.fault import CAMERAS, Fault, edit, edit_cameras, edit_lens
from v2hdm.errors import DriveError
from v2hdm.geometry.rigid import rotation_from_euler
from v2hdm.io.image_lists import read_image_list, write_image_list
from v2hdm.mapping.options import MappingOptions, SizeOptions
from v2hdm.records import FloatArray
from v2hdm.store.files import load_yaml


def _swap_cameras(folder: Path) -> None:
    def swap(content: dict[str, Any]) -> None:
        front, rear = (content["cameras"][name] for name in CAMERAS)
        front["images"], rear["images"] = rear["images"], front["images"]

    edit(folder, swap)


def _one_camera_twice(folder: Path) -> None:
    edit(folder, lambda content: content["cameras"]["rear"].update(images="front/images.txt"))


def _scale_k(factors: tuple[float, float], entry: dict[str, Any]) -> None:
    data = entry["camera_matrix"]["data"]
    data[0], data[4] = data[0] * factors[0], data[4] * factors[1]


def _half_resolution_k(entry: dict[str, Any]) -> None:
    data = entry["camera_matrix"]["data"]
    for k in (0, 2, 4, 5):
        data[k] *= 0.5


def _principal_point(shift_px: float, entry: dict[str, Any]) -> None:
    entry["camera_matrix"]["data"][2] += shift_px


def _distortion(factor: float, entry: dict[str, Any]) -> None:
    entry["distortion_coefficients"]["data"] = [
        factor * value for value in entry["distortion_coefficients"]["data"]
    ]


def _survey(scale: tuple[float, ...], shift_m: tuple[float, ...], entry: dict[str, Any]) -> None:
    xyz = np.array(entry["centre_prior"]["xyz"])
    entry["centre_prior"]["xyz"] = (xyz * scale + shift_m).tolist()


def _turn_guess(folder: Path, axis: int, angle_deg: float) -> None:
    """Turn the guess of each camera's mounting about a vehicle axis through its centre."""
    for camera in CAMERAS:
        info = load_yaml(folder / camera / "camera_info.yaml", DriveError)
        intrinsic = np.array(info["camera_matrix"]["data"]).reshape(3, 3)

        def turn(content: dict[str, Any], camera: str = camera, intrinsic: FloatArray = intrinsic) -> None:
            entry = content["cameras"][camera]
            columns = np.linalg.solve(intrinsic, np.linalg.inv(np.array(entry["ipm"][entry["initial_ipm"]])))
            columns /= np.mean(np.linalg.norm(columns[:, :2], axis=0))
            columns *= np.sign(columns[2] @ [*np.mean(entry["roi_vehicle"], axis=0), 1.0])
            pose = np.column_stack([columns[:, 0], columns[:, 1], np.cross(columns[:, 0], columns[:, 1])])
            left, _, right = np.linalg.svd(pose)
            rotation = left @ right
            centre = -rotation.T @ columns[:, 2]
            angles = [np.zeros(1)] * 3
            angles[axis] = np.array([np.deg2rad(angle_deg)])
            turned = rotation @ rotation_from_euler(*angles)[0]
            guess = np.eye(4)
            guess[:3, :3], guess[:3, 3] = turned, -turned @ centre
            for key in ("ipm", "initial_ipm"):
                entry.pop(key)
            entry["cam_from_vehicle"] = guess.tolist()

        edit(folder, turn)


def _invert_guess(folder: Path) -> None:
    _turn_guess(folder, 2, 0.0)
    edit_cameras(
        lambda entry: entry.update(
            cam_from_vehicle=np.linalg.inv(np.array(entry["cam_from_vehicle"])).tolist()
        ),
        folder,
    )


def _roi(points: Callable[[FloatArray], FloatArray], entry: dict[str, Any]) -> None:
    entry["roi_vehicle"] = points(np.array(entry["roi_vehicle"])).tolist()


def _pictures(change: Callable[[np.ndarray], np.ndarray], folder: Path) -> None:
    for camera in CAMERAS:
        source = folder / camera / "images"
        files = sorted(source.resolve().iterdir())
        source.unlink()
        source.mkdir()
        for file in files:
            cv2.imwrite(str(source / file.name), change(cv2.imread(str(file))))


def _frozen_images(folder: Path) -> None:
    for camera in CAMERAS:
        stamp_s, names = read_image_list(folder / camera / "images.txt")
        begin = len(names) // 2
        names[begin : begin + 15] = [names[begin]] * 15
        write_image_list(stamp_s, names, folder / camera / "images.txt")


def _off_by_one(folder: Path) -> None:
    for camera in CAMERAS:
        stamp_s, names = read_image_list(folder / camera / "images.txt")
        write_image_list(stamp_s[:-1], names[1:], folder / camera / "images.txt")


def _every_second(folder: Path) -> None:
    for camera in CAMERAS:
        stamp_s, names = read_image_list(folder / camera / "images.txt")
        write_image_list(stamp_s[::2], names[::2], folder / camera / "images.txt")


def _wide(points: FloatArray) -> FloatArray:
    """A region that reaches 60 m from the vehicle."""
    far = np.abs(points[:, 0]) > np.abs(points[:, 0]).mean()
    return np.where(far[:, None], points * (60.0 / np.abs(points[:, :1])), points)


def _tiny(points: FloatArray) -> FloatArray:
    """The region shrunk to a twentieth about its middle."""
    middle = points.mean(axis=0)
    return np.asarray(middle + 0.05 * (points - middle))


def _upside_down(picture: np.ndarray) -> np.ndarray:
    return picture[::-1, ::-1]


def _mirrored(picture: np.ndarray) -> np.ndarray:
    return picture[:, ::-1]


def _overexposed(picture: np.ndarray) -> np.ndarray:
    return cv2.convertScaleAbs(picture, alpha=4.0)


def _linear(entry: dict[str, Any]) -> None:
    entry["linear_response"] = True


def _sizes(**sizes: list[float]) -> Callable[[MappingOptions], MappingOptions]:
    return lambda options: replace(options, known_sizes=SizeOptions(by_class_m=dict(sizes)))


def camera_faults() -> list[Fault]:
    """All that can be wrong with cameras, images and settings."""
    lens, distortion, clock = "focal|camera_info|square pixels", "distortion", r"\bclock|\bstamps?\b"
    return [
        Fault("front and rear images swapped", "swapped|other way|backward", _swap_cameras),
        Fault("one camera's images given twice", "twice|identical|swapped|other way", _one_camera_twice),
        Fault("fx 5 % too large", lens, partial(edit_lens, partial(_scale_k, (1.05, 1.0)))),
        Fault("fx and fy 5 % too large", lens, partial(edit_lens, partial(_scale_k, (1.05, 1.05)))),
        Fault("K of half the resolution", lens, partial(edit_lens, _half_resolution_k)),
        Fault(
            "principal point 60 px off",
            f"{lens}|principal",
            partial(edit_lens, partial(_principal_point, 60.0)),
        ),
        Fault("distortion left zero", distortion, partial(edit_lens, partial(_distortion, 0.0))),
        Fault("distortion of the wrong sign", distortion, partial(edit_lens, partial(_distortion, -1.0))),
        Fault(
            "survey: wrong sign of x",
            r"\bsurvey|\bcentre",
            partial(edit_cameras, partial(_survey, (-1.0, 1.0, 1.0), (0.0, 0.0, 0.0))),
        ),
        Fault(
            "survey: 10 cm too high",
            r"\bsurvey|\bcentre|camera height",
            partial(edit_cameras, partial(_survey, (1.0, 1.0, 1.0), (0.0, 0.0, 0.1))),
        ),
        Fault(
            "survey: 30 cm ahead",
            r"\bsurvey|\bcentre",
            partial(edit_cameras, partial(_survey, (1.0, 1.0, 1.0), (0.3, 0.0, 0.0))),
            hidden_on_straight=r"\bsurvey|\bcentre",
        ),
        Fault("guess: pitch 10 deg off", None, partial(_turn_guess, axis=1, angle_deg=10.0)),
        Fault("guess: yaw 10 deg off", None, partial(_turn_guess, axis=2, angle_deg=10.0)),
        Fault("guess inverted", r"invers|cam_from_vehicle|\bguess\b", _invert_guess),
        Fault("ROI behind the camera", "roi", partial(edit_cameras, partial(_roi, np.negative))),
        Fault("ROI of half a metre", "roi", partial(edit_cameras, partial(_roi, _tiny))),
        Fault("ROI of 60 m", None, partial(edit_cameras, partial(_roi, _wide))),
        Fault("images upside down", "upside|rotated|turned by 180", partial(_pictures, _upside_down)),
        Fault("images mirrored", "mirror", partial(_pictures, _mirrored)),
        Fault("images overexposed", "clipped|exposed|bright", partial(_pictures, _overexposed)),
        Fault("images frozen for 15 frames", "frozen|repeat|identical", _frozen_images),
        Fault("stamps and images off by one", clock, _off_by_one, hidden_on_straight=clock),
        Fault("every second image missing", None, _every_second),
        Fault("linear_response wrong", None, partial(edit_cameras, _linear)),
        Fault(
            "known_sizes 10 % too large",
            "known_sizes",
            mapping=_sizes(diamond=[1.1, 0.77], lane_dash=[2.2, 0.13]),
        ),
        Fault("known_sizes 5 % too small", "known_sizes", mapping=_sizes(diamond=[0.95, 0.665])),
    ]
