"""The detector for images without a calibration: all images together show each one's horizon."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from v2hdm.detection.camera import camera_from_calibration, rough_calibration
from v2hdm.detection.detector import Detector
from v2hdm.detection.frames import Frame, image_frames
from v2hdm.detection.horizons import Horizons
from v2hdm.detection.mounting import Mounting, image_lines, output_lines
from v2hdm.detection.network import NetworkOutput
from v2hdm.detection.road import Road, RoadDetector
from v2hdm.detection.stopwatch import lap
from v2hdm.errors import ConfigError, DriveError
from v2hdm.records import Camera, CameraInfo

ROUGH_MOUNTING = (1.6, 5.0, 60.0)  # height (m), pitch, horizontal field of view (deg) where nothing is known
ROUGH_NAME = "camera"  # name of a camera without a calibration file
_UNKNOWN_PITCH_DEG = 8.0  # standard deviation of a pitch that nobody states, deg
_STATED_PITCH_DEG = 4.0  # standard deviation of a pitch that the user states, deg
_ROLL_DEG = 1.5  # standard deviation of a camera's roll about zero, deg
_LOG_FOCAL = 0.3  # standard deviation of an assumed focal length's log: lenses of 46 to 76 deg

_LOOKS = 6  # images of a folder that are looked at before the first, so that it has a prior from others
_SURE = 0.9  # least probability that the searched rows contain the horizon; else search again
_LOOK_SHARE = 0.25  # time of a look in half the resolution, of one in full
_KNOWN_RAD = np.deg2rad(0.5)  # a stream's horizon is said when its standard deviation is this


class _Looked(NamedTuple):
    """An image's mounting and network output, before its markings are looked for."""

    mounting: Mounting
    output: NetworkOutput | None  # of the network, if it was run on all rows of the road


@dataclass
class RoughCamera:
    """The detector for the images of cameras without a calibration, whose horizons they show."""

    detector: Detector
    lens: CameraInfo | None
    file: Path | None
    mounting: Sequence[float] | None
    linear: bool
    folder: Sequence[Path] = ()
    _horizons: dict[tuple[int, int], Horizons] = field(default_factory=dict)  # by width and height
    _is_said: bool = False

    def detect(self, frame: Frame) -> Road:
        """Find what the next image shows; it says what the mounting is taken to be.

        Of a ``folder``, some images all over it are looked at before the first.
        """
        if self.lens is not None:
            check_size(frame, self.lens, f"{self.file}")
        rows, columns = frame.pixels.shape[:2]
        horizons = self._horizons.get((columns, rows))
        if horizons is None:
            horizons = Horizons(*self._prior(columns, rows))
            self._horizons[columns, rows] = horizons
            if self.folder and len(self._horizons) == 1:
                self._look_ahead(horizons, frame)
        looked = self._look(horizons, frame)
        self._say(frame, horizons)
        with lap("horizon"):
            road = RoadDetector(self.detector, self._camera(horizons.info, looked.mounting))
            top = self.detector.road_camera(road.camera).far_row
        output = looked.output
        is_whole = output is not None and output.top <= top
        return road.detect(frame.pixels, output.from_row(top) if output is not None and is_whole else None)

    def _look(self, horizons: Horizons, frame: Frame) -> _Looked:
        """The next image's horizon, by the way that takes the network less time.

        Either it looks in half the resolution first, or at once on all rows that may be of the road.
        """
        info = horizons.info
        with lap("horizon"):
            mounting = horizons.earlier(frame.source)
            if mounting is not None:
                return _Looked(mounting, None)
            expected, highest_rad = horizons.coming(_SURE)
            more_px = info.intrinsic[1, 1] * (np.tan(highest_rad) - np.tan(expected.pitch_rad))
            if not more_px < _LOOK_SHARE * info.height:  # nan is not
                lines = image_lines(self.detector.network, frame.pixels, info)
                return _Looked(horizons.next(lines), None)
            camera = self._camera(info, expected)
            road_camera = self.detector.road_camera(camera)
        multiple = self.detector.network.info.multiple
        above = min(max(int(np.ceil(more_px / multiple)), 0), road_camera.far_row // multiple)
        top = road_camera.far_row - above * multiple
        output = self.detector.run_network(frame.pixels, camera, top)
        with lap("horizon"):
            return _Looked(horizons.next(output_lines(output, info)), output)

    def _look_ahead(self, horizons: Horizons, first: Frame) -> None:
        """Look at some images all over the folder; one that cannot be read is refused when its turn comes."""
        network = self.detector.network
        with lap("horizon"):
            for frame in (first, *self._ahead()):
                if frame.pixels.shape == first.pixels.shape:
                    horizons.add(image_lines(network, frame.pixels, horizons.info), frame.source)

    def _ahead(self) -> Iterator[Frame]:
        places = np.linspace(0, len(self.folder) - 1, min(_LOOKS, len(self.folder))).round().astype(int)
        for place in places[1:].tolist():
            with suppress(DriveError):
                yield from image_frames([self.folder[place]])

    def _camera(self, info: CameraInfo, mounting: Mounting) -> Camera:
        angles_deg = np.rad2deg([mounting.pitch_rad, mounting.fov_rad, mounting.roll_rad]).tolist()
        rough = rough_calibration(info.name, info.width, info.height, mounting.height_m, *angles_deg)
        sigma = mounting.sigma_rad[0], mounting.log_focal_sigma
        return camera_from_calibration(replace(rough, info=info), self.linear, sigma)

    def _prior(self, columns: int, rows: int) -> tuple[CameraInfo, Mounting]:
        """The camera's lens, and what its mounting is taken to be before its first image."""
        height_m, pitch_deg, fov_deg = self.mounting or ROUGH_MOUNTING
        if not (0 < height_m < np.inf and -45 < pitch_deg < 85 and 10 <= fov_deg <= 150):
            raise ConfigError(
                f"--mounting {height_m:g} {pitch_deg:g} {fov_deg:g}: give a height above 0 m, a pitch "
                "of -45 to 85 deg (down is positive) and a field of view of 10 to 150 deg"
            )
        lens = self.lens
        if lens is not None:
            fov_deg = float(2 * np.degrees(np.arctan(lens.width / 2 / lens.intrinsic[0, 0])))
        sigma_deg = _UNKNOWN_PITCH_DEG if self.mounting is None else _STATED_PITCH_DEG
        if self.mounting is None and not self._horizons:
            knowledge = "no --camera" if lens is None else f"no mounting in {self.file}"
            print(
                f"{knowledge}: taking it to be {height_m:g} m up, {pitch_deg:g} deg down, "
                f"{fov_deg:.3g} deg wide, unless the images show another horizon (set --mounting); "
                "positions in px only",
                file=sys.stderr,
            )
        pitch_rad, fov_rad, sigma_rad, roll_rad = np.deg2rad([pitch_deg, fov_deg, sigma_deg, _ROLL_DEG])
        log_focal = _LOG_FOCAL if self.mounting is None and lens is None else 0.0
        prior = Mounting(height_m, pitch_rad, 0.0, fov_rad, (sigma_rad, roll_rad), log_focal)
        rough = rough_calibration(ROUGH_NAME, columns, rows, height_m, pitch_deg, fov_deg)
        return lens or rough.info, prior

    def _say(self, frame: Frame, horizons: Horizons) -> None:
        """Say once where the horizon is: of a folder at once, of a stream when that is known."""
        mounting = horizons.mounting
        if self._is_said or (mounting.sigma_rad[0] > _KNOWN_RAD and not self.folder):
            return
        self._is_said = True
        angles = np.rad2deg(
            [mounting.pitch_rad, mounting.sigma_rad[0], mounting.roll_rad, mounting.sigma_rad[1]]
        )
        pitch, pitch_sigma, roll, roll_sigma = angles.tolist()
        where = "the folder's images" if self.folder else f"{frame.name} and earlier images"
        others = round(horizons.images * (1 - horizons.of_mounting))
        exceptions = f"; {others} of the {horizons.images} looked at have other mountings" if others else ""
        print(
            f"from the lines of {where} the camera looks {pitch:.1f} +- {pitch_sigma:.1f} deg down, roll "
            f"{roll:.1f} +- {roll_sigma:.1f} deg{exceptions}",
            file=sys.stderr,
        )


def check_size(frame: Frame, info: CameraInfo, where: str) -> None:
    """Raise DriveError for an image that has not the size that is known of its camera."""
    height, width = frame.pixels.shape[:2]
    if (width, height) != (info.width, info.height):
        raise DriveError(
            f"{frame.source}: the image is {width}x{height}, but {where} of camera '{info.name}' is for "
            f"{info.width}x{info.height}; give images of that size, or a calibration for these"
        )
