r"""The problem as plain numpy records: observations, unknowns and priors.

The unknowns, in the frames of :mod:`v2hdm.geometry`, are

- the extrinsic ``cam_from_vehicle`` of every camera,
- the corners of the markings ``corners_map`` (x, y); the ground is z = 0,
- optionally the error of every frame's recorded pose, any of x, y, height, roll, pitch and heading, as a
  tangent s in the vehicle frame, ``map_from_vehicle @ exp(s)``,
- optionally a clock offset of every camera, exposure minus stamp,
- optionally the read-out time of every camera, from the first row of an image to the last; the middle row is
  taken at the stamp (plus the clock offset).

Frames may belong to several sessions. Each session has its own pose noise, with drifts that start anew, and
its own clock offsets; cameras and corners are common.

The cost, in units of half a squared standard deviation, is

.. math:: f = \tfrac12 \sum_k \rho(\|\Sigma_k^{-1/2} (\pi(T_c\,e^{-s_j} P_j^{-1}\, l) - u_k)\|^2)
    + \tfrac12 \sum_c \|(o_c - \bar o_c) / \sigma_c\|^2 + \tfrac12 \sum_j \|s_j / \sigma_s\|^2

over observations k (one corner in one image), camera centres o and frame states s, plus terms of surveyed
corners, known lengths, clock offsets and planes of the ground where given. The prior acts on the camera's
*centre in the vehicle frame*, which a survey measures, rather than on the translation of
``cam_from_vehicle``, which depends on the rotation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple

import numpy as np

from v2hdm.doors import checked_class
from v2hdm.records import BoolArray, FloatArray, IntArray
from v2hdm.settings import NOT_NEGATIVE

POSE_STATES: tuple[str, ...] = ("x", "y", "height", "roll", "pitch", "heading")
"""Axes of a frame's error, in the order of its tangent."""

_LINE_RATIO = 1e3
"""Least ratio of an observation's variances at which it belongs to a line; a point's is below 200."""

# With the variances a > b: a b = det, a + b = trace, so a / b > q where trace^2 > det (q + 2 + 1 / q).
LINE_EXCESS = _LINE_RATIO + 2 + 1 / _LINE_RATIO
"""Least squared trace over determinant of a covariance at which the observation belongs to a line."""

_ROWS = 1 << 16
"""Observations that are looked at together: all at once would take 24 bytes each."""

_ROUNDED = 1e-12
"""Fraction of an axis' information below which its remainder beside the other axis is rounding."""

READ_OUT_SIGMA_S = 0.03
"""Prior sigma of a read-out time, s: 0 of a global shutter, mostly 28 to 32 ms of CMOS cameras in phones
(Ringaby and Forssen, International Journal of Computer Vision 96, 2012)."""

LOSSES: tuple[str, ...] = ("none", "huber", "cauchy", "geman_mcclure")
ENGINES: tuple[str, ...] = ("auto", "native", "torch")


@dataclass(frozen=True)
class Observations:
    """K sightings: ``camera`` (K,) saw ``corner`` (K,) at ``frame`` (K,).

    ``pinhole_px`` (K, 2) is undistorted, with ``covariance_px`` (K, 2, 2), px^2. ``row_share`` (K,) is the
    read-out time of its row in the recorded image, -1/2 for the first row to 1/2 for the last; only rolling
    shutters need it.
    """

    camera: IntArray
    frame: IntArray
    corner: IntArray
    pinhole_px: FloatArray
    covariance_px: FloatArray
    row_share: FloatArray | None = None

    @property
    def columns(self) -> tuple[IntArray | FloatArray, ...]:
        """All columns except the row shares, in the order of the fields."""
        return self.camera, self.frame, self.corner, self.pinhole_px, self.covariance_px

    def take(self, rows: IntArray | BoolArray) -> Observations:
        """The observations at ``rows``, indices or a mask."""
        columns: list[Any] = [None if column is None else column[rows] for column in vars(self).values()]
        return Observations(*columns)

    @property
    def on_line(self) -> BoolArray:
        """Observations (K,) of lines: the position along the line is unknown."""
        is_on_line = np.empty(len(self.corner), dtype=np.bool_)
        for begin in range(0, len(is_on_line), _ROWS):
            rows = slice(begin, begin + _ROWS)
            xx = self.covariance_px[rows, 0, 0]
            yx = self.covariance_px[rows, 1, 0]
            yy = self.covariance_px[rows, 1, 1]
            is_on_line[rows] = (xx + yy) ** 2 > (xx * yy - yx**2) * LINE_EXCESS
        return is_on_line


@dataclass(frozen=True)
class Drift:
    """The slow part of a pose error: a first-order Gauss-Markov process along the route.

    ``sigma`` is its standard deviation in the error's unit, ``over_m`` the driven distance over which it
    decorrelates to 1 / e. A sigma of 0 means none.
    """

    sigma: float = 0.0
    over_m: float = 30.0


@dataclass(frozen=True)
class ControlPoints:
    """M surveyed corners: ``corner`` (M,), ``points_map`` and ``sigma_m`` (M, 2).

    Sigmas apply to x and y, or along and across the directions ``along`` (M, 2); inf means unknown.
    """

    corner: IntArray
    points_map: FloatArray
    sigma_m: FloatArray
    along: FloatArray | None = None

    def take(self, rows: IntArray | BoolArray, corner: IntArray) -> ControlPoints:
        """The points at ``rows``, for corners renumbered to ``corner``."""
        along = None if self.along is None else self.along[rows]
        return ControlPoints(corner, self.points_map[rows], self.sigma_m[rows], along)

    @property
    def root_information(self) -> FloatArray:
        """Root information a, b, c (M, 3) of whitened residuals (a dx, b dx + c dy)."""
        t = np.array([[1.0, 0.0]]) if self.along is None else self.along
        first, second = (1 / self.sigma_m**2).T
        xx = first * t[:, 0] ** 2 + second * t[:, 1] ** 2
        yy = first * t[:, 1] ** 2 + second * t[:, 0] ** 2
        c = np.sqrt(yy)
        b = np.where(c > 0, (first - second) * t[:, 0] * t[:, 1] / np.where(c > 0, c, 1.0), 0.0)
        square = xx - b**2
        return np.column_stack([np.sqrt(np.where(square > _ROUNDED * xx, square, 0.0)), b, c])


@dataclass(frozen=True)
class KnownLengths:
    """M distances known beforehand, such as the sides of a painted sign.

    Corners ``first`` and ``second`` (M,) are ``length_m`` (M,) apart, with ``sigma_m`` (M,). Joined corners
    are eliminated together: meant for one marking, not for a net over the whole map.
    """

    first: IntArray
    second: IntArray
    length_m: FloatArray
    sigma_m: FloatArray


@dataclass(frozen=True)
class GroundPlanes:
    """The ground as C cameras' images of its texture show it, a plane in each camera.

    ``plane_cam`` (C, 4) is its normal, upwards, and the camera's height above it, m. ``root_information``
    (C, 3, 4) whitens deviations from that, and is 0 where texture shows no ground. ``by_lens`` (C, 2, 4) is
    the plane's change by a relative error of the focal length, and by one of k1.
    """

    plane_cam: FloatArray
    root_information: FloatArray
    by_lens: FloatArray

    def take(self, cameras: IntArray) -> GroundPlanes:
        """The planes of some cameras."""
        return GroundPlanes(self.plane_cam[cameras], self.root_information[cameras], self.by_lens[cameras])


@dataclass(frozen=True)
class PoseSigma:
    """Standard deviations of the recorded poses, per state of a frame.

    A ``..._drift`` is the correlated part, for frames in driving order; the rest, in quadrature, is white. A
    position drift keeps its direction in the map, and so rotates in the vehicle frame. ``heading_slip`` is
    that of :class:`~v2hdm.records.PoseNoise`; no state, it tells which faults the headings can have.
    """

    position_m: float = 0.02
    heading_rad: float = 0.001
    roll_pitch_rad: float = 0.003
    height_m: float = 0.01
    position_drift: Drift = Drift()
    heading_drift: Drift = Drift()
    roll_pitch_drift: Drift = Drift()
    heading_slip: float = 0.0

    def by_state(self) -> FloatArray:
        """Sigmas (6,) in the order of :data:`POSE_STATES`."""
        position = self.position_m
        attitude = self.roll_pitch_rad
        return np.array([position, position, self.height_m, attitude, attitude, self.heading_rad])

    def drift_by_state(self) -> tuple[Drift, ...]:
        """The six drifts in the order of :data:`POSE_STATES`."""
        position = self.position_drift
        attitude = self.roll_pitch_drift
        return (position, position, Drift(), attitude, attitude, self.heading_drift)


@checked_class
@dataclass(frozen=True)
class Problem:
    """C cameras, J frames, N corners and the data that connect them.

    ``intrinsic`` (C, 4) is fx, fy, cx, cy, px. ``cam_from_vehicle`` (C, 4, 4) is the start,
    ``map_from_vehicle`` (J, 4, 4) the recorded poses. ``centre_vehicle`` and ``centre_sigma_m`` (C, 3) are
    the surveyed camera centres, or None; ``ground`` is what texture shows of the ground, or None.
    ``poses_start`` (J, 4, 4) replaces these, and ``corners_start`` (N, 2) weighted back-projection, as the
    start. ``twist_vehicle`` (J, 6), the vehicle's velocity in its own frame (m/s, rad/s), is needed
    for clock offsets, whose prior sigma is ``clock_sigma_s``. ``read_out_s`` (C,) are the stated read-out
    times, None for global shutters; their prior sigma is ``read_out_sigma_s``. ``control`` are surveyed
    corners: they alone separate a shift of the whole map from the drift of GNSS. ``lengths`` are known
    distances. ``session`` (J,) is the number of each frame's session, from 0 and rising; ``pose_sigma`` is
    one for all sessions or one per session.

    >>> problem = build_problem(port, result.detections)
    >>> problem.intrinsic.shape, problem.observations.pinhole_px.shape[1:]
    ((1, 4), (2,))
    """

    intrinsic: FloatArray
    cam_from_vehicle: FloatArray
    map_from_vehicle: FloatArray
    observations: Observations
    corner_count: Annotated[int, NOT_NEGATIVE]
    centre_vehicle: FloatArray | None = None
    centre_sigma_m: FloatArray | None = None
    pose_sigma: PoseSigma | tuple[PoseSigma, ...] = PoseSigma()
    poses_start: FloatArray | None = None
    corners_start: FloatArray | None = None
    twist_vehicle: FloatArray | None = None
    clock_sigma_s: float = 0.01
    read_out_s: FloatArray | None = None
    read_out_sigma_s: float = READ_OUT_SIGMA_S
    control: ControlPoints | None = None
    lengths: KnownLengths | None = None
    session: IntArray | None = None
    ground: GroundPlanes | None = None

    def seen_by(self, observations: Observations, **changes: Any) -> ProblemPart:
        """The problem of the cameras and frames of ``observations``, after ``changes`` of other fields.

        Corners are those of the observations, without this problem's knowledge of its own.
        """
        stated = vars(self) | changes
        cameras, camera = np.unique(observations.camera, return_inverse=True)
        frames, frame = np.unique(observations.frame, return_inverse=True)
        of_cameras = "intrinsic", "cam_from_vehicle", "centre_vehicle", "centre_sigma_m", "read_out_s"
        of_frames = "map_from_vehicle", "poses_start", "twist_vehicle", "session"
        rows = dict.fromkeys(of_cameras, cameras) | dict.fromkeys(of_frames, frames)
        parts = {name: stated[name][at] for name, at in rows.items() if stated[name] is not None}
        if stated["ground"] is not None:
            parts["ground"] = stated["ground"].take(cameras)
        unknown = {"corners_start": None, "control": None, "lengths": None}
        renumbered = replace(observations, camera=camera, frame=frame)
        count = int(observations.corner.max(initial=-1)) + 1
        fields = unknown | changes | parts
        problem = replace(self, observations=renumbered, corner_count=count, **fields)
        return ProblemPart(problem, cameras, frames)

    @property
    def session_of_frame(self) -> IntArray:
        """Session (J,) of each frame."""
        return np.zeros(len(self.map_from_vehicle), dtype=np.int64) if self.session is None else self.session

    @property
    def session_count(self) -> int:
        """Number of sessions."""
        if not isinstance(self.pose_sigma, PoseSigma):
            return len(self.pose_sigma)
        return int(self.session_of_frame.max(initial=0)) + 1

    @property
    def pose_sigmas(self) -> tuple[PoseSigma, ...]:
        """Standard deviations of each session's recorded poses."""
        sigma = self.pose_sigma
        return self.session_count * (sigma,) if isinstance(sigma, PoseSigma) else sigma


class ProblemPart(NamedTuple):
    """Some cameras and frames of a problem as one of their own."""

    problem: Problem
    cameras: IntArray  # (C,) indices in the whole
    frames: IntArray  # (J,) indices in the whole


@dataclass(kw_only=True)
class SolveOptions:
    """Options of a solve.

    Attributes:
        pose_states: states of each frame, of :data:`POSE_STATES`; () is the paper's model.
        clock_offset: estimate one clock offset per camera and session.
        read_out: estimate each camera's read-out time.
        loss: robust loss of an observation's whitened residual, of :data:`LOSSES`.
        loss_scale: residual, in standard deviations, at which the loss departs from least squares.
        gate_probability: fraction of sound observations that the outlier test may reject.
        coarse: from a distant start, or in a large problem, first solve a subset of steep rays, which
            converges from ten degrees away.
        gap_tolerance: predicted remaining decrease, as a fraction of the cost, at which to stop.
        max_refreshes: largest number of whitenings.
        max_evaluations: largest number of evaluations of cost and gradient, in total.
        engine: of :data:`ENGINES`: ``native`` by kernels on the CPU, compiled by numba unless the install
            has compiled them from C++ (``numba``, its earlier name, still chooses it); ``torch`` by autograd
            anywhere; ``auto`` is kernels on the CPU, torch elsewhere.
        device: torch device.
    """

    pose_states: tuple[str, ...] = POSE_STATES
    clock_offset: bool = False
    read_out: bool = False
    loss: str = "cauchy"
    loss_scale: float = 2.0
    gate_probability: float = 1e-4
    coarse: bool = True
    gap_tolerance: float = 1e-11
    max_refreshes: int = 20
    max_evaluations: int = 500
    engine: str = "auto"
    device: str = "cpu"

    @property
    def on_cpu(self) -> bool:
        """Whether the device is the CPU."""
        return self.device.split(":")[0] == "cpu"
