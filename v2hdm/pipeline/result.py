"""The result of a mapped drive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm import __version__
from v2hdm.doors import checked, checked_class
from v2hdm.errors import MappingError
from v2hdm.geometry.planar import length_along
from v2hdm.io.drive import ReadOptions, told_of
from v2hdm.io.maps.features import with_heights
from v2hdm.mapping.results import AdjustedPoses, MethodResult
from v2hdm.pipeline.config import Contents, made_of_drives
from v2hdm.pipeline.context import Context
from v2hdm.pipeline.evaluate import CameraSets
from v2hdm.records import BEST, Calibration, Drive, HDMap, ImageDetections
from v2hdm.store.cache import library_versions
from v2hdm.survey.check_points import CheckTable
from v2hdm.topology.answers import Answer
from v2hdm.verdict import Verdict


def describe_run(
    name: str, drive: Drive, contents: Contents, paths: Sequence[Path], options: ReadOptions
) -> dict[str, Any]:
    """The beginning of ``metrics.json``: name, version, date (UTC), the drive at ``paths`` as it was read."""
    stamp_s = [image.stamp_s for image in drive.images]
    reception = drive.reception
    return {
        "name": name,
        "version": __version__,
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "drive": {
            **told_of(drive, paths, options, contents.digests.__getitem__),
            "duration_s": round(float(np.ptp(stamp_s)), 3),
            "length_m": round(float(length_along(drive.route_map)[-1]), 2),
            "position_sigma_m": drive.pose_noise.position_m,
            "heading_sigma_deg": round(float(np.rad2deg(drive.pose_noise.heading_rad)), 4),
            "sessions_s": [list(span) for span in drive.spans_s],
            **({} if reception is None else {"reception": asdict(reception)}),
        },
        "versions": {"v2hdm": __version__, **library_versions()},
    }


@checked_class
@dataclass(frozen=True)
class Result:
    """The map of a drive, its calibrations, trajectory and verdict.

    Attributes:
        about: name, date, versions and the drive, as ``metrics.json`` begins.
        drives: as they were read.
        contents: digests of their images.
        drive: what was mapped, several drives as one; its clocks are corrected.
        seconds: how long each step took, s.
        device: what torch computed on.
        verdict: all findings, the worst first; ``verdict.status`` is PASS, WARN or FAIL.
        figures: those of ``metrics.json`` beside what it begins with.
        headlines: sentences for a reader.
        detections: in each image of ``drive``.
        methods: results by camera set, then by method, those of all cameras last; empty where no map came.
        check_points: a survey's check points against the map; None without any.
        answers: a person's on lanes, which the lanes of exported maps follow.

    >>> saved = result.save(folder / "port")
    >>> sorted(path.name for path in saved.glob("*.geojson"))
    ['excluded.geojson', 'map.geojson']
    >>> result.trajectory.map_from_vehicle.shape[1:], result.trajectory.sigma.shape[1:]
    ((4, 4), (6,))
    """

    about: Mapping[str, Any]
    drives: tuple[Drive, ...]
    contents: Contents
    drive: Drive
    seconds: dict[str, float]
    device: str = "cpu"
    verdict: Verdict = field(default_factory=lambda: Verdict(()))
    figures: Mapping[str, Any] = field(default_factory=dict)
    headlines: Sequence[str] = ()
    detections: Sequence[ImageDetections] = ()
    methods: CameraSets = field(default_factory=dict)
    check_points: CheckTable | None = None
    answers: tuple[Answer, ...] = ()

    @property
    def metrics(self) -> dict[str, Any]:
        """The content of ``metrics.json``."""
        return {**self.about, "verdict": self.verdict.as_json(), **self.figures}

    @property
    def best(self) -> MethodResult:
        """The joint optimisation with all cameras.

        Raises:
            MappingError: no map came of the drive; the verdict says why.
        """
        if not self.methods:
            raise MappingError(f"{self.about['name']}: this drive gave no map; its verdict says why")
        return list(self.methods.values())[-1][BEST]

    @property
    def map(self) -> HDMap:
        """The map, in the frame ``map``: m, its lane lines in the direction in which they were passed."""
        return _along_route(with_heights(self.best.hd_map, self.drive.road), self.drive)

    @property
    def calibrations(self) -> Mapping[str, Calibration]:
        """By camera ``cam_from_vehicle`` (4, 4) and the covariance (6, 6) of its tangent."""
        return self.best.calibrations

    @property
    def trajectory(self) -> AdjustedPoses:
        """``map_from_vehicle`` (F, 4, 4) at the images' times, on the flat road; sigmas (F, 6): m, rad."""
        poses = self.best.poses
        assert poses is not None  # of the joint optimisation they always are
        return poses

    @checked
    def save(
        self,
        folder: Path | str,
        formats: Sequence[str] = ("geojson",),
        all_maps: bool = False,
        mosaic: bool = True,
        crs: str | None = None,
    ) -> Path:
        """Write all that ``v2hdm map`` writes into ``folder``, whole or not at all; returns the folder.

        Args:
            folder: is made, or has an earlier result, which is replaced; nobody else's file is.
            formats: of the map: ``geojson``, ``csv``, ``gpkg``, ``lanelet2``, ``dxf``, ...
            all_maps: whether every map that was made is written, into ``maps/``.
            mosaic: whether the ground of a single drive is shown from above, too.
            crs: the system of coordinates of the formats but ``geojson``, as ``EPSG:25832`` or ``local``.

        Raises:
            ConfigError: there is something else in the folder, or a format cannot be written.
        """
        from v2hdm.pipeline.saving import Outputs, write_result  # all writers, the page and the mosaic
        from v2hdm.store.results import result_folder

        outputs = Outputs(formats=formats, all_maps=all_maps, mosaic=mosaic, crs=crs)
        maker = made_of_drives(self.about["drive"]["paths"])
        with result_folder(Path(folder), "folder", maker) as unfinished:
            write_result(self, unfinished, outputs, Context(seconds=self.seconds))
        return Path(folder)


_BY_VERTEX = ("points_map", "heights_m", "sigma_m", "heights_sigma_m")


def _along_route(hd_map: HDMap, drive: Drive) -> HDMap:
    """The map with every lane line in the direction in which the drive passed it: that of its lanelets."""
    route_map = drive.route_map
    ahead = np.array([image.map_from_vehicle[:2, 0] for image in drive.images])
    lanes = []
    for lane in hd_map.lanes:
        offset = lane.points_map[:, None] - route_map
        passed = ahead[np.argmin((offset**2).sum(axis=2), axis=1)]
        if (passed * np.gradient(lane.points_map, axis=0)).sum() < 0:
            by_vertex = {name: getattr(lane, name) for name in _BY_VERTEX}
            turned = {name: values[::-1] for name, values in by_vertex.items() if values is not None}
            lane = replace(lane, **turned)
        lanes.append(lane)
    return replace(hd_map, lanes=tuple(lanes))
