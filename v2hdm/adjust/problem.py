r"""The problem as plain numpy records: observations, unknowns and priors.

Unknown are, in the frames of :mod:`v2hdm.geometry`,

- the extrinsic ``cam_from_vehicle`` of every camera,
- the corners of the markings ``corners_map`` (x, y); the ground is z = 0,
- optionally, for every frame, how far the vehicle was from its recorded pose: any of x, y, height,
  roll, pitch, heading, as a tangent s in the vehicle frame, ``map_from_vehicle @ exp(s)``,
- optionally, for every camera, a clock offset: its images were taken that much later than they say,
- optionally, for every camera, its read-out time: from the first row of an image to the last, the middle row
  being taken at the image's stamp (plus the clock offset).

Frames may be of several visits to the site. Each visit has its own noise of poses, whose drift begins anew,
and its own clock offsets; cameras and corners are common to all.

The cost, in units of half a squared standard deviation, is

.. math:: f = \tfrac12 \sum_k \rho(\|\Sigma_k^{-1/2} (\pi(T_c\,e^{-s_j} P_j^{-1}\, l) - u_k)\|^2)
    + \tfrac12 \sum_c \|(o_c - \bar o_c) / \sigma_c\|^2 + \tfrac12 \sum_j \|s_j / \sigma_s\|^2

over observations k (one corner in one image), camera centres o and frame states s; to which come, where they
are known, the surveyed positions of corners, the distances between them, and clock offsets. The prior acts on
the camera's *centre in the vehicle frame*, which a survey measures, and not on the translation of
``cam_from_vehicle``, which a rotation error would drag along.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from v2hdm.records import BoolArray, FloatArray, IntArray

POSE_STATES: tuple[str, ...] = ("x", "y", "height", "roll", "pitch", "heading")
"""The axes in which a frame can deviate, in the order of its tangent."""

_LINE_RATIO = 1e3
"""Ratio of an observation's two variances from which it is one of a line: a point's is below 200."""

# With the variances a > b: a b = det, a + b = trace, so a / b > q where trace^2 > det (q + 2 + 1 / q).
LINE_EXCESS = _LINE_RATIO + 2 + 1 / _LINE_RATIO
"""Squared trace over determinant of a covariance from which an observation is one of a line."""

_ROUNDED = 1e-12
"""Share of an information below which what another axis has left of it is rounding."""

READ_OUT_SIGMA_S = 0.03
"""How far a read-out time may be from the stated one, s: a global shutter's is 0, that of CMOS cameras in
phones mostly 28 to 32 ms (Ringaby and Forssen, International Journal of Computer Vision 96, 2012)."""

LOSSES: tuple[str, ...] = ("none", "huber", "cauchy", "geman_mcclure")
ENGINES: tuple[str, ...] = ("auto", "numba", "torch")


@dataclass(frozen=True)
class Observations:
    """K sightings: camera ``camera`` (K,) saw at frame ``frame`` (K,) the corner ``corner`` (K,).

    ``pinhole_px`` (K, 2) is where, with the lens distortion removed; ``covariance_px`` (K, 2, 2) how
    well, px^2. ``row_share`` (K,) is when in the read-out its row of the recorded image was taken, from -1/2
    for the first row to 1/2 for the last; only a rolling shutter asks for it.
    """

    camera: IntArray
    frame: IntArray
    corner: IntArray
    pinhole_px: FloatArray
    covariance_px: FloatArray
    row_share: FloatArray | None = None

    @property
    def columns(self) -> tuple[IntArray | FloatArray, ...]:
        """All columns but the row shares, in the order of the fields."""
        return self.camera, self.frame, self.corner, self.pinhole_px, self.covariance_px

    def take(self, rows: IntArray | BoolArray) -> Observations:
        """The observations at ``rows``, indices or a mask."""
        taken: list[Any] = [None if one is None else one[rows] for one in vars(self).values()]
        return Observations(*taken)

    @property
    def on_line(self) -> BoolArray:
        """Which observations (K,) say on which line of the image their corner lies, and not where on it."""
        xx, yx, yy = (self.covariance_px[:, row, column] for row, column in ((0, 0), (1, 0), (1, 1)))
        return np.asarray((xx + yy) ** 2 > (xx * yy - yx**2) * LINE_EXCESS)


@dataclass(frozen=True)
class Drift:
    """The slow part of a pose error: a first-order Gauss-Markov process along the route.

    ``sigma`` is its standard deviation, in the unit of the error; ``over_m`` the driven distance over which
    it fades to 1 / e. A sigma of 0 means that there is none.
    """

    sigma: float = 0.0
    over_m: float = 30.0


@dataclass(frozen=True)
class ControlPoints:
    """M corners that a survey has measured: ``corner`` (M,), ``points_map`` and ``sigma_m`` (M, 2).

    Sigmas are those of x and y or, where directions ``along`` (M, 2) are given, along and across these;
    an infinite one says nothing.
    """

    corner: IntArray
    points_map: FloatArray
    sigma_m: FloatArray
    along: FloatArray | None = None

    def take(self, rows: IntArray | BoolArray, corner: IntArray) -> ControlPoints:
        """The points at ``rows``, of corners that are now called ``corner``."""
        along = None if self.along is None else self.along[rows]
        return ControlPoints(corner, self.points_map[rows], self.sigma_m[rows], along)

    @property
    def root_information(self) -> FloatArray:
        """a, b, c (M, 3) of the whitened residuals (a dx, b dx + c dy)."""
        t = np.array([[1.0, 0.0]]) if self.along is None else self.along
        one, other = (1 / self.sigma_m**2).T
        xx, yy = one * t[:, 0] ** 2 + other * t[:, 1] ** 2, one * t[:, 1] ** 2 + other * t[:, 0] ** 2
        c = np.sqrt(yy)
        b = np.where(c > 0, (one - other) * t[:, 0] * t[:, 1] / np.where(c > 0, c, 1.0), 0.0)
        left = xx - b**2
        return np.column_stack([np.sqrt(np.where(left > _ROUNDED * xx, left, 0.0)), b, c])


@dataclass(frozen=True)
class KnownLengths:
    """M distances that are known beforehand, such as the sides of a painted sign.

    Between the corners ``first`` (M,) and ``second`` (M,) there are ``length_m`` (M,), give or take
    ``sigma_m`` (M,). Corners that lengths join, directly or through others, are eliminated together: meant
    for those of one marking, not for a net over the whole map.
    """

    first: IntArray
    second: IntArray
    length_m: FloatArray
    sigma_m: FloatArray


@dataclass(frozen=True)
class PoseSigma:
    """How far the recorded poses are off, one standard deviation of each state of a frame.

    Of each, the ``..._drift`` is the part that fades along the route; frames must then be in driving
    order. The rest, in quadrature, is independent from frame to frame. A drift of the position keeps its
    direction in the map, and so turns in the vehicle as it turns.
    """

    position_m: float = 0.02
    heading_rad: float = 0.001
    roll_pitch_rad: float = 0.003
    height_m: float = 0.01
    position_drift: Drift = Drift()
    heading_drift: Drift = Drift()
    roll_pitch_drift: Drift = Drift()

    def by_state(self) -> FloatArray:
        """Sigmas (6,) in the order of :data:`POSE_STATES`."""
        position, attitude = self.position_m, self.roll_pitch_rad
        return np.array([position, position, self.height_m, attitude, attitude, self.heading_rad])

    def drift_by_state(self) -> tuple[Drift, ...]:
        """The six drifts in the order of :data:`POSE_STATES`."""
        position, attitude = self.position_drift, self.roll_pitch_drift
        return (position, position, Drift(), attitude, attitude, self.heading_drift)


@dataclass(frozen=True)
class Problem:
    """C cameras, J frames, N corners and what ties them together.

    ``intrinsic`` (C, 4) is fx, fy, cx, cy in px. ``cam_from_vehicle`` (C, 4, 4) is where to start
    from; ``map_from_vehicle`` (J, 4, 4) are the recorded poses. ``centre_vehicle`` and
    ``centre_sigma_m`` (C, 3) are the surveyed camera centres, or None. ``corners_start`` (N, 2), if
    given, replaces the start by weighted back-projection. ``twist_vehicle`` (J, 6) is how the vehicle
    moves at each frame, per second and in its own frame (m/s, then rad/s); a clock offset needs it, and
    is held near zero by ``clock_sigma_s``. ``read_out_s`` (C,) are the cameras' read-out times as stated,
    None for global shutters; estimated ones are held near them by ``read_out_sigma_s``. ``control``, if
    given, ties corners to a survey: the only thing that can tell a shift of the whole map from the drift of
    the receiver. ``lengths``, if given, are known distances between corners. ``visit`` (J,), if
    given, numbers the visit that each frame is of, from 0 and rising; there is then one ``pose_sigma`` for
    all visits or one for each.

    >>> problem = build_problem(port, result.detections)
    >>> problem.intrinsic.shape, problem.observations.pinhole_px.shape[1:]
    ((1, 4), (2,))
    """

    intrinsic: FloatArray
    cam_from_vehicle: FloatArray
    map_from_vehicle: FloatArray
    observations: Observations
    corner_count: int
    centre_vehicle: FloatArray | None = None
    centre_sigma_m: FloatArray | None = None
    pose_sigma: PoseSigma | tuple[PoseSigma, ...] = PoseSigma()
    corners_start: FloatArray | None = None
    twist_vehicle: FloatArray | None = None
    clock_sigma_s: float = 0.01
    read_out_s: FloatArray | None = None
    read_out_sigma_s: float = READ_OUT_SIGMA_S
    control: ControlPoints | None = None
    lengths: KnownLengths | None = None
    visit: IntArray | None = None

    def seen_by(self, observations: Observations) -> tuple[Problem, IntArray, IntArray]:
        """The problem of the cameras and frames of ``observations`` alone, and their indices (C,), (J,) here.

        Corners are those of the observations; what this problem knows of its own is left out.
        """
        cameras, camera = np.unique(observations.camera, return_inverse=True)
        frames, frame = np.unique(observations.frame, return_inverse=True)
        of_cameras = "intrinsic", "cam_from_vehicle", "centre_vehicle", "centre_sigma_m", "read_out_s"
        of_frames = "map_from_vehicle", "twist_vehicle", "visit"
        rows = dict.fromkeys(of_cameras, cameras) | dict.fromkeys(of_frames, frames)
        own = {name: getattr(self, name)[at] for name, at in rows.items() if getattr(self, name) is not None}
        seen = replace(observations, camera=camera, frame=frame)
        own |= {"corners_start": None, "control": None, "lengths": None}
        count = int(observations.corner.max(initial=-1)) + 1
        return replace(self, observations=seen, corner_count=count, **own), cameras, frames

    @property
    def visit_of_frame(self) -> IntArray:
        """The visit (J,) that each frame is of."""
        return np.zeros(len(self.map_from_vehicle), dtype=np.int64) if self.visit is None else self.visit

    @property
    def visit_count(self) -> int:
        """How many visits there are."""
        if not isinstance(self.pose_sigma, PoseSigma):
            return len(self.pose_sigma)
        return int(self.visit_of_frame.max(initial=0)) + 1

    @property
    def pose_sigmas(self) -> tuple[PoseSigma, ...]:
        """How far the recorded poses of each visit are off."""
        one = self.pose_sigma
        return self.visit_count * (one,) if isinstance(one, PoseSigma) else one


@dataclass(kw_only=True)
class SolveOptions:
    """How to solve.

    Attributes:
        pose_states: the states each frame is given, of :data:`POSE_STATES`; () is the paper's model.
        clock_offset: whether each camera's clock offset, one a visit, is estimated.
        read_out: whether each camera's read-out time is estimated.
        loss: robust loss on the whitened residual of an observation, of :data:`LOSSES`.
        loss_scale: residual, in standard deviations, from which the loss departs from least squares.
        gate_probability: share of sound observations that the verdict on outliers may cost.
        coarse: where the start is far off, or the problem large, first solve a subset of steep rays, which
            converges from ten degrees away.
        gap_tolerance: stop when the predicted remaining decrease is this fraction of the cost.
        max_refreshes: how often the problem is whitened anew at most.
        max_evaluations: of cost and gradient, over all refreshes.
        engine: who evaluates and linearises, of :data:`ENGINES`: ``numba`` by compiled kernels on the CPU,
            ``torch`` by autograd anywhere; ``auto`` is numba on the CPU, torch elsewhere.
        device: torch device to compute on.
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
