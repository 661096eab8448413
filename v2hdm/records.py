"""The records that the stages exchange: plain frozen dataclasses over numpy arrays.

Frames, names and index letters are those of :mod:`v2hdm.geometry`. ``_px`` are pixels of the recorded image,
``_pinhole_px`` those of the same points without lens distortion, under the same intrinsic matrix.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import Enum
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from v2hdm.doors import checked_class

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
JointCovariance = Callable[[IntArray, IntArray], FloatArray]
"""Joint covariance (2N, 2N), m^2, of the corners (N,) of markings (N,) of a map, stacked x0, y0, x1, ..."""

DIAMOND = "diamond"
LANE_DASH = "lane_dash"
LANE_LINE = "lane_line"
ARROW = "arrow"
STOP_LINE = "stop_line"
CROSSWALK_BAR = "crosswalk_bar"
CHEVRON = "chevron"
OTHER_PAINT = "other_paint"
TEXT = "text"
BOX = "box"
BICYCLE = "bicycle"

SEEN_ACROSS: Mapping[str, str] = {LANE_DASH: STOP_LINE, STOP_LINE: LANE_DASH}
"""Stripes that look like each other to a camera to the side: there a dash lies across the view."""

# Composed of other paint, without a class of the network:
CROSSWALK = "crosswalk"
DOUBLE_LINE = "double_line"

GIVE_WAY = "give_way"
"""The variety of a stop line that is a row of pieces: of short, broad dashes or of triangles."""

LANE_BOUNDARY = "lane_boundary"
"""Kind of a lane detection that is a whole line, gaps between dashes and hidden parts included."""

BEST = "Opt"
"""Name of the method whose map and calibration are the result, also in ``metrics.json``."""

DISTORTION_COEFFICIENTS: Mapping[str, int] = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}
"""Distortion models by their ROS ``camera_info`` name, with their number of coefficients."""


@dataclass(frozen=True)
class CameraInfo:
    """Intrinsics of one camera, as in a ROS ``camera_info``."""

    name: str
    width: int
    height: int
    intrinsic: FloatArray  # K (3 x 3), px
    distortion_model: str = "plumb_bob"
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)  # by :data:`DISTORTION_COEFFICIENTS`


@dataclass(frozen=True)
class CentrePrior:
    """Surveyed camera centre in the vehicle frame: ``centre_vehicle`` (3,) m, ``sigma_m`` (3,)."""

    centre_vehicle: FloatArray
    sigma_m: FloatArray


@dataclass(frozen=True)
class FrameStep:
    """An edge of a tree of frames; ``parent_from_child`` (4, 4) is None where the tree lacks it."""

    parent: str
    child: str
    parent_from_child: FloatArray | None


@dataclass(frozen=True)
class CameraFrames:
    """A camera's place in the tree of frames of its vehicle, by the tree's own names; empty if not stated."""

    vehicle: str = ""  # the frame that the drive's positions on the vehicle count from
    camera: str = ""  # the frame of the images
    height_m: float = 0.0  # of ``vehicle`` above the ground
    steps: tuple[FrameStep, ...] = ()  # from ``vehicle`` to ``camera``; none where the vehicle has no tree
    problem: str = ""  # why there are no steps
    states_height: bool = False  # of the camera above ``vehicle``, which a homography of the ground does not
    rectified_from_camera: FloatArray | None = None  # (3, 3), turn of images that were rectified, else None


@dataclass(frozen=True)
class Camera:
    """One camera of a drive: its intrinsics and approximate mounting."""

    info: CameraInfo
    # ``vehicle_from_pinhole_px`` (3 x 3): ``calibrated``, this vehicle's own, ``estimated``, borrowed
    ipm: Mapping[str, FloatArray]
    initial_ipm: str  # the IPM that mapping starts from
    roi_vehicle: FloatArray  # (N, 2) m, convex polygon of ground in which the IPM is trusted
    centre_prior: CentrePrior | None = None
    linear_response: bool = False  # grey proportional to radiance, else sRGB
    own_vehicle: BoolArray | None = None  # (height, width) pixels that show the vehicle
    mounting_sigma: tuple[float, float] = (0.0, 0.0)  # of a guessed horizon (rad) and log focal length
    read_out_s: float = 0.0  # first row to last, 0 for a global shutter; stamps are of the middle row
    frames: CameraFrames = CameraFrames()


@dataclass(frozen=True)
class GeodeticOrigin:
    """The map frame's origin on the earth: degrees, metres above the ellipsoid."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    datum: str = "WGS84"
    epoch: float | None = None


SIGMA_OF_MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""

SIGMAS_95 = 2.4477
"""Semi-axes of the 95 % ellipse of a two-dimensional normal error, in standard deviations: the root of the
chi-square quantile with two degrees of freedom."""

TWO_SIDED_95 = 1.96
"""Half the width of the band that holds 95 % of a normal error in one dimension, in standard deviations."""

FOOT_M = 0.3048  # an international foot, m

HEIGHT_NOISE = 2.0  # noise of heights by RTK over that of positions in the plane, about

HEAVE_SIGMA_M = 0.01
"""Standard deviation, m, of a vehicle body's height on its suspension, on paved ground."""


@dataclass(frozen=True)
class PoseNoise:
    """Standard deviations of the recorded poses, as in the receiver's data sheet.

    ``..._drift_...`` is the slow part of each, as in RTK: a first-order Gauss-Markov process with the
    correlation length ``..._drift_over_m``. The rest, in quadrature, is white noise. ``clock_s`` is of the
    time by which the images of all cameras are late on the poses' clock, ``clock_drift_s`` of the change of
    that time from the first image of a drive to its last.
    """

    position_m: float = 0.02
    heading_rad: float = 0.001
    roll_pitch_rad: float = 0.003
    position_drift_m: float = 0.0
    position_drift_over_m: float = 30.0
    heading_drift_rad: float = 0.0
    heading_drift_over_m: float = 5.0
    roll_pitch_drift_rad: float = 0.0
    roll_pitch_drift_over_m: float = 5.0
    clock_s: float = 0.0
    clock_drift_s: float = 0.0

    @classmethod
    def from_stated(cls, **stated: float) -> PoseNoise:
        """The noise of a drive that states only some of it; the rest takes the mean square over drives.

        An unstated drift takes half the variance: without one, errors that repeat from image to image would
        be averaged out, and the map state too small an uncertainty. Unstated clocks are those that nothing
        synchronises; a clock that is stated drifts by no more than it is off.
        """
        noise = cls(**stated)
        unstated = {total: _UNSTATED * getattr(noise, total) for total in DRIFTS if total not in stated}
        noise = replace(noise, **unstated)
        drifts = {
            drift: math.sqrt(_USUAL_DRIFT_SHARE) * getattr(noise, total)
            for total, drift in DRIFTS.items()
            if drift not in stated
        }
        clocks = {
            "clock_s": _UNSTATED_CLOCK_S,
            "clock_drift_s": stated.get("clock_s", _UNSTATED_CLOCK_DRIFT_S),
        }
        return replace(noise, **drifts, **{key: clocks[key] for key in clocks if key not in stated})


def largest_noise(noises: Sequence[PoseNoise]) -> PoseNoise:
    """The largest of each standard deviation, and of each distance over which a drift fades."""
    names = [field.name for field in fields(PoseNoise)]
    return PoseNoise(**{name: max(getattr(noise, name) for noise in noises) for name in names})


DRIFTS: Mapping[str, str] = {
    "position_m": "position_drift_m",
    "heading_rad": "heading_drift_rad",
    "roll_pitch_rad": "roll_pitch_drift_rad",
}
"""The drift that belongs to each standard deviation of :class:`PoseNoise`."""

_UNSTATED = math.sqrt((3.0**2 - 3.0**-2) / (2 * math.log(3.0**2)))
"""Root mean square, relative to the usual value, of a sigma whose logarithm is uniform from a third of it to
three times: the range of receivers and vehicles."""

_USUAL_DRIFT_SHARE = 0.5
"""Fraction of an unstated variance that drifts: half of RTK's errors are multipath and atmosphere, which last
for tens of metres."""


_UNSTATED_CLOCK_S = 0.03
"""Standard deviation, s, of the time by which images are late where nothing synchronises cameras with the
receiver: exposure, read-out and transfer take 20 to 60 ms, and computers stamp images when these arrive."""

_UNSTATED_CLOCK_DRIFT_S = 0.05
"""Standard deviation, s, of its change over a drive where nothing synchronises them: that of stamps counted
at the nominal rate of a camera, which is off by a few thousandths, over ten to twenty seconds."""


@dataclass(frozen=True)
class Trajectory:
    """Vehicle poses over time: ``stamp_s`` (P,), strictly rising, and ``map_from_vehicle`` (P, 4, 4)."""

    stamp_s: FloatArray
    map_from_vehicle: FloatArray


@dataclass(frozen=True)
class Reception:
    """What the source of a drive's poses says of the positions that it recorded while images were taken."""

    positions: int
    rtk_fixed: int | None  # of these, with fixed ambiguities; None where the source states no quality
    geoid_m: float | None = None  # stated height of the geoid above the ellipsoid, added to all heights


@dataclass(frozen=True)
class Road:
    """The recorded ground along the route; the drive's poses are reduced to the plane z = 0."""

    points_map: FloatArray  # (P, 2) m in driving order
    height_m: FloatArray  # (P,)
    slope: FloatArray  # (P, 2) by x and y


DETECTIONS_SUFFIX = ".json"
"""Suffix of a file of detections, which stands for an image whose picture was not kept."""


@dataclass(frozen=True)
class Image:
    """One image of a drive."""

    camera: str
    stamp_s: float
    path: Path
    map_from_vehicle: FloatArray  # (4, 4) when it was taken
    clock_offset_s: float = 0.0  # exposure minus stamp, as far as known
    session: int = 0  # an index into ``Drive.sessions``

    @property
    def taken_s(self) -> float:
        """When the image was taken, on the clock of the poses."""
        return self.stamp_s + self.clock_offset_s


@dataclass(frozen=True)
class Session:
    """A session of a :class:`Drive`, itself a drive before joining; ``cameras`` are by its own names."""

    name: str
    root: Path
    pose_noise: PoseNoise
    truth_dir: Path | None = None
    trajectory: Trajectory | None = None
    recorded: Trajectory | None = None
    cameras: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Drive:
    """Everything the mapper may know of a drive."""

    name: str
    root: Path
    cameras: Mapping[str, Camera]
    images: Sequence[Image]  # sorted by session, time, then camera
    pose_noise: PoseNoise = field(default_factory=PoseNoise)
    origin: GeodeticOrigin | None = None
    truth_dir: Path | None = None  # for the report alone
    trajectory: Trajectory | None = None  # at the receiver's rate, the road laid flat
    recorded: Trajectory | None = None  # the same as recorded
    road: Road | None = None  # as recorded, None for the plane z = 0
    unposed: Mapping[str, int] = field(default_factory=dict)  # images left out, without a pose
    # First and last time, s, of all images of a camera, left out or not.
    listed_s: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    reception: Reception | None = None  # None where the poses come from no receiver's log
    headed_by_course: bool = False  # whether its headings are its antenna's course, smoothed
    joined: tuple[Session, ...] = ()  # its sessions, if several: then it has no trajectory

    @property
    def has_pictures(self) -> bool:
        """Whether its images are pictures; else they are files of what was detected in them."""
        return not any(image.path.suffix == DETECTIONS_SUFFIX for image in self.images)

    def name_of(self, path: Path) -> str:
        """Name an image as files of results do: its path below the drive's folder, else its whole path."""
        path = path.absolute()
        root = self.root.absolute()
        return path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)

    @property
    def spans_s(self) -> tuple[tuple[float, float], ...]:
        """The first and the last stamp of the images of each session, s."""
        stamps_of: dict[int, list[float]] = {}
        for image in self.images:
            stamps_of.setdefault(image.session, []).append(image.stamp_s)
        return tuple((min(stamps), max(stamps)) for _, stamps in sorted(stamps_of.items()))

    @property
    def route_map(self) -> FloatArray:
        """The vehicle's positions (I, 2), m, at the images."""
        return np.array([image.map_from_vehicle[:2, 3] for image in self.images])

    @property
    def sessions(self) -> tuple[Session, ...]:
        """Its sessions: the drives that it was joined of, or itself alone."""
        if self.joined:
            return self.joined
        alone = Session(
            name=self.name,
            root=self.root,
            pose_noise=self.pose_noise,
            truth_dir=self.truth_dir,
            trajectory=self.trajectory,
            recorded=self.recorded,
            cameras={name: name for name in self.cameras},
        )
        return (alone,)

    @property
    def noises(self) -> tuple[PoseNoise, ...]:
        """The noise of each session's recorded poses."""
        return tuple(session.pose_noise for session in self.sessions)


OUTLINE_SIGMA_PX = 2.5
"""Standard deviation, px, of the network's outline of a marking from its paint's edge; 1 to 3 on renders."""


@dataclass(frozen=True)
class MarkingDetection:
    """One quadrilateral marking, or symbol, in one image.

    ``corners_px`` (4, 2) run counter-clockwise as seen from above, and so on the screen, from any first one.
    ``covariance_px`` (8, 8), px^2, of the stacked corners (u0, v0, u1, ...) is large in a direction that the
    image hides, as along a dash whose end lies beyond the border; ``corner_valid`` (4,) flags corners known
    well in every direction. Symbols such as arrows have corners of nan and a polygon ``outline_px`` (N, 2),
    empty otherwise; ``outline_seen`` (N,) flags its sides, each to the next point, along an edge of paint.
    """

    kind: str
    score: float
    corners_px: FloatArray
    covariance_px: FloatArray
    corner_valid: BoolArray
    outline_px: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    outline_seen: BoolArray = field(default_factory=lambda: np.empty(0, dtype=np.bool_))


@dataclass(frozen=True)
class LaneDetection:
    """A centre line in one image."""

    kind: str  # of one piece of lane paint, or :data:`LANE_BOUNDARY` for a whole line
    score: float
    points_px: FloatArray  # (N, 2), near to far
    identity: int | None = None  # of whole lines: 1, 2, ... to the left, -1, -2, ... to the right
    sigma_px: FloatArray | None = None  # (N,) along the image row


@dataclass(frozen=True)
class ImageDetections:
    """The detections in image ``i`` of a drive (an index into ``Drive.images``)."""

    image: int
    markings: tuple[MarkingDetection, ...]
    lanes: tuple[LaneDetection, ...]


@dataclass(frozen=True)
class PaintLeft:
    """The ``share`` of a marking's paint that is left, 0 to 1; its change since an earlier map, if any."""

    share: float
    sigma: float
    change: float | None = None
    change_sigma: float | None = None

    def since(self, before: PaintLeft | None) -> PaintLeft:
        """The same, with the change since an earlier measurement."""
        if before is None:
            return self
        sigma = float(np.hypot(self.sigma, before.sigma))
        return replace(self, change=self.share - before.share, change_sigma=sigma)


ACCURACIES = ("A", "B", "C")
"""Accuracy of a marking or symbol, the best first: the 95 % radius of its worst corner is within the accuracy
goal, within twice the goal, or larger."""

UNSTATED_DRIFT_OVER_M = 30.0
"""Correlation length, m, of the error that a map's neighbouring markings share, in a map that states none."""

UNSTATED_SIGMA_M = 0.02
"""Standard deviation, m, of a corner's coordinate in a map that states none: drawn over an image."""


class Reading(NamedTuple):
    """A word's ``text`` and, where it may be another, its ``alternative``, with their probabilities."""

    text: str
    confidence: float
    alternative: str | None = None
    alternative_confidence: float | None = None


@dataclass(frozen=True)
class Marking:
    """One mapped marking."""

    kind: str
    corners_map: FloatArray  # (4, 2) m, counter-clockwise from above
    sightings: int
    covariance_m2: FloatArray | None = None  # (8, 8) of the stacked corners, if known
    # of a coordinate of its centre, given those of its neighbours: what they share cancels
    relative_sigma_m: float | None = None
    heights_m: FloatArray | None = None  # (4,) of the ground, None for z = 0
    id: int | None = None  # positive and unique; None until the map is written
    paint: PaintLeft | None = None  # None if no image shows enough of it
    heights_sigma_m: FloatArray | None = None  # (4,) where estimated
    accuracy: str | None = None  # of :data:`ACCURACIES`; None without covariance, or before a goal was set
    variety: str | None = None  # within its class, as :data:`GIVE_WAY`

    @property
    def corner_covariances_m2(self) -> FloatArray | None:
        """Covariance (4, 2, 2) of each corner alone, if known."""
        whole = self.covariance_m2
        return None if whole is None else whole.reshape(4, 2, 4, 2)[range(4), :, range(4), :]


@dataclass(frozen=True)
class Symbol:
    """One mapped symbol or area, as a :class:`Marking`; ``covariance_m2`` (2N, 2N), if known, is of vertices.

    Areas are rectangles. The outline of a crosswalk is four corners, the first two along ends of its bars.
    """

    kind: str
    outline_map: FloatArray  # (N, 2) m, counter-clockwise from above, in one order for all of a template
    sightings: int
    sigma_m: float | None = None  # of a coordinate
    heights_m: FloatArray | None = None
    id: int | None = None
    heights_sigma_m: FloatArray | None = None
    # (2N, 2N), None where sightings share an outline that no polygon explains
    covariance_m2: FloatArray | None = None
    accuracy: str | None = None
    # of a text, None where it is not read; then the outline begins at the lower left, as it is read
    reading: Reading | None = None
    parts: tuple[int, ...] = ()  # ids of the markings that it is composed of


@dataclass(frozen=True)
class Lane:
    """One mapped lane line: a polyline along its centre; heights and id as of a :class:`Marking`.

    A :data:`DOUBLE_LINE` runs midway between its two ``lines``, the classes of the left and the right one,
    whose centres are ``apart_m`` apart.
    """

    kind: str
    points_map: FloatArray  # (N, 2) m
    sightings: int
    heights_m: FloatArray | None = None
    id: int | None = None
    sigma_m: FloatArray | None = None  # (N,) of each vertex across, None unless adjusted
    heights_sigma_m: FloatArray | None = None
    lines: tuple[str, str] | None = None
    apart_m: float | None = None

    @property
    def painted(self) -> tuple[Lane, ...]:
        """The lines as they are painted: of a double one the left one, with its id, and the right one."""
        if self.lines is None or self.apart_m is None or len(self.points_map) < 2:
            return (self,)
        x, y = np.gradient(self.points_map, axis=0).T
        left = self.apart_m / 2 * np.column_stack([-y, x]) / np.maximum(np.hypot(x, y), 1e-9)[:, None]
        single = replace(self, lines=None, apart_m=None)
        return (
            replace(single, kind=self.lines[0], points_map=self.points_map + left),
            replace(single, kind=self.lines[1], points_map=self.points_map - left, id=None),
        )


@dataclass(frozen=True)
class GroundStrip:
    """The estimated ground along a path, a grid of heights."""

    points_map: FloatArray  # (N, 2) m of the path, ``step_m`` apart
    ahead: FloatArray  # (N, 2) unit vectors along it
    step_m: float
    left_m: FloatArray  # (M,) to its left, evenly rising
    heights_m: FloatArray  # (N, M) of the ground
    sigma_m: FloatArray  # (N, M) their standard deviations

    def points(self, left_m: float) -> FloatArray:
        """Points (N, 2) so far to the left of the path."""
        return self.points_map + left_m * np.column_stack([-self.ahead[:, 1], self.ahead[:, 0]])


@checked_class
@dataclass(frozen=True)
class HDMap:
    """Markings, lanes and symbols of a site in its map frame.

    ``drift_over_m`` is the correlation length of the error that neighbouring markings share, None if unknown;
    ``largest_id`` the largest id ever given, 0 if a present feature has it; ``ground`` the estimated surface
    by session.

    >>> marking = result.map.markings[0]
    >>> marking.corners_map.shape, marking.covariance_m2.shape
    ((4, 2), (8, 8))
    """

    markings: tuple[Marking, ...]
    lanes: tuple[Lane, ...] = ()
    origin: GeodeticOrigin | None = None
    symbols: tuple[Symbol, ...] = ()
    drift_over_m: float | None = None
    largest_id: int = 0
    ground: tuple[GroundStrip, ...] = ()

    @property
    def accuracies(self) -> list[str]:
        """The accuracy of each marking and symbol that states one."""
        graded: list[Marking | Symbol] = [*self.markings, *self.symbols]
        return [paint.accuracy for paint in graded if paint.accuracy is not None]

    def to_geodataframe(self) -> Any:
        """The features as a ``geopandas.GeoDataFrame``, one row each.

        Columns are id, layer, kind, sightings, accuracy (None for a lane) and geometry: longitude, latitude
        and ellipsoidal height, m (EPSG:4326), where the map has an origin, and metres of the frame ``map``
        otherwise.

        Raises:
            ModuleNotFoundError: geopandas is not installed; the message names the extra.

        >>> frame = result.map.to_geodataframe()
        >>> len(frame) == len(result.map.markings) + len(result.map.lanes) + len(result.map.symbols)
        True
        """
        from v2hdm.dataframe import geodataframe  # only those who ask for one load it

        return geodataframe(self)


@dataclass(frozen=True)
class Exclusion:
    """A candidate that the map of the set ``cameras`` left out: what, where (2,) in the map, and why."""

    kind: str
    position_map: FloatArray
    sightings: int
    reason: str
    cameras: str = ""


class Fate(Enum):
    """The fate of a marking between an earlier map and a new drive."""

    MOVED = "moved"
    VANISHED = "vanished"
    NEW = "new"
    FIRST_SEEN = "first seen"
    """In the map now and not before, but the earlier drive may have missed it."""
    NOT_SEEN = "not seen"
    """Still in the map: no image shows its place, or too few to miss it."""


@dataclass(frozen=True)
class Change:
    """One marking that differs from the earlier map, with the evidence."""

    id: int
    kind: str
    fate: Fate
    before: FloatArray | None  # (4, 2) corners, if any
    after: FloatArray | None  # (4, 2) corners, if any
    shift_m: FloatArray | None  # (2,) of its centre, beyond the local shift between the maps
    shift_sigma_m: FloatArray | None
    probability: float  # of its fate
    views: int  # images with its place in near view (of a new one, the earlier drive's)
    found: int  # of these, that showed it
    sightings: int  # of the map that has it


@dataclass(frozen=True)
class Changes:
    """An earlier map against a new drive: the ``changes``, how many are the ``same``, its mean shift (2,)."""

    changes: tuple[Change, ...]
    same: int
    shift_m: FloatArray

    def of(self, fate: Fate) -> tuple[Change, ...]:
        """The changes of one fate."""
        return tuple(change for change in self.changes if change.fate is fate)


@dataclass(frozen=True)
class Truth:
    """Ground truth of a rendered drive. Only the report reads it; the mapper never does."""

    map: HDMap
    cam_from_vehicle: Mapping[str, FloatArray]
    map_from_vehicle: FloatArray  # (I, 4, 4) one per ``Drive.images``
    visibility: FloatArray  # (I, J) fraction of marking j that image i shows, unoccluded
    lane_visible: tuple[BoolArray, ...]  # per lane, the vertices seen by some camera
    disturbances: Mapping[str, float]
    symbol_visibility: FloatArray | None = None  # (I, S) of symbol s, as of markings
    texts: Mapping[int, str] = field(default_factory=dict)  # what symbols say, by their number


@checked_class
@dataclass(frozen=True)
class Calibration:
    """The calibration of one camera, with its extrinsic ``cam_from_vehicle`` (4, 4).

    ``covariance`` (6, 6) is that of its left-perturbation tangent, translation (m) then rotation (rad); None
    if unknown.

    >>> calibration = result.calibrations["front"]
    >>> sigma = np.sqrt(np.diag(calibration.covariance))
    >>> bool(sigma[:3].max() < 0.1 and np.rad2deg(sigma[3:].max()) < 0.5)
    True
    """

    info: CameraInfo
    cam_from_vehicle: FloatArray
    covariance: FloatArray | None = None
    frames: CameraFrames = CameraFrames()

    @property
    def centre_vehicle(self) -> FloatArray:
        """The camera's centre (3,) in the frame ``vehicle``: forward, left, up, m."""
        return np.asarray(-self.cam_from_vehicle[:3, :3].T @ self.cam_from_vehicle[:3, 3])
