"""Fields of several file formats, read with the same checks: cameras, covariances, the map's origin."""

from __future__ import annotations

import logging

import numpy as np

from v2hdm.errors import V2hdmError, shown
from v2hdm.records import CameraInfo, FloatArray, GeodeticOrigin
from v2hdm.store.files import check_keys, take_array, take_mapping, take_number, take_text

_log = logging.getLogger(__name__)

_LONGEST_NAME = 255  # letters of a frame's name; chosen
_HIGHEST_FRAME_M = 12.0  # of a vehicle above the ground, straddle carriers included
_LONGEST_DATUM = 200  # letters of a datum's name; chosen
_LARGEST_PX = 65535  # side of an image: JPEG has no larger one
_LONGEST_FOCAL_PX = 1e6  # focal length, or offset of the centre, of any camera; chosen
_ROUNDING = 1e-3  # relative rounding error that a covariance may have
_MIDDLE = 1.0  # focal lengths from the axis to 45 degrees from it: farther out radial terms prevail
_WIDEST_RAD = np.deg2rad(89.5)  # rays farther from the axis have no pixel in the pinhole image


def take_size_px(content: object, where: str, error: type[V2hdmError]) -> int:
    """``content`` as the width or height of an image."""
    return take_whole(content, 1, _LARGEST_PX, where, error)


def take_whole(content: object, least: int, most: int, where: str, error: type[V2hdmError]) -> int:
    """``content`` as a whole number of a range."""
    value = take_number(content, where, error)
    if value != int(value) or not least <= value <= most:
        raise error(f"{where}: expected a whole number of {least} to {most}, got {value:g}; fix it")
    return int(value)


def take_frame(content: object, where: str, error: type[V2hdmError]) -> str:
    """``content`` as the name of a frame of TF, without the slash that old recorders put before it."""
    name = take_text(content, where, error).lstrip("/")
    if not name or len(name) > _LONGEST_NAME or not name.isprintable() or " " in name:
        raise error(f"{where}: {shown(content)} is not the name of a frame, such as base_link; fix it")
    return name


def take_frame_height(content: object, where: str, error: type[V2hdmError]) -> float:
    """``content`` as the height, m, of a vehicle's frame above the ground."""
    height_m = take_number(content, where, error)
    if abs(height_m) > _HIGHEST_FRAME_M:
        raise error(f"{where}: {height_m:g} m is not the height of a vehicle's frame; give metres")
    return height_m


def take_origin(content: object, where: str, error: type[V2hdmError]) -> GeodeticOrigin | None:
    """``content`` as the map's place on the earth; None where there is none."""
    if content is None:
        return None
    entry = take_mapping(content, where, error)
    check_keys(entry, ("latitude_deg", "longitude_deg", "altitude_m"), ("datum", "epoch"), where, error)

    def number(key: str) -> float:
        return take_number(entry[key], f"{where}, {key}", error)

    latitude_deg = number("latitude_deg")
    longitude_deg = number("longitude_deg")
    if abs(latitude_deg) > 90 or abs(longitude_deg) > 180:
        raise error(f"{where}: latitude must lie within +-90 and longitude within +-180 degrees; fix them")
    datum = take_text(entry.get("datum", "WGS84"), f"{where}, datum", error)
    if not datum.isprintable() or len(datum) > _LONGEST_DATUM:
        raise error(f"{where}, datum: {shown(datum)} is not the name of a datum; give one such as ETRS89")
    return GeodeticOrigin(
        latitude_deg=latitude_deg,
        longitude_deg=longitude_deg,
        altitude_m=number("altitude_m"),
        datum=datum,
        epoch=None if entry.get("epoch") is None else number("epoch"),
    )


def take_covariance(content: object, size: int, where: str, error: type[V2hdmError]) -> FloatArray:
    """``content`` as a covariance (size, size), perhaps written with fewer digits than it has."""
    matrix = take_array(content, (size, size), where, error)
    variance = np.diag(matrix)
    with np.errstate(all="ignore"):  # absurd numbers fail the tests that follow
        sigma = np.sqrt(variance)
        scale = np.outer(sigma, sigma)
        correlation = matrix / np.where(scale > 0, scale, 1.0)
        symmetric = np.abs(correlation - correlation.T).max() <= _ROUNDING
    if (variance < 0).any() or not symmetric or np.linalg.eigvalsh(correlation).min() <= -_ROUNDING:
        raise error(f"{where}: not symmetric or negative somewhere; fix it or leave it out")
    return matrix


def check_camera(info: CameraInfo, where: str, error: type[V2hdmError]) -> CameraInfo:
    """Return ``info``; refuse an impossible camera matrix and a lens that cannot be undone in the image.

    A lens that folds over itself in the image's corners only, where its target never was, is a warning.
    """
    (fx, skew, cx), (zero, fy, cy), last = info.intrinsic
    if min(fx, fy) <= 0 or zero or list(last) != [0, 0, 1]:
        problem = "not of the form fx s cx, 0 fy cy, 0 0 1 with positive fx, fy"
        raise error(f"{where}: camera_matrix: {problem}; fix it")
    if max(fx, fy, abs(skew), abs(cx), abs(cy)) > _LONGEST_FOCAL_PX:
        raise error(f"{where}: camera_matrix: beyond {_LONGEST_FOCAL_PX:g} px; fix it")
    # The image's reach from the axis to a side, and up or down, in focal lengths.
    with np.errstate(over="ignore"):  # focal lengths may be of any size
        across = max(abs(cx + 0.5), abs(info.width - 0.5 - cx)) / fx
        down = max(abs(cy + 0.5), abs(info.height - 0.5 - cy)) / fy
    at = f"{where}: distortion_coefficients"
    k = info.distortion
    # The tangential part moves a point at r focal lengths by up to 3 p r^2, so that neighbours change places
    # where 6 p r reaches 1; every real lens is below a tenth of that.
    tangential = np.hypot(k[2], k[3]) if info.distortion_model != "equidistant" and len(k) > 3 else 0.0
    if 6 * tangential * min(max(across, down), _MIDDLE) >= 1:
        raise error(f"{at}: p1 and p2 of {k[2]:g} and {k[3]:g} flip the image; order k1 k2 p1 p2 k3")
    reach = lens_reach(info)
    scale_px = (fx + fy) / 2
    if reach >= np.hypot(across, down):
        return info
    problem = (
        f"{at}: this lens folds over itself {scale_px * reach:.0f} px from its centre, and the image reaches "
        f"{scale_px * np.hypot(across, down):.0f} px from there"
    )
    if reach < max(across, down):
        raise error(f"{problem}; calibrate it again with points up to the image's corners")
    _log.warning("%s: do not trust what lies in its corners; calibrate with points up to there", problem)
    return info


def lens_reach(info: CameraInfo) -> float:
    """The radius within which recorded points have one ray each, in focal lengths; infinite for most."""
    angles = np.linspace(0, _WIDEST_RAD, 4096)
    with np.errstate(all="ignore"):  # absurd coefficients do not rise
        recorded = recorded_distance(info, angles)
        falls = np.flatnonzero(~(np.diff(recorded) > 0))
    return float(recorded[falls[0]]) if len(falls) else np.inf


def recorded_distance(info: CameraInfo, angles: FloatArray) -> FloatArray:
    """Distance from the centre, in focal lengths, of rays by their angles from the axis (rad)."""
    k = info.distortion
    if info.distortion_model == "equidistant":
        square = angles**2
        return angles * (1 + square * (k[0] + square * (k[1] + square * (k[2] + square * k[3]))))
    rays = np.tan(angles)
    square = rays**2
    recorded: FloatArray = rays * (1 + square * (k[0] + square * (k[1] + square * k[4])))
    if len(k) > 5:
        recorded /= 1 + square * (k[5] + square * (k[6] + square * k[7]))
    return recorded
