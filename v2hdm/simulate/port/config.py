"""The settings of a rendered port, as plain values that `conf/run/port*.yaml` fills in.

Angles are in degrees here, since people write these values; the renderer works in radians.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from v2hdm.settings import NOT_NEGATIVE, POSITIVE, SEED, SHARE, Within


@dataclass(kw_only=True)
class MountConfig:
    """A camera's mounting on the vehicle: its centre, then yaw (left), pitch (down) and roll."""

    x_m: Annotated[float, "distance ahead of the vehicle's origin."]
    y_m: Annotated[float, "distance to the left of the origin."]
    z_m: Annotated[float, Within(0.2, 20), "height above the ground."]
    yaw_deg: Annotated[float, "yaw of the viewing direction, to the left."]
    pitch_deg: Annotated[float, "pitch of the viewing direction, downwards."]
    roll_deg: Annotated[float, "roll about the viewing direction."] = 0.0


@dataclass(kw_only=True)
class CameraConfig:
    """A camera: its lens, its mount, and its mount on the other vehicle, which lends its IPM."""

    mount: MountConfig
    borrowed_mount: MountConfig
    width: Annotated[int, Within(64, 2**13), "image width, px."] = 1280
    height: Annotated[int, Within(64, 2**13), "image height, px."] = 720
    focal_px: Annotated[float, Within(10, 1e5), "focal length."] = 900.0
    principal_offset_px: Annotated[
        list[float], "offset of the principal point from the image centre, right and down."
    ] = field(default_factory=lambda: [6.0, -4.0])
    distortion: Annotated[list[float], Within(-2, 2), "plumb_bob coefficients k1 k2 p1 p2 k3."] = field(
        default_factory=lambda: [-0.11, 0.035, 0.0004, -0.0003, 0.0]
    )
    psf_sigma_px: Annotated[float, NOT_NEGATIVE, "blur of the lens, standard deviation."] = 0.65
    vignetting: Annotated[float, SHARE, "loss of light in the corners, as a fraction."] = 0.22


@dataclass(kw_only=True)
class CalibrationConfig:
    """The manual calibration: ground points surveyed and clicked in an image, and a survey of the camera."""

    points_ahead_m: Annotated[
        list[list[float]],
        "the points' distances ahead and offsets to the left, in m from the camera."
    ] = field(
        default_factory=lambda: [
            [4.0, 2.2], [4.0, -2.2], [5.2, 0.0], [7.0, 4.0], [7.0, -4.0],
            [9.5, 1.5], [9.5, -1.5], [13.0, 4.2], [13.0, -4.2], [13.0, 0.0],
        ]
    )  # fmt: skip
    survey_sigma_m: Annotated[float, NOT_NEGATIVE, "standard deviation of a surveyed point."] = 0.01
    click_sigma_px: Annotated[float, NOT_NEGATIVE, "standard deviation of a click."] = 0.5
    centre_sigma_m: Annotated[
        float, NOT_NEGATIVE, "standard deviation of the surveyed camera centre, per axis."
    ] = 0.02


@dataclass(kw_only=True)
class DisturbanceConfig:
    """Errors of the recorded poses; standard deviations per axis.

    Roll and pitch jitter have a white and a correlated part of equal power; so has the heading error. The RTK
    position error has a white part and one that is correlated over ``rtk_correlation_m`` of driving.
    """

    roll_pitch_deg: Annotated[float, NOT_NEGATIVE, "standard deviation of the body's roll and pitch."] = 0.11
    heave_m: Annotated[float, NOT_NEGATIVE, "standard deviation of the body's height."] = 0.005
    jitter_correlation_s: Annotated[float, POSITIVE, "correlation time of attitude and height."] = 0.25
    rtk_white_m: Annotated[float, NOT_NEGATIVE, "white position error."] = 0.006
    rtk_correlated_m: Annotated[float, NOT_NEGATIVE, "correlated position error."] = 0.010
    rtk_correlation_m: Annotated[
        float,
        POSITIVE,
        "distance driven over which the correlated position error fades, m.",
    ] = 30.0
    heading_deg: Annotated[float, NOT_NEGATIVE, "error of the recorded heading."] = 0.065
    heading_correlation_s: Annotated[float, POSITIVE, "correlation time of the heading error."] = 1.0


@dataclass(kw_only=True)
class RouteConfig:
    """The route that is driven."""

    pieces: Annotated[
        list[list[float]], Within(-1e5, 1e5),
        "[length in m, turn to the left in degrees] of each piece."
    ] = field(
        default_factory=lambda: [
            [95.0, 0.0], [24.0, 90.0], [60.0, 0.0], [24.0, 90.0], [75.0, 0.0], [24.0, -90.0], [58.0, 0.0],
        ]
    )  # fmt: skip
    speed_mps: Annotated[float, Within(0.01, 1e3), "mean speed, m/s."] = 5.0
    image_spacing_m: Annotated[float, Within(0.01, 1e3), "distance driven between two images."] = 0.9
    pose_rate_hz: Annotated[float, Within(0.1, 1e4), "recorded poses per second."] = 10.0


@dataclass(kw_only=True)
class StencilConfig:
    """Paint of a user's own class, in rows along the route."""

    shapes_m: Annotated[
        list[list[list[float]]], "the convex polygons that make it up, as points [ahead, left] in m."
    ]
    spacing_m: Annotated[
        float, "distance between two stencils along the route, m; none is painted where there is no room."
    ] = 10.0
    offsets_m: Annotated[list[float], "offsets of the rows of stencils to the left of the route, m."] = field(
        default_factory=lambda: [-3.4, 3.4]
    )


@dataclass(kw_only=True)
class SignsConfig:
    """Words, bay numbers, hatched areas, crosswalks and double lines, where the ground is free of all else.

    They are painted after all other paint, which stays where it is. The truth has them as symbols and lanes.
    """

    words: Annotated[list[str], "words, each painted once: capital letters, digits and -."] = field(
        default_factory=list
    )
    numbers: Annotated[int, Within(0, 1000), "number of bay numbers, counting up."] = 0
    first_number: Annotated[int, Within(0, 100_000), "the first bay number."] = 101
    word_height_m: Annotated[float, Within(0.2, 5), "height of the letters of words."] = 1.5
    number_height_m: Annotated[float, Within(0.2, 5), "height of the digits of bay numbers."] = 0.9
    hatched: Annotated[int, Within(0, 1000), "number of hatched areas."] = 0
    crosswalks: Annotated[int, Within(0, 1000), "number of crosswalks."] = 0
    double_lines: Annotated[
        int,
        Within(0, 1000),
        "number of stretches of 15 to 25 m along which a second line runs beside a lane line.",
    ] = 0


@dataclass(kw_only=True)
class PaintConfig:
    """The markings: diamonds in rows beside and on the route, lane lines, arrows, stop lines, lettering.

    Offsets are to the left of the route. Spacings closer than their ranges would never be finished.
    """

    diamond_length_m: Annotated[float, POSITIVE, "diagonal along the route."] = 1.2
    diamond_width_m: Annotated[float, POSITIVE, "diagonal across the route."] = 0.6
    diamond_spacing_m: Annotated[float, Within(0.1), "distance between diamonds along the route."] = 5.0
    diamond_offsets_m: Annotated[list[float], "offsets of the rows of diamonds."] = field(
        default_factory=lambda: [-3.4, 0.0, 3.4]
    )
    field_offsets_m: Annotated[list[float], "rows of diamonds farther out, only on straights."] = field(
        default_factory=lambda: [-11.0, -7.4, 7.4, 11.0]
    )
    placing_sigma_m: Annotated[
        float, NOT_NEGATIVE, "standard deviation of a marking's position from its nominal one."
    ] = 0.08
    placing_sigma_deg: Annotated[float, NOT_NEGATIVE, "standard deviation of a marking's direction."] = 1.5
    solid_offsets_m: Annotated[list[float], "offsets of solid lines."] = field(
        default_factory=lambda: [1.8, -5.3, 5.3]
    )
    dashed_offsets_m: Annotated[list[float], "offsets of dashed lines."] = field(
        default_factory=lambda: [-1.8]
    )
    line_width_m: Annotated[float, POSITIVE, "width of lane lines."] = 0.15
    dash_length_m: Annotated[float, Within(0.1), "length of dashes."] = 3.0
    dash_gap_m: Annotated[float, NOT_NEGATIVE, "gap between two dashes."] = 3.0
    arrow_spacing_m: Annotated[float, Within(0.1), "distance between two arrows."] = 47.0
    stop_line_spacing_m: Annotated[float, Within(0.1), "distance between two stop lines."] = 83.0
    lettering_spacing_m: Annotated[float, Within(0.1), "distance between two words."] = 31.0
    wear: Annotated[float, SHARE, "mean share of a marking's paint that is worn off."] = 0.14
    dirt: Annotated[float, SHARE, "mean strength of dirt on markings, 0 to 1."] = 0.2
    yellow_diamonds: Annotated[bool, "whether diamonds are yellow instead of white."] = False
    stencils: Annotated[dict[str, StencilConfig], "paint of users' own classes, by name."] = field(
        default_factory=dict
    )
    signs: SignsConfig = field(default_factory=SignsConfig)


@dataclass(kw_only=True)
class SurfaceConfig:
    """The ground; see :class:`v2hdm.simulate.render.scene.Ground`."""

    texture: Annotated[str, "concrete or asphalt."] = "concrete"
    albedo: Annotated[float, SHARE, "mean reflectance."] = 0.3
    contrast: Annotated[float, NOT_NEGATIVE, "contrast of the texture, as a fraction of the albedo."] = 0.11
    stains: Annotated[float, NOT_NEGATIVE, "strength of large stains, as a fraction of the albedo."] = 0.13
    slab_m: Annotated[list[float], "length and width of concrete slabs; 0 for no joints."] = field(
        default_factory=lambda: [5.0, 4.5]
    )
    joint_width_m: Annotated[float, NOT_NEGATIVE, "width of the joints between slabs."] = 0.015
    wet_fraction: Annotated[float, SHARE, "fraction of the ground that is wet."] = 0.05
    tyre_marks: Annotated[float, NOT_NEGATIVE, "darkness of the tyre marks on the lanes."] = 0.5
    patches: Annotated[int, Within(0, 1e5), "number of repaired patches."] = 25
    oil_stains: Annotated[int, Within(0, 1e5), "number of oil stains."] = 160


@dataclass(kw_only=True)
class ReliefConfig:
    """Heights of the ground, a plane by default. Slopes are metres up per metre.

    Steeper than their ranges, a vehicle would slide; a higher kerb is a wall.
    """

    grade: Annotated[float, Within(0, 0.15), "slope along the map's x axis, in which the route begins."] = 0.0
    crown: Annotated[float, Within(0, 0.15), "downward slope on both sides of the route, for 10 m."] = 0.0
    ramp: Annotated[
        float, Within(0, 0.15), "upward slope along the route, from ramp_at_m for ramp_length_m."
    ] = 0.0
    bank: Annotated[float, Within(0, 0.15), "upward slope to the left of the route on the ramp."] = 0.0
    ramp_at_m: Annotated[float, NOT_NEGATIVE, "distance along the route at which the ramp begins."] = 0.0
    ramp_length_m: Annotated[
        float, Within(1), "length of the ramp; its slopes ease in and out over 12 m."
    ] = 25.0
    gully_m: Annotated[float, Within(0, 0.3), "depth of the gullies on both sides of the route."] = 0.0
    gully_offset_m: Annotated[float, Within(1, 15), "distance of the gullies from the route."] = 4.5
    kerb_m: Annotated[
        float, Within(0, 0.3), "height of a kerb to the left of the route and of the ground beyond it."
    ] = 0.0
    kerb_offset_m: Annotated[float, Within(1, 15), "distance of the kerb from the route."] = 6.0


@dataclass(kw_only=True)
class YardConfig:
    """Objects that stand and drive in the port, and the light."""

    stack_fill: Annotated[
        float, NOT_NEGATIVE, "share of the places beside the route that hold container stacks."
    ] = 0.55
    stack_clearance_m: Annotated[float, NOT_NEGATIVE, "distance of container stacks from the route."] = 8.5
    parked_trucks: Annotated[int, Within(0, 1e4), "number of parked trucks, closer than the stacks."] = 7
    barriers: Annotated[int, Within(0, 1e4), "number of barriers, closer than the stacks."] = 12
    lamp_posts: Annotated[int, Within(0, 1e4), "number of lamp posts."] = 14
    moving_trucks: Annotated[int, Within(0, 1e4), "number of oncoming trucks."] = 4
    moving_offset_m: Annotated[float, "distance of oncoming trucks to the left of the route."] = 4.6
    shadow_strips: Annotated[int, Within(0, 1e4), "number of shadows of cranes and beams."] = 16
    sun_azimuth_deg: Annotated[float, "direction of the sun, to the left of the map's x axis."] = 120.0
    sun_elevation_deg: Annotated[float, "elevation of the sun above the horizon."] = 42.0
    sun_strength: Annotated[float, NOT_NEGATIVE, "factor on the strength of direct sunlight."] = 1.0
    haze_m: Annotated[float, POSITIVE, "distance at which haze removes most of the contrast."] = 400.0


@dataclass(kw_only=True)
class ExposureConfig:
    """The shutter and the sensor."""

    exposure_s: Annotated[float, Within(0, 1), "time that the shutter is open."] = 0.002
    level: Annotated[
        float, Within(0, 1, open=True), "mean brightness of the images, as a fraction of full brightness."
    ] = 0.25
    level_sigma: Annotated[
        float, NOT_NEGATIVE, "standard deviation of the brightness from image to image."
    ] = 0.08
    full_well_electrons: Annotated[
        float, POSITIVE, "electrons in a pixel at full brightness; fewer mean more noise."
    ] = 9000.0
    read_noise: Annotated[
        float, NOT_NEGATIVE, "standard deviation of read noise, as a fraction of full brightness."
    ] = 0.0015
    jpeg_quality: Annotated[int, "JPEG quality of the images, 50 to 100."] = 95


def _front() -> CameraConfig:
    return CameraConfig(
        mount=MountConfig(x_m=3.60, y_m=0.05, z_m=2.45, yaw_deg=0.6, pitch_deg=16.0, roll_deg=0.3),
        borrowed_mount=MountConfig(
            x_m=3.42, y_m=-0.07, z_m=2.58, yaw_deg=-0.7, pitch_deg=17.1, roll_deg=-0.6
        ),
    )


def _rear() -> CameraConfig:
    return CameraConfig(
        mount=MountConfig(x_m=-1.10, y_m=-0.04, z_m=2.60, yaw_deg=179.5, pitch_deg=17.5, roll_deg=-0.4),
        borrowed_mount=MountConfig(
            x_m=-0.92, y_m=0.10, z_m=2.47, yaw_deg=180.9, pitch_deg=16.3, roll_deg=0.7
        ),
    )


@dataclass(kw_only=True)
class SurveyConfig:
    """A network of streets and yards in place of a port, as detections in place of pictures."""

    length_km: Annotated[
        float,
        Within(0, 1000),
        "driven length of a network of streets and yards with detections in place of pictures; 0 renders "
        "pictures along route.pieces.",
    ] = 0.0
    drives: Annotated[
        int, Within(1, 100), "number of drives through the network, by turns there and back."
    ] = 2
    correlation: Annotated[
        float,
        Within(0, 0.9),
        "correlation of a corner's errors on the ground between images, as of the detector's on port 2 by "
        "default; 0 draws those of every image apart.",
    ] = 0.32


@dataclass(kw_only=True)
class PortConfig:
    """A port, a vehicle with its cameras, and one drive through it.

    Equal values give equal files, byte for byte.
    """

    name: Annotated[str, "name of the port and its drive."] = "port1"
    seed: Annotated[int, SEED, "seed of all random draws."] = 1
    session: Annotated[
        int,
        NOT_NEGATIVE,
        "number of the drive through this port: the same paint, other pose noise, image noise and traffic.",
    ] = 0
    initial_ipm: Annotated[
        str,
        "the calibration that the drive starts from: calibrated (this vehicle's own, manual) or estimated "
        "(the other vehicle's).",
    ] = "calibrated"
    cameras: Annotated[
        dict[str, CameraConfig],
        "cameras by name: lens, mount, and mount on the other vehicle, which lends its IPM.",
    ] = field(default_factory=lambda: {"front": _front(), "rear": _rear()})
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    disturbance: DisturbanceConfig = field(default_factory=DisturbanceConfig)
    route: RouteConfig = field(default_factory=RouteConfig)
    paint: PaintConfig = field(default_factory=PaintConfig)
    surface: SurfaceConfig = field(default_factory=SurfaceConfig)
    relief: ReliefConfig = field(default_factory=ReliefConfig)
    yard: YardConfig = field(default_factory=YardConfig)
    exposure: ExposureConfig = field(default_factory=ExposureConfig)
    survey: SurveyConfig = field(default_factory=SurveyConfig)
