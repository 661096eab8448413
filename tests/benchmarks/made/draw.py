"""Draws for a right drive: port, route, errors of poses, of the road and of the detector."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from v2hdm.cli.compose import conf_dir
from v2hdm.records import PoseNoise
from v2hdm.simulate.port.config import CameraConfig, PortConfig

ROUTES = ("straight", "bends", "turning")

_DRAWN, _ROAD, _TURNS = 31, 32, 33  # streams of a seed; a port's own are small numbers
_LEAST_LEFT_M = 30.0  # of a route for another bend
_ROAD_SHARE = 1 / 3  # of the drives that have one
_IN_TURN_SHARE = 1 / 3  # of the drives whose cameras fire in turn
_STREAM_HZ = 20.0  # rate of the poses of these, as receivers send them
_APART_LOW_S, _APART_HIGH_S = 0.015, 0.05  # least and most time from camera to camera that is drawn


@dataclass(frozen=True)
class PoseErrors:
    """How recorded poses differ from true ones; standard deviations per axis, lengths of correlation in m.

    White parts are drawn anew at every recorded pose, drifts are Gauss-Markov processes along the route.
    Roll, pitch and heave are those of a ``smooth`` road under a vehicle whose receiver records neither; else
    Gauss-Markov processes, too.
    """

    position_white_m: float
    position_drift_m: float
    position_over_m: float
    heading_white_rad: float
    heading_drift_rad: float
    heading_over_m: float
    roll_pitch_rad: float
    roll_pitch_over_m: float
    heave_m: float
    heave_over_m: float
    smooth: bool = True

    def as_stated(self, clock_s: float | None = None) -> PoseNoise:
        """A data sheet that states them as they are, and the clocks if it says anything of these."""
        clock = {} if clock_s is None else {"clock_s": clock_s}
        return PoseNoise.from_stated(
            position_m=float(np.hypot(self.position_white_m, self.position_drift_m)),
            heading_rad=float(np.hypot(self.heading_white_rad, self.heading_drift_rad)),
            roll_pitch_rad=self.roll_pitch_rad,
            position_drift_m=self.position_drift_m,
            position_drift_over_m=self.position_over_m,
            heading_drift_rad=self.heading_drift_rad,
            heading_drift_over_m=self.heading_over_m,
            roll_pitch_drift_rad=self.roll_pitch_rad,
            roll_pitch_drift_over_m=self.roll_pitch_over_m,
            **clock,
        )


@dataclass(frozen=True)
class DetectorErrors:
    """How detections differ from the paint.

    Attributes:
        sigma_px: of a corner close to the camera.
        sigma_spread: of the logarithm of what multiplies it, from image to image and from corner to corner.
        doubled_at_m: distance at which light and texture have doubled it.
        stated_factor: by which the stated covariance is larger than the true one.
        missed: share of sightings that are not detected.
        false: detections of what is no marking, as a share of all.
        cut: share of the detections whose far end is hidden, but stated as if it were seen.
    """

    sigma_px: float
    sigma_spread: float
    doubled_at_m: float
    stated_factor: float
    missed: float
    false: float
    cut: float


@dataclass(frozen=True)
class RoadShape:
    """Ground that is not level, under a receiver that records height, roll and pitch.

    Attributes:
        slope: standard deviation of its grade, and of its fall across the route.
        slope_over_m: length over which these change.
        mount_rad: roll and pitch of the receiver on the vehicle.
        height_drift_m: of the recorded height, over the length over which positions drift.
    """

    slope: float
    slope_over_m: float
    mount_rad: tuple[float, float]
    height_drift_m: float


@dataclass(frozen=True)
class Recipe:
    """All that is drawn of one right drive.

    ``default_noise``: the user states no noise of the poses. ``road`` is None for level ground under a
    receiver that records neither height nor roll and pitch; else it records these, with the errors of roll
    and pitch that ``poses`` has, beside the vehicle's sway. ``relief`` is what the ground does beside:
    ``grade``, ``ramp`` or ``crest``. Cameras fire ``apart_s`` after each other: between poses of a stream, so
    that neighbouring images share the noise of these. ``clock_s`` is stated of the clocks, which are right;
    None where the user does not know how right they are.
    """

    seed: int
    route: str
    port: PortConfig
    poses: PoseErrors
    detector: DetectorErrors
    default_noise: bool
    road: RoadShape | None
    relief: str = ""
    apart_s: float = 0.0
    clock_s: float | None = None

    @property
    def pose_noise(self) -> PoseNoise:
        """As the drive states it."""
        return PoseNoise.from_stated() if self.default_noise else self.poses.as_stated(self.clock_s)

    def with_noise_stated(self) -> Recipe:
        """The same, whose poses and clocks are stated to be as they are."""
        return replace(self, default_noise=False, clock_s=0.0)

    def as_modelled(self) -> Recipe:
        """The same with all errors stated as they are, and none that the product does not reckon with."""
        poses = replace(self.poses, smooth=False)
        detector = replace(self.detector, sigma_spread=0.0, stated_factor=1.0, missed=0.0, false=0.0, cut=0.0)
        modelled = replace(self, poses=poses, detector=detector, road=None, apart_s=0.0)
        return modelled.with_noise_stated()

    def recorded(self, relief: str) -> Recipe:
        """The same under a receiver that records the road, which has this ``relief`` beside its own shape."""
        road = self.road or RoadShape(5e-4, 40.0, (0.002, -0.002), 1.5 * self.poses.position_drift_m)
        return replace(self, road=road, relief=relief)

    def in_turn(self, apart_s: float) -> Recipe:
        """The same by cameras that fire in turn, under a stream of poses."""
        route = replace(self.port.route, pose_rate_hz=_STREAM_HZ)
        return replace(self, port=replace(self.port, route=route), apart_s=apart_s)

    def as_figures(self) -> dict[str, Any]:
        """The drawn values, for the record."""
        return {
            **asdict(self.poses),
            **asdict(self.detector),
            "road": self.road and asdict(self.road),
            "apart_s": self.apart_s,
        }

    @property
    def name(self) -> str:
        """As it is printed: the port, the route and the seed."""
        return f"{self.port.name} {self.route} {self.seed}"


def draw(seed: int, route: str | None = None) -> Recipe:
    """Draw a right drive; equal arguments give equal drives.

    Args:
        seed: of everything.
        route: one of :data:`ROUTES`; None draws one.
    """
    rng = np.random.default_rng([seed, _DRAWN])
    drawn_route = str(rng.choice(ROUTES))
    route = route or drawn_route
    default_noise = bool(rng.random() < 0.5)
    poses = _pose_errors(rng, default_noise)
    detector = draw_detector_errors(rng)
    return Recipe(seed, route, _port(rng, seed, route), poses, detector, default_noise, _road(seed, poses))


def draw_detector_errors(rng: np.random.Generator) -> DetectorErrors:
    """Errors of a detector between a very good and a poor one."""
    return DetectorErrors(
        sigma_px=_log_uniform(rng, 0.1, 0.4),
        sigma_spread=float(rng.uniform(0.1, 0.4)),
        doubled_at_m=float(rng.uniform(8.0, 16.0)),
        stated_factor=_log_uniform(rng, 0.5, 2.0),
        missed=float(rng.uniform(0.0, 0.25)),
        false=float(rng.uniform(0.0, 0.03)),
        cut=float(rng.uniform(0.0, 0.02)),
    )


def draw_apart_s(seed: int) -> float:
    """Time from camera to camera: none in two thirds of the drives."""
    rng = np.random.default_rng([seed, _TURNS])
    return float(rng.uniform(_APART_LOW_S, _APART_HIGH_S)) if rng.random() < _IN_TURN_SHARE else 0.0


def _road(seed: int, poses: PoseErrors) -> RoadShape | None:
    rng = np.random.default_rng([seed, _ROAD])
    if rng.random() > _ROAD_SHARE:
        return None
    roll, pitch = rng.normal(0.0, 0.003, 2)
    return RoadShape(
        slope=_log_uniform(rng, 3e-4, 2e-3),
        slope_over_m=_log_uniform(rng, 20.0, 50.0),
        mount_rad=(float(roll), float(pitch)),
        height_drift_m=1.5 * poses.position_drift_m,
    )


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _pose_errors(rng: np.random.Generator, default_noise: bool) -> PoseErrors:
    """Errors of any size where they are stated, else .3 to 3 times those that are taken without a word."""
    if default_noise:
        usual = PoseNoise()
        totals = [
            total * _log_uniform(rng, 0.3, 3.0)
            for total in (usual.position_m, usual.heading_rad, usual.roll_pitch_rad)
        ]
    else:
        totals = [_log_uniform(rng, *ends) for ends in ((0.006, 0.04), (5e-4, 2.5e-3), (1e-3, 6e-3))]
    position_m, heading_rad, roll_pitch_rad = totals
    position_share, heading_share = rng.uniform(0.2, 0.95, 2)
    return PoseErrors(
        position_white_m=position_m * float(np.sqrt(1 - position_share)),
        position_drift_m=position_m * float(np.sqrt(position_share)),
        position_over_m=_log_uniform(rng, 5.0, 200.0),
        heading_white_rad=heading_rad * float(np.sqrt(1 - heading_share)),
        heading_drift_rad=heading_rad * float(np.sqrt(heading_share)),
        heading_over_m=_log_uniform(rng, 5.0, 200.0),
        roll_pitch_rad=roll_pitch_rad,
        roll_pitch_over_m=_log_uniform(rng, 1.0, 20.0),
        heave_m=_log_uniform(rng, 0.002, 0.01),
        heave_over_m=_log_uniform(rng, 1.0, 20.0),
    )


def _port(rng: np.random.Generator, seed: int, route: str) -> PortConfig:
    name = str(rng.choice(["port1", "port2"]))
    shipped = OmegaConf.load(conf_dir() / "run" / f"{name}.yaml").simulate
    changes = {
        "seed": seed,
        "initial_ipm": str(rng.choice(["calibrated", "estimated"])),
        "route": {"pieces": _pieces(rng, route), "speed_mps": float(rng.uniform(3.0, 8.0))},
    }
    merged = OmegaConf.merge(OmegaConf.structured(PortConfig), shipped, OmegaConf.create(changes))
    port = OmegaConf.to_object(merged)
    assert isinstance(port, PortConfig)
    cameras = {camera: _borrowed(rng, config) for camera, config in port.cameras.items()}
    return replace(port, cameras=cameras)


def _pieces(rng: np.random.Generator, route: str) -> list[list[float]]:
    length_m = float(rng.uniform(40.0, 120.0))
    if route == "straight":
        return [[length_m, 0.0]]
    sharpest_deg = {"bends": (8.0, 35.0), "turning": (50.0, 95.0)}[route]
    pieces = [[float(rng.uniform(8.0, 16.0)), 0.0]]
    left_m = length_m - pieces[0][0]
    while len(pieces) < 2 or left_m > _LEAST_LEFT_M:
        bend_m, turn_deg = float(rng.uniform(14.0, 24.0)), float(rng.uniform(*sharpest_deg))
        straight_m = float(rng.uniform(6.0, 25.0))
        pieces += [[bend_m, turn_deg * float(rng.choice([-1.0, 1.0]))], [straight_m, 0.0]]
        left_m -= bend_m + straight_m
    return pieces


def _borrowed(rng: np.random.Generator, camera: CameraConfig) -> CameraConfig:
    """The camera with another vehicle's, which lends its IPM, decimetres and about a degree elsewhere."""
    mount = camera.mount
    x, y, z = rng.normal(0.0, (0.15, 0.1, 0.1))
    yaw, pitch, roll = rng.normal(0.0, (1.2, 1.0, 0.7))
    borrowed = replace(
        mount,
        x_m=mount.x_m + x,
        y_m=mount.y_m + y,
        z_m=mount.z_m + z,
        yaw_deg=mount.yaw_deg + yaw,
        pitch_deg=mount.pitch_deg + pitch,
        roll_deg=mount.roll_deg + roll,
    )
    return replace(camera, borrowed_mount=borrowed)
