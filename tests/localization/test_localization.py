"""A vehicle follows itself through a map of markings by what its cameras see."""

from types import SimpleNamespace
from typing import cast

import numpy as np

from tests.cameras import mounted
from v2hdm.geometry.ipm import project_ground
from v2hdm.geometry.rigid import heading_rad
from v2hdm.localization.filter import Markings, Match, Sighting, State, fit, locate, pose_of, predict, start
from v2hdm.records import HDMap, Marking

INTRINSIC = np.array([[700.0, 0, 640], [0, 700, 360], [0, 0, 1]])
SIGMA_PX = 0.4
STEP_S = 0.2
ATTITUDE_RAD = 0.003
DASH = np.array([[1.0, 0.06], [-1.0, 0.06], [-1.0, -0.06], [1.0, -0.06]])
DIAMOND = np.array([[0.5, 0.0], [0.0, 0.4], [-0.5, 0.0], [0.0, -0.4]])


def looking_ahead():
    """cam_from_vehicle of a camera 2.4 m above the ground, 15 degrees down."""
    return mounted([1.5, 0.0, 2.4], pitch_deg=15)


def mapped(true, rng, sigma_m=0.01):
    """A yard as a drive has mapped it."""
    block = sigma_m**2 * np.eye(8)
    corners = [marking.corners_map + sigma_m * rng.standard_normal((4, 2)) for marking in true.markings]
    kinds = [marking.kind for marking in true.markings]
    return HDMap(tuple(Marking(kind, c, 10, block, sigma_m) for kind, c in zip(kinds, corners, strict=True)))


def yard(rng, length_m=120.0):
    """Dashes to the left and diamonds here and there to the right of a straight way along x."""
    markings = []
    for x in np.arange(0.0, length_m, 5.0):
        markings.append(Marking("lane_dash", DASH + np.array([x, 1.8]), 10))
        place = np.array([x + rng.uniform(-1, 1), rng.uniform(-4, -2)])
        markings.append(Marking("diamond", DIAMOND + place, 10))
    return HDMap(tuple(markings))


def seen_from(pose, hd_map, rng):
    """The camera's detections from a true pose (5,): whole markings within 15 m, with noise."""
    camera = looking_ahead()
    out = []
    for marking in hd_map.markings:
        pixels, depth_m = project_ground(
            INTRINSIC, camera @ np.linalg.inv(pose_of(pose)), marking.corners_map
        )
        inside = ((pixels > 0) & (pixels < [1280, 720])).all()
        if inside and depth_m.min() > 0 and depth_m.max() < 15:
            noisy = np.roll(pixels + SIGMA_PX * rng.standard_normal((4, 2)), int(rng.integers(4)), axis=0)
            covariance = np.tile(SIGMA_PX**2 * np.eye(2), (4, 1, 1))
            out.append(Sighting(marking.kind, INTRINSIC, camera, noisy, covariance, np.ones(4, dtype=bool)))
    return out


def drive(count, rng):
    """True x, y, heading, roll, pitch (F, 5) of a vehicle that swerves a little at about 4 m/s."""
    heading = 0.05 * np.sin(STEP_S * np.arange(100 * count) / 200)
    way = np.cumsum(0.04 * STEP_S * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)[::100]
    return np.column_stack([way - way[0], heading[::100], *(ATTITUDE_RAD * rng.standard_normal((2, count)))])


def follow(true, painted, off, rng):
    """States after each frame, in a map with errors of 1 cm; the first pose is given ``off`` (2,), m."""
    begin = pose_of(true[0])
    begin[:2, 3] += off
    state, markings, states = start(begin, 0.5, 0.05, ATTITUDE_RAD), Markings(mapped(painted, rng)), []
    for k, pose in enumerate(true):
        state = predict(state, STEP_S, ATTITUDE_RAD) if k else state
        state, _ = locate(state, seen_from(pose, painted, rng), markings)
        states.append(state)
    return states


def errors(states, true):
    return np.stack([state.mean[:2] for state in states]) - true[:, :2]


def test_a_vehicle_knows_where_it_is_to_centimetres_from_markings_alone():
    rng = np.random.default_rng(0)
    hd_map, true = yard(rng), drive(100, rng)
    states = follow(true, hd_map, np.zeros(2), rng)
    assert np.hypot(*errors(states, true).T).max() < 0.05
    turn = [heading_rad(state.map_from_vehicle) for state in states] - true[:, 2]
    assert np.degrees(np.sqrt(np.mean(np.square(turn)))) < 0.1


def test_a_start_half_a_metre_off_is_forgotten_at_the_first_markings():
    rng = np.random.default_rng(1)
    hd_map, true = yard(rng), drive(20, rng)
    states = follow(true, hd_map, np.array([0.4, -0.3]), rng)
    assert np.hypot(*errors(states, true)[1:].T).max() < 0.06


def test_the_stated_errors_hold():
    squared = []
    for seed in range(6):
        rng = np.random.default_rng(10 + seed)
        hd_map, true = yard(rng), drive(60, rng)
        states = follow(true, hd_map, np.zeros(2), rng)
        for state, error in list(zip(states, errors(states, true), strict=True))[::6]:
            squared.append(error @ np.linalg.solve(state.covariance[:2, :2], error))
    assert 0.8 < np.mean(squared) < 3.0  # of two coordinates: honest is 2


def test_where_nothing_is_painted_the_vehicle_says_that_it_is_lost_and_finds_itself_again():
    rng = np.random.default_rng(2)
    painted = yard(rng)
    gap = [m for m in painted.markings if not 30 < m.corners_map[:, 0].mean() < 60]
    true = drive(110, rng)
    states = follow(true, HDMap(tuple(gap)), np.zeros(2), rng)
    sigma_m = np.array([state.sigma_m for state in states])
    in_gap = (true[:, 0] > 40) & (true[:, 0] < 45)
    after = true[:, 0] > 62
    assert sigma_m[in_gap].min() > 0.3
    error = np.hypot(*errors(states, true).T)
    assert (error < 4 * sigma_m).all()
    assert error[after].max() < 0.1


def test_a_detection_that_two_markings_could_explain_is_not_used():
    rng = np.random.default_rng(3)
    dashes = HDMap(tuple(Marking("lane_dash", DASH + np.array([x, 1.8]), 10) for x in (8.0, 11.0)))
    sightings = seen_from(np.zeros(5), dashes, rng)[:1]
    unsure = start(pose_of(np.zeros(5)), 3.0, 0.02, ATTITUDE_RAD)
    assert locate(unsure, sightings, Markings(dashes))[1] == []
    sure = start(pose_of(np.zeros(5)), 0.3, 0.02, ATTITUDE_RAD)
    assert len(locate(sure, sightings, Markings(dashes))[1]) == 1


def test_a_corner_that_would_lie_at_the_horizon_is_no_match_whatever_it_seems_to_say():
    state = State(np.zeros(7), np.diag([0.25, 0.25, 0.003, 25.0, 0.09, 4e-6, 4e-6]))
    steep = np.zeros((2, 7))
    steep[0, :3] = 1e9, 2e8, -3e9  # px per m and rad
    at_horizon = SimpleNamespace(noise=np.eye(2), against=lambda _: (np.array([5.0, 5.0]), steep))
    fitted = fit(state, cast(Match, at_horizon))
    assert fitted.squared == np.inf
    assert fitted.state is state
