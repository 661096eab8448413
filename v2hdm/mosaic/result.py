"""From the folder of a run to the mosaic of its ground, written beside the map."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.detection.batch import with_own_vehicle
from v2hdm.detection.detector import Detector
from v2hdm.errors import ConfigError, DriveError, MapFileError
from v2hdm.io.calibration.document import read_calibration
from v2hdm.io.drive.tum import read_tum
from v2hdm.io.maps.geojson import read_geojson
from v2hdm.mosaic.blend import Sheet, blend
from v2hdm.mosaic.canvas import Canvas
from v2hdm.mosaic.comparison import richest_place, save_comparison
from v2hdm.mosaic.files import MULTIPLE_PX, Picture, crs_of, geotiff
from v2hdm.mosaic.sharpness import edge_widths_m, measure_edges, no_edges, paint_sides
from v2hdm.mosaic.shots import Lens, Shot, adjusted_shots, lens_of, recorded_shots
from v2hdm.records import Calibration, Drive, FloatArray
from v2hdm.report.outputs import write_json
from v2hdm.store.files import load_yaml, take_number

_log = logging.getLogger(__name__)

RESOLUTION_M = 0.02
"""Side of a pixel of the mosaic unless another is asked for."""

TIFF, PICTURE, EXTENT, COMPARISON = "mosaic.tif", "mosaic.webp", "mosaic.json", "mosaic_before_after.png"

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Ground:
    """Cameras, images under the adjusted and under the initial calibration, and the canvas for both."""

    lenses: Mapping[str, Lens]
    after: Sequence[Shot]
    before: Sequence[Shot]
    canvas: Canvas


def write_mosaic(
    folder: Path,
    drive: Drive,
    resolution_m: float = RESOLUTION_M,
    device: str = "cpu",
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write the mosaic of a run's ground into its folder; returns what stands in ``mosaic.json``.

    Args:
        folder: of the run: its map, calibrations and adjusted trajectory.
        drive: what the run has mapped.
        resolution_m: side of a pixel on the ground.
        device: of torch.
        progress: called as ``progress(done, total)``, in images put onto the ground.

    Raises:
        MapFileError: the folder is no result, or not one of this drive.
        DriveError: an image is missing or damaged.
        ConfigError: the resolution makes no mosaic.
    """
    if not resolution_m > 0:
        raise ConfigError(f"a resolution of {resolution_m:g} m a pixel makes no mosaic; give a positive one")
    hd_map = read_geojson(folder / "map.geojson")
    ground = ground_of(folder, drive, resolution_m)
    sides = paint_sides(hd_map)
    before, after = (no_edges(len(sides.ends_map)) for _ in range(2))
    picture = Picture(ground.canvas)
    tell = _two_passes(progress)
    with ExitStack() as stack:
        try:
            tiff = stack.enter_context(geotiff(folder / TIFF, ground.canvas, drive.origin))
        except ConfigError as missing:
            _log.warning("no GeoTIFF is written: %s", missing)
            tiff = None
        for sheet in blend(ground.canvas, ground.after, ground.lenses, device, tell(0)):
            if tiff is not None:
                tiff.put(sheet)
            picture.put(sheet)
            after = after.with_those_of(
                measure_edges(sheet.rgba, _part(ground.canvas, sheet), sides.ends_map)
            )
    for sheet in blend(ground.canvas, ground.before, ground.lenses, device, tell(1)):
        before = before.with_those_of(measure_edges(sheet.rgba, _part(ground.canvas, sheet), sides.ends_map))
    picture.write(folder / PICTURE)
    sharpness = _sharpness(*edge_widths_m([before, after]))
    content = {
        "image": PICTURE,
        "bounds_m": ground.canvas.bounds_m,
        "resolution_m": picture.resolution_m,
        "geotiff": None if tiff is None else TIFF,
        "geotiff_resolution_m": resolution_m,
        "crs": crs_of(drive.origin),
        "sharpness": sharpness,
    }
    _compare(folder / COMPARISON, ground, richest_place(drive, sides, after.contrast), sharpness, device)
    write_json(folder / EXTENT, content)
    return content


def _part(canvas: Canvas, sheet: Sheet) -> Canvas:
    rows, columns = sheet.rgba.shape[:2]
    return canvas.window(sheet.row, sheet.column, rows, columns)


def _sharpness(before_m: FloatArray, after_m: FloatArray) -> dict[str, float | int]:
    """The median width, m, of paint edges before and after, and how many times the one is the other."""
    if not len(after_m):
        return {"edges": 0}
    widths = float(np.median(before_m)), float(np.median(after_m))
    return {
        "edges": len(after_m),
        "edge_width_before_m": widths[0],
        "edge_width_after_m": widths[1],
        "after_over_before": widths[0] / widths[1],
    }


def ground_of(folder: Path, drive: Drive, resolution_m: float) -> Ground:
    """The ground that a run's images show, and the canvas around it; errors as :func:`write_mosaic`."""
    calibrations, clock_s = _calibrations(folder)
    missing = [name for name in drive.cameras if name not in calibrations]
    if len(missing) == len(drive.cameras):
        raise MapFileError(
            f"{folder} is calibrated for {', '.join(calibrations)}, drive {drive.name} has "
            f"{', '.join(missing)}: give the drive that this result is of"
        )
    for name in missing:
        _log.warning("camera %s has no calibration in %s: its images are left out", name, folder)
    adjusted = read_tum(folder / "trajectory.tum")
    taken_s = np.array([image.taken_s for image in drive.images])
    if adjusted.stamp_s[0] > taken_s.max() or adjusted.stamp_s[-1] < taken_s.min():
        raise MapFileError(
            f"{folder / 'trajectory.tum'} and drive {drive.name} share no time: give the drive that this "
            "result is of"
        )
    drive = with_own_vehicle(drive, Detector.load())
    lenses = {
        name: lens_of(drive.cameras[name], calibration.cam_from_vehicle)
        for name, calibration in calibrations.items()
        if name in drive.cameras
    }
    after = adjusted_shots(drive, calibrations, clock_s, adjusted)
    before = [shot for shot in recorded_shots(drive) if shot.camera in lenses]
    seen = np.concatenate([shot.outline_map(lenses[shot.camera]) for shot in after])
    if not np.isfinite(seen).all():
        raise DriveError(f"drive {drive.name}: an ROI reaches the horizon; draw it nearer to the camera")
    return Ground(lenses, after, before, Canvas.around(seen, resolution_m, MULTIPLE_PX))


def _calibrations(folder: Path) -> tuple[dict[str, Calibration], dict[str, float]]:
    """By camera its calibration, and how much later than stamped its images were taken, s."""
    files = sorted(folder.glob("calibration_*.yaml"))
    if not files:
        raise MapFileError(f"{folder}: no calibration_*.yaml in it; give the result folder of v2hdm map")
    calibrations, clock_s = {}, {}
    for file in files:
        calibration = read_calibration(file)
        calibrations[calibration.info.name] = calibration
        clock_s[calibration.info.name] = take_number(
            load_yaml(file, MapFileError).get("clock_offset_s", 0.0), f"{file}: clock_offset_s", MapFileError
        )
    return calibrations, clock_s


def _compare(
    path: Path, ground: Ground, pose: FloatArray, sharpness: Mapping[str, float], device: str
) -> None:
    titles = "before: initial calibration, recorded poses", "after: optimised calibration, adjusted poses"
    widths = [sharpness.get(f"edge_width_{when}_m") for when in ("before", "after")]
    captions = [
        "" if width is None else f"paint edges {100 * width:.1f} cm wide (median)" for width in widths
    ]
    save_comparison(
        path,
        pose,
        dict(zip(titles, (ground.before, ground.after), strict=True)),
        ground.lenses,
        dict(zip(titles, captions, strict=True)),
        device,
    )


def _two_passes(progress: Progress | None) -> Callable[[int], Progress | None]:
    """A progress for each of two passes of about the same work."""

    def of(number: int) -> Progress | None:
        if progress is None:
            return None
        return lambda done, total: progress(number * total + done, 2 * total)

    return of
