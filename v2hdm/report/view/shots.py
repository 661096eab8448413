"""The images that show a place of the map, each cut out with the outline that is drawn there now."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.detection.frames import read_image
from v2hdm.geometry.ipm import project_ground
from v2hdm.geometry.lens import distort_points
from v2hdm.io.maps.evidence import Residuals
from v2hdm.records import Drive, FloatArray, IntArray
from v2hdm.report.page.facts import Facts, cams_from_map, read_facts
from v2hdm.report.page.pictures import Cut, cut_out

_NEAR_M = 1.0  # least depth at which an image shows ground
_FAR_M = 25.0  # largest depth at which a person can tell what is painted there, chosen


@dataclass(frozen=True)
class Shots:
    """The images of a run with their poses; none where the drive or the residuals are not at hand."""

    facts: Facts | None
    residuals: Residuals | None
    cam_from_map: FloatArray  # (I, 4, 4) of the residuals' images

    @classmethod
    def of(cls, folder: Path, drive: Drive | None) -> Shots:
        """The shots of a result and its drive; raises V2hdmError where a file is damaged."""
        if drive is None:
            return cls(None, None, np.zeros((0, 4, 4)))
        facts = read_facts(folder, drive)
        if facts.residuals is None or facts.route is None:
            return cls(facts, None, np.zeros((0, 4, 4)))
        calibrations = {name: camera.calibration for name, camera in facts.cameras.items()}
        return cls(facts, facts.residuals, cams_from_map(facts.residuals, facts.route, calibrations))

    def showing(self, outline_map: FloatArray, start: int, count: int, marking: int | None) -> dict[str, Any]:
        """Cuts of the images that show an outline (N, 2), m, the nearest first, and how many there are.

        Of these, ``count`` from ``start`` on. The corners that were detected of a ``marking`` are drawn, too.
        """
        if self.residuals is None or self.facts is None or self.facts.drive is None:
            return {"count": 0, "shots": [], "says": "The images of the drive are not at hand."}
        rows = self._rows(outline_map)
        images = {self.facts.drive.name_of(image.path): image for image in self.facts.drive.images}
        shots = []
        for row in rows[start : start + count].tolist():
            name = self.residuals.image[row]
            image = images.get(name)
            if image is None:
                continue
            pixels = read_image(image, self.facts.drive.cameras[image.camera])
            cut = Cut("", 0, name, row, outline_map, self._seen_px(row, marking))
            picture = cut_out(pixels, self.facts, image, self.cam_from_map[row], cut)
            if picture is not None:
                shots.append({**picture, "image": name})
        return {"count": len(rows), "shots": shots, "says": ""}

    def _rows(self, outline_map: FloatArray) -> IntArray:
        """The images that show the whole outline, the nearest first."""
        assert self.residuals is not None
        assert self.facts is not None
        depth_of_row: dict[int, float] = {}
        cameras = np.array(self.residuals.camera)
        for name, camera in self.facts.cameras.items():
            info = camera.calibration.info
            rows = np.flatnonzero(cameras == name)
            px, depth_m = project_ground(info.intrinsic, self.cam_from_map[rows], outline_map)
            size = np.array([info.width, info.height])
            in_range = ((depth_m > _NEAR_M) & (depth_m < _FAR_M)).all(axis=1)
            for k in np.flatnonzero(in_range).tolist():
                recorded_px = distort_points(info, px[k])
                if (recorded_px > 0).all() and (recorded_px < size - 1).all():
                    depth_of_row[int(rows[k])] = float(depth_m[k].mean())
        return np.array(sorted(depth_of_row, key=depth_of_row.__getitem__), dtype=np.int64)

    def _seen_px(self, row: int, marking: int | None) -> FloatArray:
        """The corners (M, 2), recorded px, that were detected of a marking in an image."""
        residuals = self.residuals
        assert residuals is not None
        assert self.facts is not None
        camera = self.facts.cameras.get(residuals.camera[row])
        if marking is None or camera is None:
            return np.empty((0, 2))
        is_seen = (residuals.row_image == row) & (residuals.marking == marking) & residuals.is_point
        return distort_points(camera.calibration.info, residuals.observed_px[is_seen])
