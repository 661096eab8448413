"""The settings of a rendered port, as plain values that `conf/run/port*.yaml` fills in.

Angles are in degrees here, since people write these values; the renderer works in radians.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(kw_only=True)
class MountConfig:
    """A camera's mounting on the vehicle: its centre, then yaw (left), pitch (down) and roll.

    Attributes:
        x_m: distance ahead of the vehicle's origin.
        y_m: distance to the left of the origin.
        z_m: height above the ground.
        yaw_deg: yaw of the viewing direction, to the left.
        pitch_deg: pitch of the viewing direction, downwards.
        roll_deg: roll about the viewing direction.
    """

    x_m: float
    y_m: float
    z_m: float
    yaw_deg: float
    pitch_deg: float
    roll_deg: float = 0.0


@dataclass(kw_only=True)
class CameraConfig:
    """A camera: its lens, its mount, and its mount on the other vehicle, which lends its IPM.

    ``distortion`` are plumb_bob coefficients k1 k2 p1 p2 k3.

    Attributes:
        width: image width, px.
        height: image height, px.
        focal_px: focal length.
        principal_offset_px: offset of the principal point from the image centre, right and down.
        psf_sigma_px: blur of the lens, standard deviation.
        vignetting: loss of light in the corners, as a fraction.
    """

    mount: MountConfig
    borrowed_mount: MountConfig
    width: int = 1280
    height: int = 720
    focal_px: float = 900.0
    principal_offset_px: list[float] = field(default_factory=lambda: [6.0, -4.0])
    distortion: list[float] = field(default_factory=lambda: [-0.11, 0.035, 0.0004, -0.0003, 0.0])
    psf_sigma_px: float = 0.65
    vignetting: float = 0.22


@dataclass(kw_only=True)
class CalibrationConfig:
    """The manual calibration: ground points surveyed and clicked in an image, and a survey of the camera.

    ``points_ahead_m`` are the points' distances ahead and offsets to the left, in m from the camera.

    Attributes:
        survey_sigma_m: standard deviation of a surveyed point.
        click_sigma_px: standard deviation of a click.
        centre_sigma_m: standard deviation of the surveyed camera centre, per axis.
    """

    points_ahead_m: list[list[float]] = field(
        default_factory=lambda: [
            [4.0, 2.2], [4.0, -2.2], [5.2, 0.0], [7.0, 4.0], [7.0, -4.0],
            [9.5, 1.5], [9.5, -1.5], [13.0, 4.2], [13.0, -4.2], [13.0, 0.0],
        ]
    )  # fmt: skip
    survey_sigma_m: float = 0.01
    click_sigma_px: float = 0.5
    centre_sigma_m: float = 0.02


@dataclass(kw_only=True)
class DisturbanceConfig:
    """Errors of the recorded poses; standard deviations per axis.

    Roll and pitch jitter have a white and a correlated part of equal power; so has the heading error. The RTK
    position error has a white part and one that is correlated over ``rtk_correlation_m`` of driving.

    Attributes:
        roll_pitch_deg: standard deviation of the body's roll and pitch.
        heave_m: standard deviation of the body's height.
        jitter_correlation_s: correlation time of attitude and height.
        rtk_white_m: white position error.
        rtk_correlated_m: correlated position error.
        heading_deg: error of the recorded heading.
        heading_correlation_s: correlation time of the heading error.
    """

    roll_pitch_deg: float = 0.11
    heave_m: float = 0.005
    jitter_correlation_s: float = 0.25
    rtk_white_m: float = 0.006
    rtk_correlated_m: float = 0.010
    rtk_correlation_m: float = 30.0
    heading_deg: float = 0.065
    heading_correlation_s: float = 1.0


@dataclass(kw_only=True)
class RouteConfig:
    """The route, made up of ``pieces`` and driven at about ``speed_mps``.

    Attributes:
        pieces: [length in m, turn to the left in degrees] of each piece.
        image_spacing_m: distance driven between two images.
        pose_rate_hz: recorded poses per second.
    """

    pieces: list[list[float]] = field(
        default_factory=lambda: [
            [95.0, 0.0], [24.0, 90.0], [60.0, 0.0], [24.0, 90.0], [75.0, 0.0], [24.0, -90.0], [58.0, 0.0],
        ]
    )  # fmt: skip
    speed_mps: float = 5.0
    image_spacing_m: float = 0.9
    pose_rate_hz: float = 10.0


@dataclass(kw_only=True)
class StencilConfig:
    """Paint of a user's own class, in rows along the route.

    ``shapes_m`` are the convex polygons that make it up, as points [ahead, left] in m. Those with four points
    are markings of the true map. A stencil is painted every ``spacing_m`` along each of ``offsets_m`` to the
    left of the route, where there is room.
    """

    shapes_m: list[list[list[float]]]
    spacing_m: float = 10.0
    offsets_m: list[float] = field(default_factory=lambda: [-3.4, 3.4])


@dataclass(kw_only=True)
class PaintConfig:
    """The markings: diamonds in rows beside and on the route, lane lines, arrows, stop lines, lettering.

    Offsets are to the left of the route, in m; ``field_offsets_m`` are rows of diamonds farther out, only on
    straights. ``wear`` and ``dirt`` are mean values, which vary from marking to marking. ``stencils`` are
    paint of users' own classes, by name.

    Attributes:
        diamond_length_m: diagonal along the route.
        diamond_width_m: diagonal across the route.
        diamond_spacing_m: distance between diamonds along the route.
        diamond_offsets_m: offsets of the rows of diamonds.
        placing_sigma_m: standard deviation of a marking's position from its nominal one.
        placing_sigma_deg: standard deviation of a marking's direction.
        solid_offsets_m: offsets of solid lines.
        dashed_offsets_m: offsets of dashed lines.
        line_width_m: width of lane lines.
        dash_length_m: length of dashes.
        dash_gap_m: gap between two dashes.
        arrow_spacing_m: distance between two arrows.
        stop_line_spacing_m: distance between two stop lines.
        lettering_spacing_m: distance between two words.
        yellow_diamonds: whether diamonds are yellow instead of white.
    """

    diamond_length_m: float = 1.2
    diamond_width_m: float = 0.6
    diamond_spacing_m: float = 5.0
    diamond_offsets_m: list[float] = field(default_factory=lambda: [-3.4, 0.0, 3.4])
    field_offsets_m: list[float] = field(default_factory=lambda: [-11.0, -7.4, 7.4, 11.0])
    placing_sigma_m: float = 0.08
    placing_sigma_deg: float = 1.5
    solid_offsets_m: list[float] = field(default_factory=lambda: [1.8, -5.3, 5.3])
    dashed_offsets_m: list[float] = field(default_factory=lambda: [-1.8])
    line_width_m: float = 0.15
    dash_length_m: float = 3.0
    dash_gap_m: float = 3.0
    arrow_spacing_m: float = 47.0
    stop_line_spacing_m: float = 83.0
    lettering_spacing_m: float = 31.0
    wear: float = 0.14
    dirt: float = 0.2
    yellow_diamonds: bool = False
    stencils: dict[str, StencilConfig] = field(default_factory=dict)


@dataclass(kw_only=True)
class SurfaceConfig:
    """The ground; see :class:`v2hdm.simulate.render.scene.Ground`.

    Attributes:
        slab_m: length and width of concrete slabs; 0 for no joints.
        texture: concrete or asphalt.
        albedo: mean reflectance.
        contrast: contrast of the texture, as a fraction of the albedo.
        stains: strength of large stains, as a fraction of the albedo.
        joint_width_m: width of the joints between slabs.
        wet_fraction: fraction of the ground that is wet.
        tyre_marks: darkness of the tyre marks on the lanes.
        patches: number of repaired patches.
        oil_stains: number of oil stains.
    """

    texture: str = "concrete"
    albedo: float = 0.3
    contrast: float = 0.11
    stains: float = 0.13
    slab_m: list[float] = field(default_factory=lambda: [5.0, 4.5])
    joint_width_m: float = 0.015
    wet_fraction: float = 0.05
    tyre_marks: float = 0.5
    patches: int = 25
    oil_stains: int = 160


@dataclass(kw_only=True)
class ReliefConfig:
    """Heights of the ground, a plane by default. Slopes are metres up per metre.

    Attributes:
        grade: slope along the map's x axis, in which the route begins.
        crown: downward slope on both sides of the route, for 10 m.
        ramp: upward slope along the route, from ``ramp_at_m`` for ``ramp_length_m``.
        bank: upward slope to the left of the route on the ramp.
        ramp_at_m: distance along the route at which the ramp begins.
        ramp_length_m: length of the ramp; its slopes ease in and out over 12 m.
        gully_m: depth of the gullies on both sides of the route.
        gully_offset_m: distance of the gullies from the route.
        kerb_m: height of a kerb to the left of the route and of the ground beyond it.
        kerb_offset_m: distance of the kerb from the route.
    """

    grade: float = 0.0
    crown: float = 0.0
    ramp: float = 0.0
    bank: float = 0.0
    ramp_at_m: float = 0.0
    ramp_length_m: float = 25.0
    gully_m: float = 0.0
    gully_offset_m: float = 4.5
    kerb_m: float = 0.0
    kerb_offset_m: float = 6.0


@dataclass(kw_only=True)
class YardConfig:
    """Objects that stand and drive in the port, and the light.

    ``stack_fill`` is the fraction of the places beside the route that hold container stacks.

    Attributes:
        stack_clearance_m: distance of container stacks from the route.
        parked_trucks: number of parked trucks, closer than the stacks.
        barriers: number of barriers, closer than the stacks.
        lamp_posts: number of lamp posts.
        moving_trucks: number of oncoming trucks.
        moving_offset_m: distance of oncoming trucks to the left of the route.
        shadow_strips: number of shadows of cranes and beams.
        sun_azimuth_deg: direction of the sun, to the left of the map's x axis.
        sun_elevation_deg: elevation of the sun above the horizon.
        sun_strength: factor on the strength of direct sunlight.
        haze_m: distance at which haze removes most of the contrast.
    """

    stack_fill: float = 0.55
    stack_clearance_m: float = 8.5
    parked_trucks: int = 7
    barriers: int = 12
    lamp_posts: int = 14
    moving_trucks: int = 4
    moving_offset_m: float = 4.6
    shadow_strips: int = 16
    sun_azimuth_deg: float = 120.0
    sun_elevation_deg: float = 42.0
    sun_strength: float = 1.0
    haze_m: float = 400.0


@dataclass(kw_only=True)
class ExposureConfig:
    """The shutter and the sensor, which aims at a mean brightness of ``level``, varying by ``level_sigma``.

    Attributes:
        exposure_s: time that the shutter is open.
        full_well_electrons: electrons in a pixel at full brightness; fewer mean more noise.
        read_noise: standard deviation of read noise, as a fraction of full brightness.
        jpeg_quality: JPEG quality of the images, 50 to 100.
    """

    exposure_s: float = 0.002
    level: float = 0.25
    level_sigma: float = 0.08
    full_well_electrons: float = 9000.0
    read_noise: float = 0.0015
    jpeg_quality: int = 95


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
class PortConfig:
    """A port, a vehicle with its cameras, and one drive through it.

    ``initial_ipm`` is the calibration that the drive starts from: calibrated (this vehicle's own, manual) or
    estimated (the other vehicle's). ``session`` numbers drives through one port: the same paint with other
    pose noise, image noise and traffic. Equal values give equal files, byte for byte.

    Attributes:
        name: name of the port and its drive.
        seed: seed of all random draws.
    """

    name: str = "port1"
    seed: int = 1
    session: int = 0
    initial_ipm: str = "calibrated"
    cameras: dict[str, CameraConfig] = field(default_factory=lambda: {"front": _front(), "rear": _rear()})
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    disturbance: DisturbanceConfig = field(default_factory=DisturbanceConfig)
    route: RouteConfig = field(default_factory=RouteConfig)
    paint: PaintConfig = field(default_factory=PaintConfig)
    surface: SurfaceConfig = field(default_factory=SurfaceConfig)
    relief: ReliefConfig = field(default_factory=ReliefConfig)
    yard: YardConfig = field(default_factory=YardConfig)
    exposure: ExposureConfig = field(default_factory=ExposureConfig)
