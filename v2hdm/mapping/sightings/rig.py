"""Cameras and frames as the mapping believes them to be."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import CameraInfo, FloatArray


@dataclass(frozen=True)
class Rig:
    """Cameras and frames as the mapping currently believes them to be.

    ``intrinsic`` (C, 3, 3), ``cam_from_vehicle`` (C, 4, 4), ``map_from_vehicle`` (F, 4, 4).
    """

    intrinsic: FloatArray
    cam_from_vehicle: FloatArray
    map_from_vehicle: FloatArray

    @property
    def height_m(self) -> FloatArray:
        """Heights (C,) of the camera centres above the ground of the vehicle."""
        return np.asarray(np.maximum(camera_centre(self.cam_from_vehicle)[:, 2], 0.1))


def build_rig(
    infos: Mapping[str, CameraInfo], cam_from_vehicle: Mapping[str, FloatArray], map_from_vehicle: FloatArray
) -> Rig:
    """Stack cameras in the order of ``infos`` with the frames' poses (F, 4, 4)."""
    return Rig(
        intrinsic=np.stack([info.intrinsic for info in infos.values()]),
        cam_from_vehicle=np.stack([cam_from_vehicle[name] for name in infos]),
        map_from_vehicle=map_from_vehicle,
    )
