"""The records that travel between the parts: plain frozen dataclasses over numpy arrays.

Frames are those of :mod:`v2hdm.geometry`: ``map`` (ENU, metres, z up, ground near
z = 0), ``vehicle`` (x forward, y left, z up, origin on the ground under the rear axle), ``cam``
(optical: z forward, x right, y down), ``px`` (u right, v down, the centre of the top-left pixel
is (0, 0)). Transforms are 4 x 4 float64 matrices named ``dst_from_src``. Image points come in two
flavours: ``_px`` are pixels of the image as recorded, ``_pinhole_px`` are the same points with the
lens distortion removed, on the pinhole image of the same intrinsic matrix.

Index letters, everywhere: ``i`` image, ``j`` marking, ``k`` corner observation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

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

    ``ipm`` maps a name (``calibrated``: from a manual calibration of this vehicle; ``estimated``:
    borrowed from another vehicle) to a coarse IPM homography ``vehicle_from_pinhole_px`` (3 x 3).
    ``initial_ipm`` names the one that the mapping starts from. ``roi_vehicle`` (N x 2, m) is the
    convex polygon on the ground within which the IPM is trusted. ``linear_response`` says that the
    grey values are proportional to radiance; otherwise sRGB coding is assumed. ``own_vehicle`` (height,
    width) says which pixels show the vehicle itself, None where nobody has told.
    """

    info: CameraInfo
    ipm: Mapping[str, FloatArray]
    initial_ipm: str
    roi_vehicle: FloatArray
    centre_prior: CentrePrior | None = None
    linear_response: bool = False
    own_vehicle: BoolArray | None = None


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
    drawn anew at every image; without a drift all of it is.
    """

    position_m: float = 0.02
    heading_rad: float = 0.001
    roll_pitch_rad: float = 0.003
    position_drift_m: float = 0.0
    position_drift_over_m: float = 30.0
    heading_drift_rad: float = 0.0
    heading_drift_over_m: float = 5.0
    roll_pitch_drift_rad: float = 0.0
    roll_pitch_drift_over_m: float = 1.0

    @classmethod
    def as_far_as_stated(cls, **stated: float) -> PoseNoise:
        """The noise of a drive whose description may leave out some of it.

        A drift that is not stated takes half of its variance: an error that repeats from image to image does
        not average out, and a map that reckons with none is less certain than it says.
        """
        noise = cls(**stated)
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
"""Of each standard deviation of :class:`PoseNoise`, its drift."""

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

    Attributes:
        points_map: (P, 2) m, places along the route in driving order.
        height_m: (P,) recorded height of the ground there.
        slope: (P, 2) its derivative by x and by y.
    """

    points_map: FloatArray
    height_m: FloatArray
    slope: FloatArray


@dataclass(frozen=True)
class Image:
    """One image of a drive and the vehicle's pose (4 x 4) when it was taken.

    ``stamp_s`` is its recorded time; ``clock_offset_s`` is how much later it was taken, as far as that is
    known. ``visit`` is an index into ``Drive.visits``.
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

    ``truth_dir`` only tells the report where ground truth lies, if there is any. ``trajectory`` holds the
    poses that those of the images were interpolated from, at the receiver's rate, with the road laid flat;
    ``recorded`` the same poses as they were recorded. ``road`` is the recorded ground, None where it was
    recorded as the plane z = 0. ``unposed`` counts, by camera, the images left out for want of a pose.
    ``joined`` are the drives that it was made of (:func:`v2hdm.io.drive.join.join_drives`), empty for one
    that was recorded in one piece; a joined drive has no trajectory of its own, and the largest of each
    noise.
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

    ``corners_px`` (4, 2) run counter-clockwise as seen from above the ground, which is also how
    they run on the screen (in (u, v) coordinates their shoelace area is negative, since v points
    down); which corner comes first is arbitrary.
    ``covariance_px`` (8, 8) is that of the stacked corners (u0, v0, u1, ...), px^2: of a direction that the
    image hides it is large, as along a dash whose end lies beyond the image's border. ``corner_valid`` (4,)
    says which corners are points: known well in every direction.

    Symbols, as arrows and chevrons, are no quadrilaterals: of their corners, all nan, none is valid, and
    ``outline_px`` (N, 2) is their polygon; it is empty for quadrilaterals.
    """

    kind: str
    score: float
    corners_px: FloatArray
    covariance_px: FloatArray
    corner_valid: BoolArray
    outline_px: FloatArray = field(default_factory=lambda: np.empty((0, 2)))


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
    """What the detector found in image ``i`` of a drive (an index into ``Drive.images``)."""

    image: int
    markings: tuple[MarkingDetection, ...]
    lanes: tuple[LaneDetection, ...]


@dataclass(frozen=True)
class Marking:
    """One mapped marking: ``corners_map`` (4, 2) m, counter-clockwise seen from above.

    ``covariance_m2`` (8, 8) is that of the stacked corners in the map, or None where the method has none.
    ``relative_sigma_m`` is what the marking contributes to the error of a distance to one about 10 m away,
    one standard deviation a coordinate: without the drift and the survey that both share. None if unknown.
    ``heights_m`` (4,) are the recorded heights of the ground there, None where it was recorded as z = 0.
    ``id`` is positive and no other feature's of its map; None until the map is written.
    """

    kind: str
    corners_map: FloatArray
    sightings: int
    covariance_m2: FloatArray | None = None
    relative_sigma_m: float | None = None
    heights_m: FloatArray | None = None
    id: int | None = None


@dataclass(frozen=True)
class Symbol:
    """One mapped symbol: the outline ``outline_map`` (N, 2) m of its paint, counter-clockwise from above.

    ``sigma_m`` is the standard deviation a coordinate of its place, as its sightings scatter. ``heights_m``
    (N,) are the recorded heights of the ground there, None where it was recorded as z = 0. ``id`` is positive
    and no other feature's of its map; None until the map is written.
    """

    kind: str
    outline_map: FloatArray
    sightings: int
    sigma_m: float | None = None
    heights_m: FloatArray | None = None
    id: int | None = None


@dataclass(frozen=True)
class Lane:
    """One mapped lane line: a polyline ``points_map`` (N, 2) m along its centre.

    ``heights_m`` (N,) are the recorded heights of the ground there, None where it was recorded as z = 0.
    ``id`` is positive and no other feature's of its map; None until the map is written.
    """

    kind: str
    points_map: FloatArray
    sightings: int
    heights_m: FloatArray | None = None
    id: int | None = None


@dataclass(frozen=True)
class HdMap:
    """Markings, lanes and symbols of a site in its map frame.

    ``drift_over_m`` is the distance over which the error that neighbouring markings share fades, None where
    it is not known. ``largest_id`` is the largest id that was ever given, also to what is gone; 0 where it
    is a feature's.

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
        layers = (("marking", self.markings), ("lane", self.lanes), ("symbol", self.symbols))
        rows = []
        for layer, features in layers:
            for one in features:
                points = getattr(one, _POINTS[type(one)])
                heights_m = np.zeros(len(points)) if one.heights_m is None else one.heights_m
                shape = (shapely.LineString if layer == "lane" else shapely.Polygon)(
                    np.column_stack([points, heights_m])
                )
                rows.append((one.id, layer, one.kind, one.sightings, shape))
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


_POINTS = {Marking: "corners_map", Lane: "points_map", Symbol: "outline_map"}


class Fate(Enum):
    """What became of a marking between an earlier map and a new drive."""

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

    Attributes:
        id: in the map; that of a vanished one is never given again.
        kind: its class.
        fate: what became of it.
        before: corners (4, 2) in the earlier map's place for it, m; None if it had none.
        after: corners (4, 2) now; None if it is gone.
        shift_m: (2,) how far its centre moved beyond what the two maps are apart there; None if it did not.
        shift_sigma_m: (2,) of that.
        probability: of its fate.
        views: images of the drive that had its place in near view; of a new one, images of the earlier drive.
        found: in how many of them it was found.
        sightings: images that show it, of the map that has it.
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
    """An earlier map against a new drive.

    ``changes`` are the markings that are not the same any more, ``same`` counts those seen again in their
    places. ``shift_m`` (2,) is how far the drive's own map lay from the earlier one, as a mean.
    """

    changes: tuple[Change, ...]
    same: int
    shift_m: FloatArray

    def of(self, fate: Fate) -> tuple[Change, ...]:
        """Those of one fate."""
        return tuple(one for one in self.changes if one.fate is fate)


@dataclass(frozen=True)
class Truth:
    """Ground truth of a rendered drive. Only the report reads it; the mapper never does.

    ``map_from_vehicle`` (I, 4, 4) are the true poses, one per ``Drive.images``. ``visibility`` (I, J)
    is the fraction of marking j (an index into ``map.markings``) that image i shows, unoccluded.
    ``lane_visible`` holds per lane a flag per vertex: seen by some camera of the drive.
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

    ``covariance`` (6, 6) is that of the left-perturbation tangent of ``cam_from_vehicle``, in the
    order translation (m), rotation (rad); None where the method has none.

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
