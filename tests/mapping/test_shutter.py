"""A drive by cameras with rolling shutters, mapped from detections on."""

from dataclasses import replace

import numpy as np
import pytest

from tests.mapping.scene import MATCH_M, SceneOptions, make_scene, match
from v2hdm.association.ground import locate
from v2hdm.association.sightings import collect_sightings
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.optimise import initial_rig, rolling
from v2hdm.mapping.options import MappingOptions

READ_OUT_S = 0.03
CAMERAS = ("front",)
SCENE = SceneOptions(cameras=CAMERAS, length_m=90.0, step_m=2.0, rtk_m=0.005, wild_rate=0.0, false_rate=0.0)
"""10 m/s."""


@pytest.fixture(scope="module")
def scene():
    return make_scene(replace(SCENE, read_out_s=READ_OUT_S))


def mapped(drive, detections, **options):
    return run_methods(drive, detections, CAMERAS, MappingOptions(pose_model="heave", **options))["Opt"]


def unstated(drive):
    return replace(
        drive, cameras={name: replace(camera, read_out_s=0.0) for name, camera in drive.cameras.items()}
    )


def test_sightings_lie_where_the_pose_of_their_row_puts_them(scene):
    """By the true extrinsic and poses that are exact but for their height."""
    exact = make_scene(
        replace(SCENE, read_out_s=READ_OUT_S, pixel_sigma=1e-6, jitter_deg=0.0, rtk_m=0.0, heading_deg=0.0)
    )
    sightings = collect_sightings(exact.drive, exact.detections, CAMERAS)
    truth = np.stack([exact.cam_from_vehicle[name] for name in CAMERAS])
    rig = replace(initial_rig(exact.drive.cameras, sightings.map_from_vehicle), cam_from_vehicle=truth)
    corners = np.concatenate([marking.corners_map for marking in exact.markings])

    def off_m(some):
        located = locate(sightings, some)
        is_near = located.valid & (located.range_m < 10.0)
        away = np.linalg.norm(located.corners_map[is_near][:, None] - corners, axis=2).min(axis=1)
        return np.quantile(away, 0.95)

    moving = rolling(rig, exact.drive.cameras.values(), sightings, estimate=False)
    # Of the heave of 3 mm some centimetres remain.
    assert off_m(moving) < 0.03
    assert off_m(rig) > 2.5 * off_m(moving)


def test_a_stated_read_out_time_makes_a_better_map_than_none(scene):
    """Markings have one pixel of noise; that the map is as good as a global shutter's is tested in adjust."""
    pairs, known_m = match(mapped(scene.drive, scene.detections).hd_map, scene.markings, MATCH_M)
    ignorant = mapped(unstated(scene.drive), scene.detections)
    _, ignorant_m = match(ignorant.hd_map, scene.markings, MATCH_M)
    assert known_m < 0.6 * ignorant_m
    assert len(pairs) > 0.75 * len(scene.markings)  # those at both ends are hardly seen


def test_an_estimated_read_out_time_is_the_true_one(scene):
    result = mapped(unstated(scene.drive), scene.detections, estimate_read_out=True)
    read_out_s, sigma_s = result.evidence.read_out_s["front"]
    assert read_out_s == pytest.approx(READ_OUT_S, abs=min(0.001, 3 * sigma_s))
