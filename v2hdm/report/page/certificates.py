"""The calibration of each camera as a certificate: lens, mounting, its place in the vehicle's own tree."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from v2hdm.geometry.frames import edges_of
from v2hdm.geometry.rigid import euler_from_rotation, quaternion_from_rotation
from v2hdm.records import Calibration, FrameStep
from v2hdm.report.page.facts import CameraFacts, Facts, GroundResiduals
from v2hdm.report.page.identity import Row
from v2hdm.report.page.reference import NOT_STATED
from v2hdm.report.page.tables import CameraPage, Table, name_of, number, table


class Certificate(NamedTuple):
    """One camera: what it rests on, its lens, its mounting and its edges in the vehicle's tree of frames."""

    camera: CameraPage
    basis: tuple[Row, ...]
    lens: Table
    frames: Table | None
    frames_words: str


def certificates(
    facts: Facts, cameras: tuple[CameraPage, ...], residuals: GroundResiduals | None
) -> tuple[Certificate, ...]:
    """One certificate a camera."""
    return tuple(_certificate(facts, camera, facts.cameras[camera.name], residuals) for camera in cameras)


def _certificate(
    facts: Facts, camera: CameraPage, calibrated: CameraFacts, residuals: GroundResiduals | None
) -> Certificate:
    frames = calibrated.calibration.frames
    words = "Transforms of the vehicle’s own tree of frames, parent from child; replace one of them."
    edges: Table | None = None
    if frames.problem:
        words = f"The vehicle’s own tree of frames: {frames.problem}."
    elif not (frames.vehicle and frames.camera):
        words = f"The vehicle’s own tree of frames: {NOT_STATED}; the drive names no frames."
    else:
        edges = _edge_table(edges_of(frames, calibrated.calibration.cam_from_vehicle))
    return Certificate(
        camera, _basis(facts, camera.name, residuals), _lens(calibrated.calibration), edges, words
    )


def _basis(facts: Facts, name: str, residuals: GroundResiduals | None) -> tuple[Row, ...]:
    """The observations that the calibration rests on."""
    drive: Mapping[str, Any] = facts.metrics.get("drive") or {}
    rows = [Row("Drive", str(drive.get("name") or facts.folder.name))]
    digest = drive.get("images_sha256")
    if digest:
        rows.append(Row("Images, SHA-256", str(digest)[:16]))
    if residuals is not None and name in residuals.cameras:
        of_camera = residuals.camera == residuals.cameras.index(name)
        size_px = residuals.size_px[of_camera & residuals.is_point]
        rows.append(Row("Corner observations", f"{int(of_camera.sum()):,}"))
        images = len(np.unique(residuals.taken_s[of_camera]))
        rows.append(Row("Images with markings", f"{images:,}"))
        if len(size_px):
            rmse_px = float(np.sqrt(np.mean(np.square(size_px))))
            rows.append(Row("Reprojection error, RMS", f"{number(rmse_px, 2)} px"))
    rows.append(Row("Software", f"V2HDM {facts.metrics.get('version', '')}".strip()))
    return tuple(rows)


def _lens(calibration: Calibration) -> Table:
    """The intrinsics, which the adjustment has taken as given."""
    info = calibration.info
    matrix = info.intrinsic
    rows = [
        ["image", f"{info.width} × {info.height} px"],
        ["focal length", f"{matrix[0, 0]:.2f} px, {matrix[1, 1]:.2f} px"],
        ["principal point", f"{matrix[0, 2]:.2f} px, {matrix[1, 2]:.2f} px"],
        ["lens model", name_of(info.distortion_model)],
        ["coefficients", ", ".join(_short(value) for value in info.distortion) or "none"],
    ]
    return table(("", ""), rows, words=2)


def _short(value: float) -> str:
    return f"{value:.5g}".replace("-", "−")


def _edge_table(edges: list[FrameStep]) -> Table | None:
    """Each edge that the calibration may replace: its ends, translation and rotation."""
    rows = []
    for edge in edges:
        if edge.parent_from_child is None:
            continue
        place_m = ", ".join(number(value, 4) for value in edge.parent_from_child[:3, 3].tolist())
        angles = np.degrees(euler_from_rotation(edge.parent_from_child[:3, :3]))
        angles_deg = ", ".join(number(value, 3) for value in angles.tolist())
        quaternion = quaternion_from_rotation(edge.parent_from_child[None, :3, :3])[0]
        numbers = ", ".join(number(value, 6) for value in quaternion.tolist())
        rows.append([f"{edge.parent} → {edge.child}", place_m, angles_deg, numbers])
    headings = ("parent → child", "x, y, z (m)", "roll, pitch, yaw (°)", "quaternion x, y, z, w")
    return table(headings, rows, words=4) if rows else None
