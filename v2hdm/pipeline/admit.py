"""What cannot work is refused before any long work."""

from __future__ import annotations

from dataclasses import replace

import torch

from v2hdm.detection.detector import Detector
from v2hdm.errors import ConfigError
from v2hdm.io.maps import check_formats
from v2hdm.io.safe.texts import shown, take_camera_name, take_name
from v2hdm.mapping.options import INCREMENTAL, check_options
from v2hdm.pipeline.config import RunConfig, run_name
from v2hdm.pipeline.survey import table_of
from v2hdm.settings import COUNT, MOST_PROCESSES, NOT_NEGATIVE, POSITIVE, SEED, SHARE, Within, check_settings

_RANGES = {
    "workers": Within(0, MOST_PROCESSES),
    "cache_gb": NOT_NEGATIVE,
    "drive.max_gap_s": POSITIVE,
    "drive.limit": COUNT,
    "drive.start_s": NOT_NEGATIVE,
    "drive.end_s": POSITIVE,
    **{f"drive.kitti.{name}": POSITIVE for name in ("camera_height_m", "centre_sigma_m", "roi_half_width_m")},
    "simulate.seed": SEED,
    "simulate.visit": NOT_NEGATIVE,
    "simulate.cameras.*.width": Within(64, 2**13),
    "simulate.cameras.*.height": Within(64, 2**13),
    "simulate.cameras.*.focal_px": Within(10, 1e5),
    "simulate.cameras.*.psf_sigma_px": NOT_NEGATIVE,
    "simulate.cameras.*.vignetting": SHARE,
    "simulate.cameras.*.distortion": Within(-2, 2),
    **{f"simulate.cameras.*.{mount}.z_m": Within(0.2, 20) for mount in ("mount", "borrowed_mount")},
    "simulate.route.pieces": Within(-1e5, 1e5),
    "simulate.route.image_spacing_m": Within(0.01, 1e3),
    "simulate.route.pose_rate_hz": Within(0.1, 1e4),
    "simulate.exposure.exposure_s": Within(0, 1),
    "simulate.exposure.level": Within(0, 1, open=True),
    "simulate.exposure.full_well_electrons": POSITIVE,
    **{
        f"simulate.disturbance.{name}": NOT_NEGATIVE
        for name in ("roll_pitch_deg", "heave_m", "rtk_white_m", "rtk_correlated_m", "heading_deg")
    },
    **{
        f"simulate.disturbance.{name}": POSITIVE
        for name in ("jitter_correlation_s", "rtk_correlation_m", "heading_correlation_s")
    },
    **{f"simulate.surface.{name}": SHARE for name in ("albedo", "wet_fraction")},
    **{f"simulate.surface.{name}": Within(0, 1e5) for name in ("patches", "oil_stains")},
    **{
        f"simulate.yard.{name}": Within(0, 1e4)
        for name in ("parked_trucks", "barriers", "lamp_posts", "moving_trucks", "shadow_strips")
    },
    "simulate.yard.haze_m": POSITIVE,
}  # fmt: skip


def admit(config: RunConfig) -> str:
    """Refuse what cannot work before any long work; returns the run's name.

    Raises:
        ConfigError: The message names the key.
        DetectorError: ``detector.model`` cannot be used.
    """
    name = run_name(config)
    take_name(name, "name", ConfigError)
    if config.simulate is not None:
        take_name(config.simulate.name, "simulate.name", ConfigError)
        for camera in config.simulate.cameras:
            take_camera_name(camera, "simulate.cameras", ConfigError)
    check_settings(config, _RANGES)
    # Wherever the detector will run, it can be looked at here.
    detector = Detector.load(options=replace(config.detector, device="cpu"))
    check_options(config.mapping, detector.catalogue.cornered)
    table_of(config.mapping.survey)
    check_formats(config.export, "export")
    if config.mosaic and len(config.drive.paths) > 1:
        raise ConfigError(
            "mosaic=true puts the images of one drive on the ground; map the drives one by one for it"
        )
    if config.map.base is not None and config.mapping.mode == INCREMENTAL:
        raise ConfigError("mode=incremental makes a map of one drive alone; update map.base with mode=batch")
    if len(config.drive.paths) > 1 and config.mapping.mode == INCREMENTAL:
        raise ConfigError(
            "mode=incremental maps one drive as the vehicle would; map several with mode=batch, or one by "
            "one with map.base"
        )
    check_device(config.mapping.device)
    return name


def check_device(device: str) -> None:
    """Refuse a device of torch that is not ``cpu`` or ``cuda``, or not there.

    Raises:
        ConfigError: says which.
    """
    if device not in ("cpu", "cuda"):
        raise ConfigError(f"device is {shown(device)}: choose cpu or cuda")
    if device == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            "device is 'cuda' but torch sees no GPU: check the driver and torch build, or set device=cpu"
        )
