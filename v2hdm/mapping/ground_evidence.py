"""The mountings by the markings of a solve alone, compared with the ground that the solve has taken in."""

from __future__ import annotations

import numpy as np

from v2hdm.geometry.ground_plane import by_tangent, plane_in
from v2hdm.mapping.bundle import Bundle
from v2hdm.mapping.results import OffGround
from v2hdm.records import GroundPlane

_LEAST_TOLD = 0.02  # least information of the markings on a direction, over that of the ground, to compare


def off_ground(bundle: Bundle) -> dict[str, OffGround]:
    """Each camera's mounting from markings alone, minus that from its ground, where there is one.

    Ground and survey are taken out of the solution: in units of the ground's sigmas, its inverse covariance
    is that of the markings, plus 1 of the ground, plus the survey's on the height.
    """
    ground = bundle.problem.ground
    if ground is None:
        return {}
    centre_m = bundle.problem.centre_vehicle
    sigma_m = bundle.problem.centre_sigma_m
    out = {}
    for name, c in bundle.camera_index.items():
        root = ground.root_information[c]
        if not root.any():
            continue
        matrix = bundle.solution.cam_from_vehicle[c]
        whitened = root @ by_tangent(matrix)
        off = root @ (plane_in(matrix) - ground.plane_cam[c])
        together = np.linalg.inv(whitened @ bundle.solution.extrinsic_covariance[c] @ whitened.T)
        information = together - np.eye(3)
        vector = together @ off
        unwhiten = np.linalg.pinv(root)
        if centre_m is not None and sigma_m is not None:
            by_height = unwhiten[3] / sigma_m[c, 2]
            information -= np.outer(by_height, by_height)
            vector -= by_height * (centre_m[c, 2] - ground.plane_cam[c, 3]) / sigma_m[c, 2]
        told, ways = np.linalg.eigh(information)
        is_told = told > _LEAST_TOLD
        alone = (ways[:, is_told].T @ vector) / told[is_told]
        squared = alone**2 / (1 / told[is_told] + 1)
        deviation = unwhiten @ ways[:, is_told] @ alone
        # The shortest turn that makes the one normal of the other.
        turn = -np.cross(matrix[:3, 2], deviation[:3])
        out[name] = OffGround(
            turn_deg=np.rad2deg(matrix[:3, :3].T @ turn),
            up_m=float(deviation[3]),
            sigmas=float(np.sqrt(np.mean(squared))) if is_told.any() else 0.0,
            plane=GroundPlane(ground.plane_cam[c], root, ground.by_lens[c]),
        )
    return out
