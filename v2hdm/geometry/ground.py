"""The ground plane z = 0 of the vehicle: inverse perspective mapping (IPM) and back.

``vehicle_from_pinhole_px`` (3 x 3) is the paper's H; its inverse has the columns K [r1 r2 t] of
``cam_from_vehicle`` (Hartley and Zisserman, Multiple View Geometry, 2nd ed., eq. 8.1).
:mod:`v2hdm.detection.camera.ground` does the same in numpy on the vehicle.
"""

from __future__ import annotations

import torch
from torch import Tensor

from v2hdm.geometry.camera import project, project_jacobian
from v2hdm.geometry.transform import apply, exp, hat, make_transform

_REFINEMENT_STEPS = 10


def ipm_from_extrinsic(intrinsic: Tensor, cam_from_vehicle: Tensor) -> Tensor:
    """The IPM ``vehicle_from_pinhole_px`` (*batch, 3, 3), of unit norm, of a camera's pose.

    Args:
        intrinsic: K, (*batch, 3, 3), px.
        cam_from_vehicle: (*batch, 4, 4).
    """
    pinhole_px_from_vehicle = intrinsic @ cam_from_vehicle[..., :3, [0, 1, 3]]
    ipm: Tensor = torch.linalg.inv(pinhole_px_from_vehicle)
    norm: Tensor = torch.linalg.matrix_norm(ipm, keepdim=True)
    return ipm / norm


def apply_homography(dst_from_src: Tensor, points_src: Tensor) -> Tensor:
    """Points (*batch, n, 2) mapped by a homography (*batch, 3, 3)."""
    homogeneous = points_src @ dst_from_src[..., :, :2].mT + dst_from_src[..., None, :, 2]
    return homogeneous[..., :2] / homogeneous[..., 2:]


def extrinsic_from_ipm(
    intrinsic: Tensor, vehicle_from_pinhole_px: Tensor, roi_vehicle: Tensor | None = None
) -> Tensor:
    """The rigid ``cam_from_vehicle`` (*batch, 4, 4) that comes closest to an IPM.

    An IPM fitted to clicked points is no exact rigid camera. Its columns r1, r2 are made orthonormal
    by the polar decomposition, the nearest choice in the Frobenius norm; of the two signs the one
    with the camera above the ground is taken. With ``roi_vehicle`` the result is then refined to
    agree with the IPM, in pixels, at those ground points.

    Args:
        intrinsic: K, (*batch, 3, 3), px.
        vehicle_from_pinhole_px: the IPM, (*batch, 3, 3), of any scale and sign; invertible.
        roi_vehicle: ground points (*batch, n, 2) in metres, n >= 4, all in view of the camera.
    """
    columns = torch.linalg.solve(intrinsic, torch.linalg.inv(vehicle_from_pinhole_px))
    u, s, vh = torch.linalg.svd(columns[..., :2], full_matrices=False)
    plane = u @ vh
    normal = torch.linalg.cross(plane[..., 0], plane[..., 1])
    translation = columns[..., 2] / s.mean(-1, keepdim=True)
    below = (normal * translation).sum(-1)[..., None] > 0
    plane = torch.where(below[..., None], -plane, plane)
    rotation = torch.cat([plane, normal[..., None]], dim=-1)
    cam_from_vehicle = make_transform(rotation, torch.where(below, -translation, translation))
    if roi_vehicle is None:
        return cam_from_vehicle
    return _refine(intrinsic, vehicle_from_pinhole_px, roi_vehicle, cam_from_vehicle)


def _refine(intrinsic: Tensor, ipm: Tensor, roi_vehicle: Tensor, cam_from_vehicle: Tensor) -> Tensor:
    """Gauss-Newton on the pixel distance between the IPM's and the camera's image of the ROI."""
    target_px = apply_homography(torch.linalg.inv(ipm), roi_vehicle)
    points_vehicle = torch.cat([roi_vehicle, torch.zeros_like(roi_vehicle[..., :1])], dim=-1)
    for _ in range(_REFINEMENT_STEPS):
        points_cam = apply(cam_from_vehicle, points_vehicle)
        residual_px = project(intrinsic, points_cam) - target_px
        by_point = project_jacobian(intrinsic, points_cam)
        rows = torch.cat([by_point, -by_point @ hat(points_cam)], dim=-1).flatten(-3, -2)
        step = -(torch.linalg.pinv(rows) @ residual_px.flatten(-2)[..., None])[..., 0]
        cam_from_vehicle = exp(step) @ cam_from_vehicle
    return cam_from_vehicle
