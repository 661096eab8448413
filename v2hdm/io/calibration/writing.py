"""Writing the calibration of one camera: our own YAML, and the formats that other tools read as they are.

Files for other tools begin with comments on the camera, its sigmas, its drive and date and the verdict on
that run; without their ``#`` these lines are YAML. Frames have the names that the vehicle's own tree gives
them: that of the images is the optical one (REP 103), z forward and x right.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from v2hdm.errors import MapFileError
from v2hdm.geometry.frames import edges_of
from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.geometry.rigid import euler_from_rotation, quaternion_from_rotation
from v2hdm.io.calibration.reading import Provenance
from v2hdm.records import Calibration, CameraFrames, CameraInfo, FloatArray, FrameStep
from v2hdm.store.files import dump_yaml, replace_text, xml_text

_UNUSED = 1e-12  # largest distortion coefficient or skew that counts as zero: it moves no point by 1e-6 px


def write_calibration(
    calibration: Calibration,
    path: Path,
    *,
    clock_s: tuple[float, float] | None = None,
    read_out_s: tuple[float, float] | None = None,
    verdict: Mapping[str, Any] | None = None,
    about: Provenance | None = None,
) -> None:
    """Write our own calibration file, atomically.

    The sigmas refer to the left-perturbation tangent of ``cam_from_vehicle``, along the camera's own axes
    (right, down, forward), and left out without a covariance. ``clock_s`` is the delay of its images behind
    their stamps and its sigma (infinite where unknown), ``read_out_s`` the estimated time from first row to
    last and its sigma, ``verdict`` that on the run which found it, as JSON.
    """
    entries = _entries(calibration).items()
    content = {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in entries}
    content["distortion_coefficients"] = list(calibration.info.distortion)
    content |= _sigmas(calibration)
    if steps := calibration.frames.steps:
        content["transforms"] = [edge_entry(step) for step in steps]
    if calibration.frames.rectified_from_camera is not None:
        content["rectification"] = calibration.frames.rectified_from_camera.tolist()
    if clock_s is not None:
        content["clock_offset_s"] = float(clock_s[0])
        if np.isfinite(clock_s[1]):
            content["clock_sigma_s"] = float(clock_s[1])
    if read_out_s is not None:
        content["read_out_s"] = float(read_out_s[0])
        content["read_out_sigma_s"] = float(read_out_s[1])
    if about is not None:
        source = {"drive": about.drive, "date": about.date}
        content |= {key: value for key, value in source.items() if value is not None}
    if verdict is not None:
        content["verdict"] = dict(verdict)
    replace_text(path, dump_yaml(content))


def _frames(frames: CameraFrames) -> dict[str, Any]:
    """The names of the vehicle's own frames, as far as they are stated, and how high the vehicle's is."""
    names = {"vehicle_frame": frames.vehicle, "frame": frames.camera}
    height = {"vehicle_frame_height_m": frames.height_m} if frames.height_m else {}
    return {key: name for key, name in names.items() if name} | height


def edge_entry(step: FrameStep) -> dict[str, Any]:
    """An edge of a tree of frames as plain values; its ends alone where its transform is not known."""
    ends = {"frame_id": step.parent, "child_frame_id": step.child}
    return ends if step.parent_from_child is None else ends | _transform(step.parent_from_child)


def _transform(parent_from_child: FloatArray) -> dict[str, Any]:
    translation = dict(zip("xyz", parent_from_child[:3, 3].tolist(), strict=True))
    quaternion = quaternion_from_rotation(parent_from_child[None, :3, :3])[0]
    return {
        "translation": translation,
        "rotation": dict(zip("xyzw", quaternion.tolist(), strict=True)),
    }


def _entries(calibration: Calibration) -> dict[str, Any]:
    """The entries that files with all of a calibration share: numbers, words and arrays."""
    info = calibration.info
    covariance = calibration.covariance
    return {
        "camera_name": info.name,
        "image_width": info.width,
        "image_height": info.height,
        "camera_matrix": info.intrinsic,
        "distortion_model": info.distortion_model,
        "distortion_coefficients": np.array([info.distortion]),
        "cam_from_vehicle": calibration.cam_from_vehicle,
        "vehicle_from_pinhole_px": ipm_from_extrinsic(info, calibration.cam_from_vehicle),
        **({} if covariance is None else {"covariance": covariance}),
        **_frames(calibration.frames),
    }


def write_camera_info(info: CameraInfo, path: Path, rectification: FloatArray | None = None) -> None:
    """Write ``info`` as ROS' ``camera_info``, with the ``rectification`` (3, 3) of its images, atomically."""
    replace_text(path, dump_yaml(_camera_info(info, rectification)))


def _camera_info(info: CameraInfo, rectification: FloatArray | None = None) -> dict[str, Any]:
    return {
        "image_width": info.width,
        "image_height": info.height,
        "camera_name": info.name,
        "camera_matrix": _matrix(info.intrinsic),
        "distortion_model": info.distortion_model,
        "distortion_coefficients": _matrix(np.array([info.distortion])),
        "rectification_matrix": _matrix(np.eye(3) if rectification is None else rectification),
        "projection_matrix": _matrix(np.column_stack([info.intrinsic, np.zeros(3)])),
    }


def _camera_info_yaml(calibration: Calibration, about: Provenance) -> str:
    return _yaml(calibration, about, _camera_info(calibration.info))


def replaced_edge(calibration: Calibration) -> FrameStep:
    """The edge of the vehicle's tree nearest to the camera, as the calibration has it.

    Raises MapFileError where the tree, or the frames' names, are not known.
    """
    frames = calibration.frames
    where = f"camera '{calibration.info.name}'"
    if frames.problem:
        raise MapFileError(f"{where}: no place in the frames of its vehicle is known: {frames.problem}")
    stated = {"vehicle_frame": frames.vehicle, "frame": frames.camera}
    if missing := [key for key, name in stated.items() if not name]:
        raise MapFileError(
            f"{where}: its vehicle's own frames are not stated: add {' and '.join(missing)} to drive.yaml, "
            f"or to calibration_{calibration.info.name}.yaml (docs/exports.md)"
        )
    return edges_of(frames, calibration.cam_from_vehicle)[-1]


def static_transform_yaml(calibration: Calibration, about: Provenance) -> str:
    """A ``tf2_msgs/TFMessage``, as ``/tf_static`` takes it: the edge that the calibration replaces."""
    edge = replaced_edge(calibration)
    assert edge.parent_from_child is not None
    transform = {
        "header": {"frame_id": edge.parent},
        "child_frame_id": edge.child,
        "transform": _transform(edge.parent_from_child),
    }
    return _instead(calibration, about) + dump_yaml({"transforms": [transform]})


def urdf(calibration: Calibration, about: Provenance) -> str:
    """A URDF robot: two links, and the fixed joint between them whose origin the calibration replaces."""
    edge = replaced_edge(calibration)
    assert edge.parent_from_child is not None
    robot = ET.Element("robot", name="vehicle")
    for link in (edge.parent, edge.child):
        ET.SubElement(robot, "link", name=link)
    joint = ET.SubElement(robot, "joint", name=f"{edge.child}_joint", type="fixed")
    ET.SubElement(joint, "parent", link=edge.parent)
    ET.SubElement(joint, "child", link=edge.child)
    xyz = edge.parent_from_child[:3, 3].tolist()
    rpy = euler_from_rotation(edge.parent_from_child[:3, :3]).tolist()
    ET.SubElement(joint, "origin", xyz=" ".join(map(repr, xyz)), rpy=" ".join(map(repr, rpy)))
    comment = _instead(calibration, about).replace("--", "- -")
    return xml_text(robot, "  ", f"<!--\n{comment}-->\n")


def _instead(calibration: Calibration, about: Provenance) -> str:
    """The comments at the head, with the other edges that could be replaced, one alone, to the same end."""
    others = edges_of(calibration.frames, calibration.cam_from_vehicle)[:-1]
    return _comments(calibration, about, {"instead": [edge_entry(edge) for edge in others]} if others else {})


def kalibr_yaml(calibration: Calibration, about: Provenance) -> str:
    """A camera chain of Kalibr, with ``T_cam_vehicle`` for ``T_cam_imu``; refuses lenses that it lacks."""
    info = calibration.info
    (fx, skew, cx), (_, fy, cy), _ = info.intrinsic.tolist()
    models = {"plumb_bob": "radtan", "rational_polynomial": "radtan", "equidistant": "equidistant"}
    if info.distortion_model not in models or np.abs([skew, *info.distortion[4:]]).max() > _UNUSED:
        raise MapFileError(
            f"camera '{info.name}': Kalibr supports neither skew nor more than four coefficients, and this "
            f"is {info.distortion_model} {list(info.distortion)}; take its intrinsics from camera_info"
        )
    camera = {
        "camera_model": "pinhole",
        "intrinsics": [fx, fy, cx, cy],
        "distortion_model": models[info.distortion_model],
        "distortion_coeffs": list(info.distortion[:4]),
        "resolution": [info.width, info.height],
        "T_cam_vehicle": calibration.cam_from_vehicle.tolist(),
    }
    return _yaml(calibration, about, {"cam0": camera})


def opencv_yaml(calibration: Calibration, about: Provenance) -> str:
    """A file for ``cv2.FileStorage``: intrinsics, extrinsic, the IPM from undistorted pixels to ground."""
    storage = cv2.FileStorage(".yml", cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
    for key, value in _entries(calibration).items():
        storage.write(key, value)
    head, body = storage.releaseAndGetString().split("---\n", 1)
    return f"{head}---\n{_comments(calibration, about)}{body}"


CALIBRATION_FORMATS: Mapping[str, tuple[str, Callable[[Calibration, Provenance], str]]] = {
    "camera_info": ("camera_info.yaml", _camera_info_yaml),
    "static_transform": ("static_transform.yaml", static_transform_yaml),
    "urdf": ("origin.urdf", urdf),
    "kalibr": ("kalibr.yaml", kalibr_yaml),
    "opencv": ("opencv.yaml", opencv_yaml),
}
"""Formats of a calibration besides our own, by name: the ending of a file's name, and what makes its text."""


def write_calibration_as(
    name: str, calibration: Calibration, about: Provenance, folder: Path, stem: str
) -> Path:
    """Write a calibration to ``<folder>/<stem>_<ending>``, atomically; MapFileError for another lens."""
    ending, text_of = CALIBRATION_FORMATS[name]
    path = folder / f"{stem}_{ending}"
    replace_text(path, text_of(calibration, about))
    return path


def _yaml(calibration: Calibration, about: Provenance, content: Mapping[str, Any]) -> str:
    return _comments(calibration, about) + dump_yaml(content)


def _comments(calibration: Calibration, about: Provenance, more: Mapping[str, Any] | None = None) -> str:
    """The comments at the head of a file for another tool: YAML behind ``#``."""
    header: dict[str, Any] = {"camera_name": calibration.info.name}
    if calibration.covariance is not None:
        header["sigma_axes"] = "of the camera: right, down, forward"
    header |= _frames(calibration.frames) | dict(more or {})
    header |= _sigmas(calibration) | {"drive": about.drive, "date": about.date, "verdict": about.verdict}
    header = {key: value for key, value in header.items() if value is not None}
    return "".join(f"# {line}\n" for line in dump_yaml(header).splitlines())


def _sigmas(calibration: Calibration) -> dict[str, Any]:
    """Standard deviations of a calibration's translation and rotation; none without a covariance."""
    if calibration.covariance is None:
        return {}
    sigma = np.sqrt(np.diag(calibration.covariance))
    return {"translation_sigma_m": sigma[:3].tolist(), "rotation_sigma_deg": np.degrees(sigma[3:]).tolist()}


def _matrix(values: FloatArray) -> dict[str, Any]:
    return {"rows": values.shape[0], "cols": values.shape[1], "data": values.ravel().tolist()}
