"""A run in the Rerun viewer, and in a recording that it replays: images, detections, map and cameras.

In the viewer's tree the site is ``map``: below it the recorded and the adjusted route, the map of each set of
cameras, and the vehicle with its cameras, which moves along the time lines ``image`` and ``drive``.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import ConfigError
from v2hdm.extras import need
from v2hdm.geometry.ipm import extrinsic_from_ipm
from v2hdm.geometry.rigid import inverse
from v2hdm.io.safe.texts import shown
from v2hdm.mapping.results import MethodResult
from v2hdm.records import Camera, Drive, FloatArray, HdMap, ImageDetections
from v2hdm.report.style import METHOD, OKABE_ITO, ROUTE

_log = logging.getLogger(__name__)

VIEWERS = ("none", "rerun")

FILE = "recording.rrd"  # the recording's name in a result folder
_RESULT = "Opt"
_ROUTE, _MARKING, _LANE, _SYMBOL = (
    [int(colour[at : at + 2], 16) for at in (1, 3, 5)]
    for colour in (ROUTE, METHOD[_RESULT], OKABE_ITO["orange"], OKABE_ITO["purple"])
)
_FRUSTUM_M = 1.5
_PNG = b"\x89PNG"


class RerunViewer:
    """Shows a run in Rerun where there is a display, and always records it.

    Raises ConfigError where rerun is not installed.
    """

    def __init__(self, name: str = "v2hdm") -> None:
        self._rr: Any = need("rerun", "viewer", "viewer=rerun", ConfigError)
        self._blueprint: Any = need("rerun.blueprint", "viewer", "viewer=rerun", ConfigError)
        self._name = name
        self._stream: Any = None
        self._drive: Drive | None = None

    def begun(self, folder: Path, drive: Drive) -> None:
        """Begin the recording in ``folder`` with the recorded route and the cameras as described."""
        rr, self._drive = self._rr, drive
        self._stream = rr.RecordingStream("v2hdm", recording_id=None)
        sinks = [rr.FileSink(str(folder / FILE))]
        if has_display():
            rr.spawn(connect=False)
            sinks.append(rr.GrpcSink())
        else:
            _log.info("viewer: no display here; replay the run with: rerun %s, in the result's folder", FILE)
        self._stream.set_sinks(*sinks, default_blueprint=self._layout(drive))
        self._stream.send_recording_name(self._name)
        self._log("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        route = [np.array([image.map_from_vehicle[:3, 3] for image in drive.images])]
        self._log("map/route_recorded", rr.LineStrips3D(route, colors=[_ROUTE]))
        for name, camera in drive.cameras.items():
            self._log_camera(name, camera, extrinsic_from_ipm(camera.info, camera.ipm[camera.initial_ipm]))

    def detected(self, detections: Sequence[ImageDetections]) -> None:
        """Add images and what was found in them."""
        if self._stream is not None and self._drive is not None:
            for found in detections:
                self._show_image(self._drive, found)

    def mapped(self, cameras: str, methods: Mapping[str, MethodResult]) -> None:
        """Add the map of a set of cameras; the vehicle and its cameras move to where it has them."""
        if self._stream is None or self._drive is None:
            return
        best = methods[_RESULT]
        self._show_map(f"map/{cameras}", best.hd_map)
        for name, calibration in best.calibrations.items():
            self._log_camera(name, self._drive.cameras[name], calibration.cam_from_vehicle)
        if best.poses is not None:
            adjusted = [best.poses.of_image(image) for image in self._drive.images]
            for index, pose in enumerate(adjusted):
                self._at(self._drive, index)
                self._stream.log("map/vehicle", self._pose(pose))
            route = [np.array([pose[:3, 3] for pose in adjusted])]
            self._log(f"map/{cameras}/route", self._rr.LineStrips3D(route, colors=[_MARKING]))
        self._stream.flush()

    def close(self) -> None:
        """End the recording; the file is whole then."""
        if self._stream is not None:
            self._stream.flush()
            self._stream.disconnect()
            self._stream = None

    def _log(self, path: str, *what: Any) -> None:
        """Log what holds for the whole run."""
        self._stream.log(path, *what, static=True)

    def _layout(self, drive: Drive) -> Any:
        """The site on the left, the cameras' images on the right."""
        made = self._blueprint
        images = [made.Spatial2DView(origin=f"map/vehicle/{name}/image", name=name) for name in drive.cameras]
        site = made.Spatial3DView(origin="map", name="map")
        return made.Blueprint(made.Horizontal(site, made.Vertical(*images), column_shares=[3, 2]))

    def _log_camera(self, name: str, camera: Camera, cam_from_vehicle: FloatArray) -> None:
        rr, info = self._rr, camera.info
        self._log(f"map/vehicle/{name}", self._pose(inverse(cam_from_vehicle)))
        size, matrix = [info.width, info.height], info.intrinsic
        lens = rr.Pinhole(image_from_camera=matrix, resolution=size, image_plane_distance=_FRUSTUM_M)
        self._log(f"map/vehicle/{name}/image", lens)

    def _show_image(self, drive: Drive, found: ImageDetections) -> None:
        rr, image = self._rr, drive.images[found.image]
        self._at(drive, found.image)
        self._stream.log("map/vehicle", self._pose(image.map_from_vehicle))
        path = f"map/vehicle/{image.camera}/image"
        coded = image.path.read_bytes()
        kind = "image/png" if coded.startswith(_PNG) else "image/jpeg"  # a drive has no others
        self._stream.log(path, rr.EncodedImage(contents=coded, media_type=kind))
        outlines = [one.outline_px if len(one.outline_px) else one.corners_px for one in found.markings]
        kinds = [f"{one.kind} {one.score:.2f}" for one in found.markings]
        drawn = rr.LineStrips2D(_closed(outlines), labels=kinds, colors=[_MARKING] * len(kinds))
        self._stream.log(f"{path}/markings", drawn)
        lines = [one.points_px for one in found.lanes]
        self._stream.log(f"{path}/lanes", rr.LineStrips2D(lines, colors=[_LANE] * len(lines)))

    def _show_map(self, path: str, hd_map: HdMap) -> None:
        kinds = [marking.kind for marking in hd_map.markings]
        for name, lines, colour, labels in (
            ("markings", _closed(one.corners_map for one in hd_map.markings), _MARKING, kinds),
            ("lanes", [one.points_map for one in hd_map.lanes], _LANE, None),
            ("symbols", _closed(one.outline_map for one in hd_map.symbols), _SYMBOL, None),
        ):
            look: dict[str, Any] = {"colors": [colour] * len(lines), "labels": labels, "show_labels": False}
            strips = [np.column_stack([line, np.zeros(len(line))]) for line in lines]
            self._log(f"{path}/{name}", self._rr.LineStrips3D(strips, **look))

    def _at(self, drive: Drive, index: int) -> None:
        self._stream.set_time("image", sequence=index)
        self._stream.set_time("drive", duration=drive.images[index].taken_s - drive.images[0].taken_s)

    def _pose(self, dst_from_src: FloatArray) -> Any:
        return self._rr.Transform3D(translation=dst_from_src[:3, 3], mat3x3=dst_from_src[:3, :3])


def check_viewer(name: str) -> bool:
    """Whether a run is to be watched by :class:`RerunViewer`.

    Raises ConfigError where there is no viewer of this name.
    """
    if name not in VIEWERS:
        raise ConfigError(f"viewer is {shown(name)}: choose {' or '.join(VIEWERS)}")
    return name != "none"


def has_display() -> bool:
    """Whether a window can be opened here."""
    windows = sys.platform.startswith(("win", "darwin"))
    return windows or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _closed(outlines: Iterable[FloatArray]) -> list[FloatArray]:
    return [np.vstack([one, one[:1]]) for one in outlines]
