"""The mapping's inverse perspective mapping is kornia's."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.mapping.scene import Scene, SceneOptions, make_scene
from v2hdm.association.ground import locate
from v2hdm.association.sightings import Rig, Sightings, collect_sightings
from v2hdm.geometry import ipm, tensors
from v2hdm.geometry.ipm import extrinsic_from_ipm
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.optimise import initial_rig
from v2hdm.records import FloatArray

CAMERAS = ("front", "rear")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(SceneOptions(length_m=40.0, seed=21))


@pytest.fixture(scope="module")
def sightings(scene: Scene) -> Sightings:
    return collect_sightings(scene.drive, scene.detections, CAMERAS)


def homographies(sightings: Sightings, rig: Rig) -> FloatArray:
    vehicle_from_map = np.linalg.inv(rig.map_from_vehicle[sightings.frame])
    cam_from_map = rig.cam_from_vehicle[sightings.camera] @ vehicle_from_map
    return ipm.ground_from_pinhole_px(rig.intrinsic[sightings.camera], cam_from_map)


def test_start_values_and_every_sighting_go_through_kornia(
    scene: Scene, sightings: Sightings, monkeypatch: pytest.MonkeyPatch
) -> None:
    mapped: set[tuple[float, float]] = set()
    backward, started = [0], []
    transform_points, compose = tensors.transform_points, tensors.Rt_to_matrix4x4
    grad = torch.autograd.grad

    def transforming(homography: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        mapped.update(map(tuple, points.detach().reshape(-1, 2).tolist()))
        return transform_points(homography, points)

    def composing(rotation: torch.Tensor, translation: torch.Tensor) -> torch.Tensor:
        started.append(len(rotation))
        return compose(rotation, translation)

    def differentiating(*args: object, **kwargs: object) -> object:
        backward[0] += 1
        return grad(*args, **kwargs)  # type: ignore[arg-type]

    monkeypatch.setattr(tensors, "transform_points", transforming)
    monkeypatch.setattr(tensors, "Rt_to_matrix4x4", composing)
    monkeypatch.setattr(torch.autograd, "grad", differentiating)
    assert run_methods(scene.drive, scene.detections, CAMERAS)["Opt"].hd_map.markings
    corners = sightings.corners_pinhole_px[np.isfinite(sightings.corners_pinhole_px).all(axis=2)]
    assert {(float(u), float(v)) for u, v in corners} <= mapped
    assert started == [len(CAMERAS)]
    assert backward[0] >= 2


def test_it_is_that_of_the_vehicle_to_a_nanometre(scene: Scene, sightings: Sightings) -> None:
    cameras = {name: scene.drive.cameras[name] for name in CAMERAS}
    rig = initial_rig(cameras, sightings.map_from_vehicle)
    start = [extrinsic_from_ipm(one.info, one.ipm[one.initial_ipm]) for one in cameras.values()]
    np.testing.assert_allclose(rig.cam_from_vehicle, start, atol=1e-12)
    located = locate(sightings, rig)
    by_numpy = ipm.apply_in_front(homographies(sightings, rig), sightings.corners_pinhole_px)
    np.testing.assert_allclose(located.corners_map[located.informs], by_numpy[located.informs], atol=1e-9)
    jacobian = ipm.homography_jacobian(homographies(sightings, rig), sightings.corners_pinhole_px)
    covariance = jacobian @ sightings.covariance_px @ np.swapaxes(jacobian, -1, -2)
    np.testing.assert_allclose(
        located.covariance_m2[located.informs], covariance[located.informs], rtol=1e-9, atol=1e-12
    )
