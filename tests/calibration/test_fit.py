"""The most likely mounting: as good as theory allows, with sigmas that hold, whatever point is wrong."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.calibration.site import INFO, PLACES, clicked, mounting, project
from v2hdm.calibration.fit import Noise, SeenPoints, fit_mountings
from v2hdm.calibration.points import SurveyedPoints, known_ground, lens, residuals
from v2hdm.geometry.ipm import apply_in_front, facing_ipm, ipm_from_extrinsic
from v2hdm.geometry.lens import undistort_points
from v2hdm.geometry.rigid import exp, inverse, log

NAMES = tuple(f"P{n}" for n in range(1, 11))


def fit(px, places, noise, starts=1):
    points = SurveyedPoints(Path("points.csv"), NAMES, NAMES, px, places)
    return fit_mountings(SeenPoints.of(points.points_px, points.points_vehicle, INFO, noise), starts)[0]


def by_tangent(places):
    """Derivative (N, 2, 6) of OpenCV's projection by the left tangent, by central differences."""
    steps = 1e-5 * np.eye(6)
    moved = [
        (project(exp(s) @ mounting(), places) - project(exp(-s) @ mounting(), places)) / 2e-5 for s in steps
    ]
    return np.stack(moved, axis=2)


def bound(pixel_px, survey_m):
    """The Cramer-Rao bound (6, 6) of a mounting from the ten points, from OpenCV's projection alone."""
    slopes = by_tangent(PLACES)
    by_place = np.stack(
        [
            (project(mounting(), PLACES + s) - project(mounting(), PLACES - s)) / 2e-4
            for s in 1e-4 * np.eye(2)
        ],
        axis=2,
    )
    covariance = pixel_px**2 * np.eye(2) + survey_m**2 * by_place @ np.swapaxes(by_place, 1, 2)
    return np.asarray(np.linalg.inv(np.einsum("nij,nik,nkl->jl", slopes, np.linalg.inv(covariance), slopes)))


@pytest.mark.parametrize(("pixel_px", "survey_m"), [(0.5, 0.0), (0.5, 0.01)])
def test_a_mounting_is_as_good_as_theory_says_and_its_sigmas_hold(pixel_px, survey_m):
    limit, draws = bound(pixel_px, survey_m), 40
    scale = np.sqrt(np.outer(np.diag(limit), np.diag(limit)))
    errors, nees = [], []
    for seed in range(draws):
        mount = fit(*clicked(seed, pixel_px, survey_m), Noise(pixel_px, survey_m))
        error = log(mount.cam_from_vehicle @ inverse(mounting()))
        errors.append(error)
        nees.append(error @ np.linalg.solve(mount.covariance, error) / 6)
        # The noise factor alone makes the sigmas differ from the bound.
        assert np.abs((mount.covariance / mount.factor - limit) / scale).max() < 0.15
    efficiency = np.mean([error @ np.linalg.solve(limit, error) / 6 for error in errors])
    # Forty draws of six leave a mean of one uncertain by .09.
    assert efficiency == pytest.approx(1.0, abs=0.27)
    assert np.mean(nees) == pytest.approx(1.08, abs=0.3)


def test_the_ipm_is_off_as_its_sigma_says():
    places = np.array([[9.0, 1.0], [12.0, -2.0], [15.0, 3.0]])
    truth = project(mounting(), places)
    off, sigma = [], []
    for seed in range(25):
        mount = fit(*clicked(seed), Noise())
        sigma.append(known_ground(mount, places))
        # What the found camera sees where the true one sees the places: Newton, once.
        by_place = np.stack(
            [project(mount.cam_from_vehicle, places + s) - project(mount.cam_from_vehicle, places)
             for s in 1e-4 * np.eye(2)], axis=2,
        ) / 1e-4  # fmt: skip
        off.append(
            np.linalg.solve(by_place, (truth - project(mount.cam_from_vehicle, places))[..., None])[..., 0]
        )
    worst = np.sqrt(
        [np.linalg.eigvalsh(np.array(off)[:, k].T @ np.array(off)[:, k] / 25)[-1] for k in range(3)]
    )
    np.testing.assert_allclose(worst / np.mean(sigma, axis=0), 1.0, atol=0.4)


@pytest.mark.parametrize("moved", [(0, 1.0, 0.0), (4, 0.0, -0.8), (9, 5.0, 0.0)])
def test_one_wrong_point_is_named_and_moves_nothing(moved):
    wrong, *shift = moved
    px, places = clicked(5)
    places[wrong] += shift
    mount = fit(px, places, Noise(), starts=4)
    others = np.arange(10) != wrong
    np.testing.assert_array_equal(mount.is_right, others)
    without = fit_mountings(
        SeenPoints.of(px[others], places[others], INFO, Noise()), starts=4
    )[0]  # fmt: skip
    np.testing.assert_allclose(mount.cam_from_vehicle, without.cam_from_vehicle, atol=1e-4)
    off = residuals(mount)
    assert off.sigmas[wrong] > 10
    assert off.sigmas[others].max() < 5


def test_two_rows_whose_places_were_exchanged_are_named():
    px, places = clicked(6)
    places[[3, 5]] = places[[5, 3]]
    np.testing.assert_array_equal(np.flatnonzero(~fit(px, places, Noise(), starts=4).is_right), [3, 5])


def test_larger_errors_than_stated_make_larger_sigmas():
    stated = np.mean([fit(*clicked(seed), Noise()).factor for seed in range(8)])
    worse = np.mean([fit(*clicked(seed, 2.0, 0.04), Noise(), starts=2).factor for seed in range(8)])
    assert stated == pytest.approx(1.0, abs=0.35)
    # Sixteen times the variance, which four observations' worth of prior draws down a little.
    assert 8 < worse < 18


def test_a_wrong_focal_length_is_told_with_its_size():
    longer = INFO.intrinsic * [[1.04, 1, 1], [1, 1.04, 1], [1, 1, 1]]
    info = type(INFO)("front", 1280, 720, longer, INFO.distortion_model, INFO.distortion)
    px, places = clicked(2)
    tested = lens(fit_mountings(SeenPoints.of(px, places, info, Noise()))[0])
    assert tested.probability < 1e-4
    assert tested.focal == pytest.approx(1 / 1.04 - 1, abs=0.012)
    right = lens(fit(px, places, Noise()))
    assert right.probability > 1e-3
    assert abs(right.focal) < 4 * right.focal_sigma


MOUNTINGS = {
    "rear": ((-0.5, 17.0, 180.0), (-1.0, 0.0, 2.6)),
    "left": ((0.0, 25.0, 90.0), (2.0, 0.9, 2.2)),
    "straight down": ((0.0, 89.0, 0.0), (4.0, 0.0, 3.0)),
    "on its head": ((180.0, 16.0, 0.0), (3.6, 0.0, 2.4)),
}


@pytest.mark.parametrize("where", MOUNTINGS)
@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
def test_cameras_that_look_any_way_through_any_lens_are_found(where, model):
    angles, centre = MOUNTINGS[where]
    truth = mounting(angles, np.array(centre))
    lens = INFO.distortion if model == "plumb_bob" else (0.012, -0.004, 0.0011, -0.0003)
    info = replace(INFO, distortion_model=model, distortion=lens)
    px = np.array([[u, v] for u in (200.0, 640.0, 1100.0) for v in (350.0, 500.0, 650.0)])
    if where == "on its head":
        px[:, 1] = 719 - px[:, 1]
    vehicle_from_cam = inverse(truth)
    axis = vehicle_from_cam[:3, 2]  # all of them look down
    ahead = vehicle_from_cam[:3, 3] - axis * vehicle_from_cam[2, 3] / axis[2]
    ipm = facing_ipm(ipm_from_extrinsic(info, truth), ahead[:2])
    places = apply_in_front(ipm, undistort_points(info, px))
    assert np.isfinite(places).all()
    mount = fit_mountings(SeenPoints.of(px, places, info, Noise()), starts=1)[0]
    np.testing.assert_allclose(mount.cam_from_vehicle, truth, atol=1e-5)
