"""Everything that makes up a rendered port, as plain values: what `conf/run/port*.yaml` fills in.

Angles are in degrees here, since people write these values; the code below works in radians.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(kw_only=True)
class MountConfig:
    """Where a camera sits on the vehicle: its centre, then yaw (left), pitch (down) and roll.

    Attributes:
        x_m: ahead of the vehicle's origin.
        y_m: to its left.
        z_m: above the ground.
        yaw_deg: viewing direction, to the left.
        pitch_deg: downwards.
        roll_deg: about the viewing direction.
    """

    x_m: float
    y_m: float
    z_m: float
    yaw_deg: float
    pitch_deg: float
    roll_deg: float = 0.0


@dataclass(kw_only=True)
class CameraConfig:
    """One camera: lens, mount, and the mount of the same camera on the other vehicle, which lends its IPM.

    ``distortion`` are plumb_bob coefficients k1 k2 p1 p2 k3.

    Attributes:
        width: of an image, px.
        height: of an image, px.
        focal_px: focal length.
        principal_offset_px: of the principal point from the image's centre, right and down.
        psf_sigma_px: blur of the lens, standard deviation.
        vignetting: loss of light in the corners, as a share.
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

    ``points_ahead_m`` are distance along the viewing direction and offset to the left, in m from the camera.

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
    """Differences of the recorded poses from the true ones; standard deviations per axis.

    Roll and pitch jitter have a white and a correlated part of equal power; so has the heading error. RTK's
    position error has a white part and one that is correlated over ``rtk_correlation_m`` of driving.

    Attributes:
        roll_pitch_deg: of the body's attitude.
        heave_m: of the body's height.
        jitter_correlation_s: time over which attitude and height are correlated.
        rtk_white_m: of a position, independent at each time.
        rtk_correlated_m: of a position, common to a stretch of road.
        heading_deg: of the recorded heading.
        heading_correlation_s: time over which the heading's error is correlated.
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
    """The way: pieces of [length in m, turn to the left in degrees], driven at about ``speed_mps``.

    Attributes:
        pieces: [length in m, turn to the left in degrees] of each.
        image_spacing_m: distance driven between two images.
        pose_rate_hz: recorded poses a second.
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

    ``shapes_m`` are the convex polygons that make it up, as points [ahead, left] in m. One of four points is
    a marking of the true map. A stencil is painted every ``spacing_m`` at each of ``offsets_m``, to the left
    of the route, where there is room.
    """

    shapes_m: list[list[list[float]]]
    spacing_m: float = 10.0
    offsets_m: list[float] = field(default_factory=lambda: [-3.4, 3.4])


@dataclass(kw_only=True)
class PaintConfig:
    """The markings: diamonds in rows beside and on the route, lane lines, arrows, stop lines, lettering.

    Offsets are to the left of the route, in m; ``field_offsets_m`` are rows further out, on straights
    only. ``wear`` and ``dirt`` are the means of what varies from marking to marking. ``stencils`` are paint
    of users' own classes, by their names.

    Attributes:
        diamond_length_m: diagonal along the route.
        diamond_width_m: diagonal across it.
        diamond_spacing_m: along the route.
        diamond_offsets_m: of the rows of diamonds.
        placing_sigma_m: how far a marking is off its place.
        placing_sigma_deg: how far it is turned.
        solid_offsets_m: of solid lines.
        dashed_offsets_m: of dashed lines.
        line_width_m: of lane lines.
        dash_length_m: of dashes.
        dash_gap_m: between two dashes.
        arrow_spacing_m: between two arrows.
        stop_line_spacing_m: between two stop lines.
        lettering_spacing_m: between two words.
        yellow_diamonds: whether diamonds are yellow, not white.
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
    """The ground; see :class:`v2hdm.simulate.render.scene.Ground`. Lengths of 0 for ``slab_m``: no joints.

    Attributes:
        texture: concrete or asphalt.
        albedo: mean reflectance.
        contrast: of the texture, as a share of the albedo.
        stains: strength of large stains, as a share of the albedo.
        joint_width_m: of the joints between slabs.
        wet_fraction: share of the ground that is wet.
        tyre_marks: how dark the lanes are driven.
        patches: number of repaired places.
        oil_stains: number of them.
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
    """Heights of the ground, which is a plane where none is given. Slopes are metres up per metre.

    Attributes:
        grade: slope along the map's x axis, in which the route begins.
        crown: slope down to both sides of the route, for 10 m.
        ramp: slope up in the route's direction between ``ramp_at_m`` and ``ramp_length_m`` later.
        bank: slope up to the left of the route there.
        ramp_at_m: way along the route where the ramp begins.
        ramp_length_m: of the ramp; its slopes ease in and out over 12 m.
        gully_m: depth of gullies along the route, on both sides.
        gully_offset_m: of the gullies from the route.
        kerb_m: height of a kerb to the left of the route, beyond which the ground is as high.
        kerb_offset_m: of the kerb from the route.
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
    """Things that stand and drive in the port, and the light.

    ``stack_fill`` is the fraction of the places beside the route with container stacks; parked trucks
    and barriers stand closer; moving trucks come the other way. Strips are shadows of cranes and beams.

    Attributes:
        stack_clearance_m: of container stacks from the route.
        parked_trucks: number of them.
        barriers: number of them.
        lamp_posts: number of them.
        moving_trucks: number of them.
        moving_offset_m: of oncoming trucks, to the left of the route.
        shadow_strips: number of them.
        sun_azimuth_deg: direction of the sun, to the left of the map's x axis.
        sun_elevation_deg: of the sun above the horizon.
        sun_strength: of the direct light against that of the sky.
        haze_m: distance at which haze takes most of the contrast.
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
    """The shutter and the sensor: the exposure aims at a mean of ``level``, varying by ``level_sigma``.

    Attributes:
        exposure_s: time that the shutter is open.
        full_well_electrons: that a pixel of full brightness holds; fewer are noisier.
        read_noise: standard deviation, as a share of full brightness.
        jpeg_quality: of the files, 50 to 100.
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

    ``initial_ipm`` is ``calibrated`` when the drive starts from this vehicle's own manual calibration,
    ``estimated`` when it starts from the other vehicle's. ``visit`` numbers drives through one port: the same
    paint, other noise of poses and images, other traffic. Equal values give equal files, byte for byte.

    Attributes:
        name: of the port and its drive.
        seed: of everything that is drawn at random.
    """

    name: str = "port1"
    seed: int = 1
    visit: int = 0
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
