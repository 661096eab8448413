"""The IPM and the extrinsic: round trips, and agreement with the numpy twins on the vehicle."""

import numpy as np
import pytest
import torch

from tests.adjust.scene import mounted
from v2hdm.detection.camera import ground as on_vehicle
from v2hdm.geometry import ground, transform
from v2hdm.records import CameraInfo

INFO = CameraInfo("front", 1280, 720, np.array([[900.0, 0, 639.5], [0, 880, 359.5], [0, 0, 1]]))
K = torch.as_tensor(INFO.intrinsic)
MOUNTS = torch.as_tensor(
    np.stack([mounted(1.5, 2.4, 18), mounted(-1, 2.6, 40, rear=True), mounted(2, 1.7, 1)])
)
ROI = torch.tensor([[4.0, -2], [4, 2], [12, 4], [12, -4], [8, 0]], dtype=torch.float64)


def test_the_ipm_agrees_with_the_one_computed_on_the_vehicle():
    for mount in MOUNTS:
        expected = on_vehicle.ipm_from_extrinsic(INFO, mount.numpy())
        torch.testing.assert_close(ground.ipm_from_extrinsic(K, mount), torch.as_tensor(expected))
        points = np.random.default_rng(0).uniform(400, 700, (5, 2))
        torch.testing.assert_close(
            ground.apply_homography(torch.as_tensor(expected), torch.as_tensor(points)),
            torch.as_tensor(on_vehicle.apply_homography(expected, points)),
        )


@pytest.mark.parametrize("factor", [1.0, -1.0, 250.0, -1e-3])
@pytest.mark.parametrize("with_roi", [False, True])
def test_the_extrinsic_comes_back_from_its_ipm_whatever_its_scale_and_sign(factor, with_roi):
    ipm = factor * ground.ipm_from_extrinsic(K, MOUNTS)
    roi = torch.stack([ROI, ROI * torch.tensor([-1.0, 1]), ROI]) if with_roi else None
    torch.testing.assert_close(ground.extrinsic_from_ipm(K, ipm, roi), MOUNTS, atol=1e-9, rtol=0)


def test_an_inexact_ipm_yields_a_rigid_extrinsic_that_the_roi_brings_closer():
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(3, 3, generator=generator, dtype=torch.float64)
    ipm = ground.ipm_from_extrinsic(K, MOUNTS[0])
    ipm = ipm * (1 + 0.02 * noise)
    seen_px = ground.apply_homography(torch.linalg.inv(ipm), ROI)

    def misfit_px(cam_from_vehicle):
        back = torch.linalg.inv(ground.ipm_from_extrinsic(K, cam_from_vehicle))
        return (ground.apply_homography(back, ROI) - seen_px).square().mean().sqrt().item()

    plain, refined = ground.extrinsic_from_ipm(K, ipm), ground.extrinsic_from_ipm(K, ipm, ROI)
    for extrinsic in (plain, refined):
        rotation = extrinsic[:3, :3]
        torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3, dtype=torch.float64))
        assert torch.linalg.det(rotation).item() == pytest.approx(1)
        assert transform.inverse(extrinsic)[2, 3] > 0
    assert misfit_px(refined) < 0.7 * misfit_px(plain)
