"""The records that travel between the parts: plain frozen dataclasses over numpy arrays.

Frames, names and index letters are those of :mod:`v2hdm.geometry`. Image points come in two flavours: ``_px``
are pixels of the image as recorded, ``_pinhole_px`` the same points with the lens distortion removed, on the
pinhole image of the same intrinsic matrix.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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

SEEN_ACROSS: Mapping[str, str] = {LANE_DASH: STOP_LINE, STOP_LINE: LANE_DASH}
"""Stripes that a camera on the vehicle's side sees as one that looks ahead sees the other: a dash lies across
its view."""

LANE_BOUNDARY = "lane_boundary"
"""Kind of a lane detection that is a whole line, gaps between dashes and hidden parts included."""

DISTORTION_COEFFICIENTS: Mapping[str, int] = {
    "plumb_bob": 5,
    "rational_polynomial": 8,
    "equidistant": 4,
}
"""Distortion models by their ROS ``camera_info`` name, with their number of coefficients."""


@dataclass(frozen=True)
class CameraInfo:
    """Intrinsics of one camera, as in a ROS ``camera_info``.

    ``intrinsic`` is K (3 x 3, px); ``distortion`` holds the coefficients of ``distortion_model``
    in OpenCV's order (see :data:`DISTORTION_COEFFICIENTS`).
    """

    name: str
    width: int
    height: int
    intrinsic: FloatArray
    distortion_model: str = "plumb_bob"
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class CentrePrior:
    """Surveyed camera centre in the vehicle frame: ``centre_vehicle`` (3,) m, ``sigma_m`` (3,)."""

    centre_vehicle: FloatArray
    sigma_m: FloatArray


@dataclass(frozen=True)
class Camera:
    """One camera of a drive: its intrinsics and what is roughly known of its mounting.

    ``ipm`` maps a name (``calibrated``: from a manual calibration of this vehicle; ``estimated``: borrowed
    from another one) to a coarse IPM homography ``vehicle_from_pinhole_px`` (3 x 3); the mapping starts from
    ``initial_ipm``. ``roi_vehicle`` (N x 2, m) is the convex polygon on the ground within which the IPM is
    trusted. ``linear_response``: grey values are proportional to radiance; otherwise sRGB coding is assumed.
    ``own_vehicle`` (height, width) says which pixels show the vehicle itself, None if unknown.
    ``mounting_sigma`` are the standard deviations of its horizon, rad, and of the logarithm of its focal
    length where these are guessed from its images. ``read_out_s`` is the time from the first row of an image
    to the last, 0 for a global shutter; an image's stamp is that of its middle row.
    """

    info: CameraInfo
    ipm: Mapping[str, FloatArray]
    initial_ipm: str
    roi_vehicle: FloatArray
    centre_prior: CentrePrior | None = None
    linear_response: bool = False
    own_vehicle: BoolArray | None = None
    mounting_sigma: tuple[float, float] = (0.0, 0.0)
    read_out_s: float = 0.0


@dataclass(frozen=True)
class GeodeticOrigin:
    """Where the map frame's origin lies on the earth: degrees, metres above the ellipsoid."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    datum: str = "WGS84"
    epoch: float | None = None


@dataclass(frozen=True)
class PoseNoise:
    """Standard deviations of the recorded poses, as the receiver's data sheet states them.

    Of each, ``..._drift_...`` is the part that changes only slowly, as RTK's errors do: a first-order
    Gauss-Markov process that fades to 1 / e over ``..._drift_over_m`` of driving. The rest, in quadrature, is
    drawn anew at every image.
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

    @classmethod
    def as_far_as_stated(cls, **stated: float) -> PoseNoise:
        """The noise of a drive whose description may leave out some of it.

        What is not stated is not known to be the usual, and enters by its mean square. A drift that is not
        stated takes half of its variance: an error that repeats from image to image does not average out, and
        a map that reckons with none is less certain than it says.
        """
        noise = cls(**stated)
        unstated = {total: _UNSTATED * getattr(noise, total) for total in DRIFTS if total not in stated}
        noise = replace(noise, **unstated)
        drifts = {
            drift: math.sqrt(_USUAL_DRIFT_SHARE) * getattr(noise, total)
            for total, drift in DRIFTS.items()
            if drift not in stated
        }
        return replace(noise, **drifts)


def largest_noise(noises: Sequence[PoseNoise]) -> PoseNoise:
    """The largest of each standard deviation, and of each distance over which a drift fades."""
    names = [one.name for one in fields(PoseNoise)]
    return PoseNoise(**{name: max(getattr(noise, name) for noise in noises) for name in names})


DRIFTS: Mapping[str, str] = {
    "position_m": "position_drift_m",
    "heading_rad": "heading_drift_rad",
    "roll_pitch_rad": "roll_pitch_drift_rad",
}
"""The drift that belongs to each standard deviation of :class:`PoseNoise`."""

_UNSTATED = math.sqrt((3.0**2 - 3.0**-2) / (2 * math.log(3.0**2)))
"""Root of the mean square of a sigma, over the usual one, whose logarithm is even from a third to three times
it: among receivers and vehicles it lies anywhere there."""

_USUAL_DRIFT_SHARE = 0.5
"""Share of a variance that drifts where nobody says otherwise: RTK's errors are about half multipath and
atmosphere, which last for tens of metres."""


@dataclass(frozen=True)
class Trajectory:
    """Vehicle poses over time: ``stamp_s`` (P,), strictly rising, and ``map_from_vehicle`` (P, 4, 4)."""

    stamp_s: FloatArray
    map_from_vehicle: FloatArray


@dataclass(frozen=True)
class Road:
    """The recorded ground along the route, which the drive's poses have laid flat into z = 0.

    ``points_map`` (P, 2) m along the route in driving order, the ground's ``height_m`` (P,) and ``slope`` (P,
    2) by x and y there.
    """

    points_map: FloatArray
    height_m: FloatArray
    slope: FloatArray


@dataclass(frozen=True)
class Image:
    """One image of a drive and the vehicle's pose (4 x 4) when it was taken.

    ``stamp_s`` is its recorded time, ``clock_offset_s`` how much later it was taken as far as known,
    ``visit`` an index into ``Drive.visits``.
    """

    camera: str
    stamp_s: float
    path: Path
    map_from_vehicle: FloatArray
    clock_offset_s: float = 0.0
    visit: int = 0

    @property
    def taken_s(self) -> float:
        """When the image was taken, on the clock of the poses."""
        return self.stamp_s + self.clock_offset_s


@dataclass(frozen=True)
class Visit:
    """One of the drives that a :class:`Drive` was joined of: what is its own, as :class:`Drive` has it.

    ``cameras`` says what the joined drive calls each of its own cameras.
    """

    name: str
    root: Path
    pose_noise: PoseNoise
    truth_dir: Path | None = None
    trajectory: Trajectory | None = None
    recorded: Trajectory | None = None
    cameras: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Drive:
    """Everything the mapper may know of a drive; images are sorted by visit, time, then camera.

    ``truth_dir`` only shows the report where ground truth lies. ``trajectory`` holds the poses at the
    receiver's rate that those of the images were interpolated from, with the road laid flat; ``recorded`` the
    same as recorded. ``road`` is the recorded ground, None for the plane z = 0. ``unposed`` counts, by
    camera, the images left out for want of a pose. ``joined`` are the drives that it was made of
    (:func:`v2hdm.io.drive.join.join_drives`), if any: a joined drive has no trajectory of its own, and the
    largest of each noise.
    """

    name: str
    root: Path
    cameras: Mapping[str, Camera]
    images: Sequence[Image]
    pose_noise: PoseNoise = field(default_factory=PoseNoise)
    origin: GeodeticOrigin | None = None
    truth_dir: Path | None = None
    trajectory: Trajectory | None = None
    recorded: Trajectory | None = None
    road: Road | None = None
    unposed: Mapping[str, int] = field(default_factory=dict)
    joined: tuple[Visit, ...] = ()

    def name_of(self, path: Path) -> str:
        """Name an image as files of results do: its path below the drive's folder, else its whole path."""
        path, root = path.absolute(), self.root.absolute()
        return path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)

    @property
    def route_map(self) -> FloatArray:
        """Where the vehicle was at the images, (I, 2) m."""
        return np.array([image.map_from_vehicle[:2, 3] for image in self.images])

    @property
    def visits(self) -> tuple[Visit, ...]:
        """The drives that it was joined of, or itself alone."""
        own = (self.name, self.root, self.pose_noise, self.truth_dir, self.trajectory, self.recorded)
        return self.joined or (Visit(*own, {name: name for name in self.cameras}),)

    @property
    def noises(self) -> tuple[PoseNoise, ...]:
        """The noise of the recorded poses of each visit."""
        return tuple(visit.pose_noise for visit in self.visits)


@dataclass(frozen=True)
class MarkingDetection:
    """One quadrilateral marking in one image.

    ``corners_px`` (4, 2) run counter-clockwise as seen from above the ground, which is also how they run on
    the screen (their shoelace area in (u, v) is negative, since v points down); which comes first is
    arbitrary. ``covariance_px`` (8, 8), px^2, of the stacked corners (u0, v0, u1, ...) is large in a
    direction that the image hides, as along a dash whose end lies beyond the border. ``corner_valid`` (4,)
    says which corners are points: known well in every direction.

    Symbols, as arrows and chevrons, are no quadrilaterals: their corners are nan and not valid, and
    ``outline_px`` (N, 2) is their polygon; it is empty for quadrilaterals. ``outline_seen`` (N,) says which
    of its sides, each from its point to the next, lie along an edge of the paint.
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
    """A centre line in one image: ``points_px`` (N, 2), near to far.

    ``kind`` is the class of one piece of lane paint, or :data:`LANE_BOUNDARY` for a whole line. The whole
    lines of an image have an ``identity``: 1, 2, ... from the vehicle to the left, -1, -2, ... to the right.
    ``sigma_px`` (N,) is each point's standard deviation along its image row, None where it is not known.
    """

    kind: str
    score: float
    points_px: FloatArray
    identity: int | None = None
    sigma_px: FloatArray | None = None


@dataclass(frozen=True)
class ImageDetections:
    """The detections in image ``i`` of a drive (an index into ``Drive.images``)."""

    image: int
    markings: tuple[MarkingDetection, ...]
    lanes: tuple[LaneDetection, ...]


@dataclass(frozen=True)
class PaintLeft:
    """The ``share`` of a marking's paint that is left, 0 to 1, with its ``sigma``.

    ``change`` and ``change_sigma`` compare it to the earlier map's, None where there was none.
    """

    share: float
    sigma: float
    change: float | None = None
    change_sigma: float | None = None

    def since(self, before: PaintLeft | None) -> PaintLeft:
        """The same, with the change since an earlier measurement."""
        if before is None:
            return self
        return PaintLeft(
            self.share, self.sigma, self.share - before.share, float(np.hypot(self.sigma, before.sigma))
        )


@dataclass(frozen=True)
class Marking:
    """One mapped marking: ``corners_map`` (4, 2) m, counter-clockwise seen from above.

    ``covariance_m2`` (8, 8) is that of the stacked corners, None if unknown. ``relative_sigma_m`` is what the
    marking contributes to the error of a distance to one about 10 m away, one standard deviation a
    coordinate: without the drift and the survey that both share. ``heights_m`` (4,) are the heights of the
    ground, None where it was recorded as z = 0, ``heights_sigma_m`` (4,) their standard deviations where it
    was estimated. ``id`` is positive and no other feature's of its map; None until the map is written.
    ``paint`` is what is left of it, None where no image shows that.
    """

    kind: str
    corners_map: FloatArray
    sightings: int
    covariance_m2: FloatArray | None = None
    relative_sigma_m: float | None = None
    heights_m: FloatArray | None = None
    id: int | None = None
    paint: PaintLeft | None = None
    heights_sigma_m: FloatArray | None = None


@dataclass(frozen=True)
class Symbol:
    """One mapped symbol: the outline ``outline_map`` (N, 2) m of its paint, counter-clockwise from above.

    These are the vertices of a polygon, in the same order for all symbols of one template, with the joint
    covariance ``covariance_m2`` (2N, 2N); None in maps that state none.
    ``sigma_m`` is the standard deviation a coordinate; ``heights_m`` (N,), their sigmas and ``id`` are as a
    :class:`Marking` has them.
    """

    kind: str
    outline_map: FloatArray
    sightings: int
    sigma_m: float | None = None
    heights_m: FloatArray | None = None
    id: int | None = None
    heights_sigma_m: FloatArray | None = None
    covariance_m2: FloatArray | None = None


@dataclass(frozen=True)
class Lane:
    """One mapped lane line: a polyline ``points_map`` (N, 2) m along its centre.

    ``sigma_m`` (N,) is the standard deviation of each vertex across the line, of extrinsics and poses too,
    None where lanes take no part in the adjustment. ``heights_m`` (N,), their sigmas and ``id`` are as a
    :class:`Marking` has them.
    """

    kind: str
    points_map: FloatArray
    sightings: int
    heights_m: FloatArray | None = None
    id: int | None = None
    sigma_m: FloatArray | None = None
    heights_sigma_m: FloatArray | None = None


@dataclass(frozen=True)
class GroundStrip:
    """The estimated ground along a path, a grid of heights.

    Attributes:
        points_map: (N, 2) m of the path, ``step_m`` apart.
        ahead: (N, 2) unit vectors along it.
        left_m: (M,) to its left, evenly rising.
        heights_m: (N, M) of the ground.
        sigma_m: (N, M) their standard deviations.
    """

    points_map: FloatArray
    ahead: FloatArray
    step_m: float
    left_m: FloatArray
    heights_m: FloatArray
    sigma_m: FloatArray

    def points(self, left_m: float) -> FloatArray:
        """Points (N, 2) so far to the left of the path."""
        return self.points_map + left_m * np.column_stack([-self.ahead[:, 1], self.ahead[:, 0]])


@dataclass(frozen=True)
class HdMap:
    """Markings, lanes and symbols of a site in its map frame.

    ``drift_over_m`` is the distance over which the error that neighbouring markings share fades, None if
    unknown; ``largest_id`` the largest id ever given, also to what is gone, 0 where it is a feature's.
    ``ground`` is the surface by session, where it was estimated.

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

    def to_geodataframe(self) -> Any:
        """The features as a ``geopandas.GeoDataFrame``, a row each: id, layer, kind, sightings, geometry.

        Geometries are longitude, latitude and ellipsoidal height, m (EPSG:4326), where the map has an origin,
        and metres of the frame ``map`` otherwise.

        Raises:
            ModuleNotFoundError: geopandas is not installed; the message names the extra.

        >>> frame = result.map.to_geodataframe()
        >>> len(frame) == len(result.map.markings) + len(result.map.lanes) + len(result.map.symbols)
        True
        """
        try:
            import geopandas
            import pyproj
            import shapely
        except ModuleNotFoundError as missing:
            what = "to_geodataframe needs geopandas: install the gis extra, pip install 'v2hdm[gis]'"
            raise ModuleNotFoundError(what, name=missing.name) from None
        layers = (
            ("marking", self.markings, "corners_map"),
            ("lane", self.lanes, "points_map"),
            ("symbol", self.symbols, "outline_map"),
        )
        rows = []
        for layer, features, name in layers:
            shape = shapely.LineString if layer == "lane" else shapely.Polygon
            for one in features:
                points = getattr(one, name)
                heights_m = np.zeros(len(points)) if one.heights_m is None else one.heights_m
                geometry = shape(np.column_stack([points, heights_m]))
                rows.append((one.id, layer, one.kind, one.sightings, geometry))
        columns = ["id", "layer", "kind", "sightings", "geometry"]
        frame = geopandas.GeoDataFrame(rows, columns=columns, geometry="geometry")
        if self.origin is None:
            return frame
        at = f"+lon_0={self.origin.longitude_deg!r} +lat_0={self.origin.latitude_deg!r}"
        on_earth = pyproj.Transformer.from_pipeline(
            f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 {at} +h_0={self.origin.altitude_m!r} "
            "+step +inv +proj=cart +ellps=WGS84 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
        )
        geometry = shapely.transform(
            frame.geometry.values, lambda xyz: np.column_stack(on_earth.transform(*xyz.T)), include_z=True
        )
        return frame.set_geometry(geometry, crs="EPSG:4326")


class Fate(Enum):
    """The fate of a marking between an earlier map and a new drive."""

    MOVED = "moved"
    VANISHED = "vanished"
    NEW = "new"
    FIRST_SEEN = "first seen"
    """It is in the map now and was not before, but the earlier drive may just have missed it."""
    NOT_SEEN = "not seen"
    """It is in the map still: no image looked at its place, or too few to miss it."""


@dataclass(frozen=True)
class Change:
    """One marking that is not what the earlier map says, and the evidence.

    ``id``, ``kind`` and ``fate`` of the marking; its corners ``before`` and ``after`` (4, 2), None where
    there was or is none; how far its centre moved, ``shift_m`` (2,), beyond what the maps are apart there,
    and that shift's sigma. ``probability`` is that of its fate; ``views`` images of the drive (of a new one,
    of the earlier drive) had its place in near view and ``found`` of them showed it; ``sightings`` are of the
    map that has it.
    """

    id: int
    kind: str
    fate: Fate
    before: FloatArray | None
    after: FloatArray | None
    shift_m: FloatArray | None
    shift_sigma_m: FloatArray | None
    probability: float
    views: int
    found: int
    sightings: int


@dataclass(frozen=True)
class Changes:
    """An earlier map against a new drive: the ``changes``, and how many markings are the ``same``.

    ``shift_m`` (2,) is how far the drive's own map lay from the earlier one, as a mean.
    """

    changes: tuple[Change, ...]
    same: int
    shift_m: FloatArray

    def of(self, fate: Fate) -> tuple[Change, ...]:
        """The changes of one fate."""
        return tuple(one for one in self.changes if one.fate is fate)


@dataclass(frozen=True)
class Truth:
    """Ground truth of a rendered drive. Only the report reads it; the mapper never does.

    ``map_from_vehicle`` (I, 4, 4) are the true poses, one per ``Drive.images``. ``visibility`` (I, J) is the
    fraction of marking j of ``map.markings`` that image i shows, unoccluded. ``lane_visible`` flags, per
    lane, the vertices seen by some camera of the drive.
    """

    map: HdMap
    cam_from_vehicle: Mapping[str, FloatArray]
    map_from_vehicle: FloatArray
    visibility: FloatArray
    lane_visible: tuple[BoolArray, ...]
    disturbances: Mapping[str, float]


@dataclass(frozen=True)
class Calibration:
    """The calibration of one camera: ``cam_from_vehicle`` (4 x 4) is where it sits.

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

    @property
    def centre_vehicle(self) -> FloatArray:
        """The camera's centre (3,) in the frame ``vehicle``: forward, left, up, m."""
        return np.asarray(-self.cam_from_vehicle[:3, :3].T @ self.cam_from_vehicle[:3, 3])
