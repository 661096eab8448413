"""What the report says of each camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from v2hdm.geometry.mounting import angle_sigmas, centre_sigmas, mounting_angles
from v2hdm.geometry.rigid import camera_centre
from v2hdm.report.page.cells import Table, name_of, number, table
from v2hdm.report.page.facts import CameraFacts, Facts


@dataclass(frozen=True)
class CameraPage:
    """What the report says of one camera: its words, its table, its picture (JPEG in base64)."""

    name: str
    words: str
    lens: str
    mounting: Table
    picture: str | None = None


def camera_pages(facts: Facts, pictures: Mapping[str, str]) -> tuple[CameraPage, ...]:
    """One for each camera that was calibrated."""
    extrinsics = facts.metrics.get("extrinsics") or {}
    out = []
    for name, one in facts.cameras.items():
        found = extrinsics.get(name, {})
        info = one.calibration.info
        words = str(found.get("certainty") or "").removeprefix(f"{name}: ")
        lens = (
            f"{info.width} × {info.height} px, focal length {info.intrinsic[0, 0]:.0f} px, "
            f"{name_of(info.distortion_model)}"
        )
        out.append(CameraPage(name, words, lens, _mounting(one, found), pictures.get(name)))
    return tuple(out)


def _mounting(one: CameraFacts, found: Mapping[str, Any]) -> Table:
    calibration = one.calibration
    matrix, covariance = calibration.cam_from_vehicle, calibration.covariance
    centre, angles = camera_centre(matrix), np.rad2deg(mounting_angles(matrix))
    unknown = np.full(3, np.nan)
    centre_sigma = unknown if covariance is None else centre_sigmas(matrix, covariance)
    angle_sigma = unknown if covariance is None else np.rad2deg(angle_sigmas(matrix, covariance))
    rows = [
        [f"centre {axis}", f"{number(centre[n], 3)} m", f"{number(centre_sigma[n], 1, 1e3)} mm",
         _change(found.get(f"{key}_change_m"), 1e3, 0, "mm")]
        for n, (axis, key) in enumerate((("forward", "x"), ("left", "y"), ("up", "z")))
    ]  # fmt: skip
    rows += [
        [axis, f"{number(angles[n], 3)}°", f"{number(angle_sigma[n], 3)}°",
         _change(found.get(f"{key}_change_deg"), 1.0, 2, "°")]
        for n, (axis, key) in enumerate((("roll", "roll"), ("pitch, down", "pitch"), ("yaw, left", "yaw")))
    ]  # fmt: skip
    if one.clock_offset_s is not None:
        rows.append([
            "clock, images later", f"{number(one.clock_offset_s, 1, 1e3)} ms",
            f"{number(one.clock_sigma_s, 1, 1e3)} ms", "–",
        ])  # fmt: skip
    return table(
        "",
        ("", "value", "± 1 σ", "changed by"),
        rows,
    )


def _change(value: object, factor: float, digits: int, unit: str) -> str:
    if not isinstance(value, int | float):
        return "–"
    sign = "+" if value > 0 else ""
    return f"{sign}{number(value, digits, factor)}{unit if unit == '°' else f' {unit}'}"
