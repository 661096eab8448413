"""What a user may choose about reading a drive."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(kw_only=True)
class KittiOptions:
    """What the KITTI raw format does not say about a drive.

    Attributes:
        camera_height_m: height of the camera above the road (KITTI's nominal 1.65 m).
        centre_sigma_m: how well the published calibration places the camera, per axis.
        roi_near_m: where the trusted ground begins, ahead of the camera.
        roi_far_m: where it ends.
        roi_half_width_m: how far it extends to either side of the camera.
    """

    camera_height_m: float = 1.65
    centre_sigma_m: float = 0.05
    roi_near_m: float = 5.0
    roi_far_m: float = 20.0
    roi_half_width_m: float = 6.0


@dataclass(kw_only=True)
class ReadOptions:
    """How to read a drive.

    Attributes:
        format: name of a reader (see ``v2hdm.io.drive.READERS``), or ``auto`` to look at the folder.
        cameras: names of the cameras to read; empty for all.
        max_gap_s: poses further apart than this are not interpolated across; images that fall into
            such a gap are dropped.
        limit: images of each camera to take at most, the first ones, for trying things; None takes all.
        start_s: seconds of the drive to leave out at its beginning, by the stamps of its images.
        end_s: seconds after its first image at which the drive ends; None for its own end.
        cache: folder that keeps what is imported from bags and videos.
        kitti: only used by the ``kitti`` reader.
    """

    format: str = "auto"
    cameras: list[str] = field(default_factory=list)
    max_gap_s: float = 0.5
    limit: int | None = None
    start_s: float = 0.0
    end_s: float | None = None
    cache: str = "cache"
    kitti: KittiOptions = field(default_factory=KittiOptions)
