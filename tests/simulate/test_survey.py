"""A survey: a network's paint keeps apart, drives go there and back, detections have the stated errors."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from v2hdm.errors import ConfigError
from v2hdm.executor import HERE
from v2hdm.geometry.lens import distort_points
from v2hdm.records import HDMap, Marking
from v2hdm.simulate.port.build import cam_from_vehicle, camera_info
from v2hdm.simulate.port.config import PortConfig, ReliefConfig, SurveyConfig
from v2hdm.simulate.port.drive import folder_of_port
from v2hdm.simulate.survey.drive import folders_of, simulated_drives
from v2hdm.simulate.survey.network import build_network
from v2hdm.simulate.survey.sightings import Paint, detect


def port(length_km: float, **changes: object) -> PortConfig:
    """A survey of so many km."""
    return PortConfig(name="net", seed=3, survey=SurveyConfig(length_km=length_km, **changes))


def test_a_survey_is_as_long_as_it_is_said_to_be():
    for length_km in (1.0, 2.0):
        path = build_network(port(length_km), None).path
        assert 500.0 * length_km <= path.length_m <= 500.0 * length_km + 130.0


def test_no_marking_is_painted_over_another():
    network = build_network(port(3.0), None)
    centres = np.array([marking.corners_map.mean(axis=0) for marking in network.hd_map.markings])
    assert len(centres) > 1000
    nearest_m, _ = cKDTree(centres).query(centres, k=2)
    assert nearest_m[:, 1].min() > 0.8


def test_odd_drives_go_back_on_the_other_side():
    network = build_network(port(0.4), None)
    outward, back = network.way(0), network.way(1)
    np.testing.assert_allclose(outward.points_map[0], back.points_map[-1] - np.array([0.0, 1.6]), atol=1e-9)
    assert np.cos(back.yaw_rad[-1] - outward.yaw_rad[0]) == pytest.approx(-1.0)
    middle = back.length_m / 2
    step = back.points_at(np.array([middle, middle + 0.1]))
    heading = np.arctan2(*np.diff(step, axis=0)[0][::-1])
    assert np.cos(heading - back.yaw_at(np.array([middle]))[0]) == pytest.approx(1.0, abs=1e-4)


def test_equal_settings_give_equal_files(survey, tmp_path):
    again = simulated_drives(
        PortConfig(name="street", seed=5, survey=SurveyConfig(length_km=0.12)),
        tmp_path,
        HERE,
        lambda _, __: None,
    )
    for first, second in zip(survey, again, strict=True):
        names = sorted(path.relative_to(first) for path in first.rglob("*") if path.is_file())
        assert len(names) > 100
        for name in names:
            if name.name != ".v2hdm-used":
                assert (first / name).read_bytes() == (second / name).read_bytes(), name


def test_ports_without_a_survey_keep_their_folders(tmp_path):
    plain = PortConfig(name="net")
    assert folders_of(plain, tmp_path) == (folder_of_port(plain, tmp_path),)
    assert len(set(folders_of(port(1.0, drives=3), tmp_path))) == 3


def test_a_survey_on_slopes_is_refused(tmp_path):
    sloped = replace(port(0.1), relief=ReliefConfig(grade=0.02))
    with pytest.raises(ConfigError, match=r"simulate\.relief and simulate\.survey\.length_km"):
        simulated_drives(sloped, tmp_path, HERE, lambda _, __: None)


def test_detected_corners_scatter_about_the_truth_as_the_detector_s_do():
    """In sigmas: the median of squared errors over that of chi-square, and the tail, are the detector's."""
    camera = PortConfig().cameras["front"]
    info = camera_info("front", camera)
    cam_from_map = cam_from_vehicle(camera.mount)
    square = np.array([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]])
    ahead = HDMap((Marking("diamond", square + np.array([13.0, 0.0]), 0),))
    points = ahead.markings[0].corners_map @ cam_from_map[:3, :2].T + cam_from_map[:3, 3]
    pinhole = points @ info.intrinsic.T
    px = distort_points(info, pinhole[:, :2] / pinhole[:, 2:])
    squared = []
    for seed in range(2000):
        paint = Paint.of(ahead, 0.32, np.random.default_rng([seed, 1]))
        shown = detect(paint, info, cam_from_map, np.random.default_rng(seed))
        assert shown.whole.tolist() == [0]
        for detected in shown.markings:
            if np.ptp(detected.covariance_px.diagonal()) == 0.0:
                continue  # of no marking: these have one sigma for all corners
            offs_px = [detected.corners_px - np.roll(px, k, axis=0) for k in range(4)]
            off_px = min(offs_px, key=np.ptp)
            squared += (off_px**2 / detected.covariance_px.diagonal().reshape(4, 2)).sum(axis=1).tolist()
    assert len(squared) / 4 / 2000 == pytest.approx(0.98, abs=0.015)
    assert np.median(squared) / (2 * np.log(2)) == pytest.approx(0.77, abs=0.05)
    assert np.percentile(squared, 95) == pytest.approx(11.0, abs=2.5)


def test_a_corner_errs_alike_in_different_images_as_the_detector_does():
    """On the ground, the same in images from both ends of a marking: they see it from different sides."""
    camera = PortConfig().cameras["front"]
    info = camera_info("front", camera)
    square = np.array([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]])
    ahead = HDMap((Marking("diamond", square, 0),))
    pose_there = np.eye(4)
    pose_there[0, 3] = -9.0
    back = np.diag([-1.0, -1.0, 1.0, 1.0])
    back[0, 3] = 11.0
    products, squares = [], []
    for seed in range(1500):
        paint = Paint.of(ahead, 0.32, np.random.default_rng([seed, 2]))
        of_both = []
        for number, pose in enumerate((pose_there, back)):
            cam_from_map = cam_from_vehicle(camera.mount) @ np.linalg.inv(pose)
            rng = np.random.default_rng([seed, number])
            shown = detect(paint, info, cam_from_map, rng)
            of_both.append(whitened_errors(shown.markings, paint, info, cam_from_map))
        if all(len(errors) for errors in of_both):
            are_usual = np.all([np.linalg.norm(errors, axis=1) < 2.5 for errors in of_both], axis=0)
            products.append((of_both[0] * of_both[1])[are_usual])
            squares.append(np.square(of_both)[:, are_usual])
    correlation = np.mean(np.concatenate(products)) / np.mean(np.concatenate(squares, axis=1))
    assert correlation == pytest.approx(0.32, abs=0.04)


def whitened_errors(markings, paint, info, cam_from_map) -> np.ndarray:
    """Errors (4, 2) of the marking's corners on the ground, in sigmas; empty where it was not detected."""

    def px_of(corners_map):
        points = corners_map @ cam_from_map[:3, :2].T + cam_from_map[:3, 3]
        pinhole = points @ info.intrinsic.T
        return distort_points(info, pinhole[:, :2] / pinhole[:, 2:])

    px = px_of(paint.corners_map[0])
    for detected in markings:
        turned = [np.roll(detected.corners_px, -k, axis=0) - px for k in range(4)]
        turn = min(range(4), key=lambda k: np.abs(turned[k]).max())
        sigma_px = np.roll(np.sqrt(detected.covariance_px.diagonal()).reshape(4, 2), -turn, axis=0)
        if np.abs(turned[turn]).max() > 8.0 or np.ptp(sigma_px) == 0.0:
            continue
        errors = []
        for off_px, sigma, corner in zip(turned[turn], sigma_px, paint.corners_map[0], strict=True):
            steps = px_of(corner + 0.01 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]))
            by_m = np.column_stack([steps[0] - steps[1], steps[2] - steps[3]]) / 0.02
            share, axes = np.linalg.eigh(by_m.T @ np.diag(sigma**-2) @ by_m)
            errors.append((axes * np.sqrt(share)) @ axes.T @ np.linalg.solve(by_m, off_px))
        return np.array(errors)
    return np.zeros((0, 2))
