"""The checks after the solve, on evidence made up for each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from tests.mapping.scene import SceneOptions, extrinsic, make_scene
from v2hdm.adjust import Fault
from v2hdm.mapping.results import CameraFit, Contradiction, MethodResult, SolveEvidence
from v2hdm.records import Calibration, CameraInfo, Drive, HdMap, Marking
from v2hdm.site.candidates import Exclusion
from v2hdm.verdict import Finding, Status
from v2hdm.verdict.results.solution import check_inputs, check_solution

INFO = CameraInfo("front", 1280, 720, np.array([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]]))
FIT = CameraFit(observations=2000, variance_factor=0.15, rejected_share=0.02, bias_px=0.03)


def contradiction(fault, cameras, axis, about, value, sigma, sigmas):
    return Contradiction(fault, cameras, axis, about, value, sigma, 2 * norm.sf(sigmas), sigmas**2 / 2, 0.5)


CLOCK = contradiction(Fault.CLOCK, ("front", "rear"), 0, "", 0.001, 0.001, 1.0)
LEVER = contradiction(Fault.LEVER, ("front", "rear"), 0, "", 0.01, 0.02, 0.5)
FINE = SolveEvidence(
    score_tests=(CLOCK, LEVER),
    corrected=(),
    pose_model="heave",
    held_out={"heave": 1.95},
    fits={"front": FIT, "rear": FIT},
    variance_factor=0.15,
    along_route=np.array([0.15, 0.2, 0.15]),
    window_s=np.array([0.0, 5.0, 10.0]),
    pose_noise={"position_m": 0.7, "heading_rad": 0.8},
    worst_innovation=3.0,
    worst_innovation_s=4.0,
)


@pytest.fixture(scope="module")
def drive() -> Drive:
    return make_scene(SceneOptions(length_m=20.0, turns=False)).drive


def square_at(x: float, y: float) -> Marking:
    return Marking("diamond", np.array([[x, y], [x + 1, y], [x + 1, y + 1], [x, y + 1]]), 5)


def result(evidence: SolveEvidence = FINE, *markings: Marking, **changes: object) -> MethodResult:
    mapped = HdMap(markings or tuple(square_at(3.0 * n, 0.0) for n in range(12)))
    return replace(MethodResult("Opt", ("front", "rear"), mapped, evidence=evidence), **changes)  # type: ignore[arg-type]


def raised(one: MethodResult, drive: Drive) -> dict[str, Finding]:
    found = check_solution(drive, {"both": {"Opt": one}})
    return {finding.check: finding for finding in found if finding.status is not Status.PASS}


def test_a_clean_result_raises_nothing(drive: Drive) -> None:
    assert raised(result(), drive) == {}


def test_an_input_that_was_dropped_is_a_warning_that_names_it(drive: Drive) -> None:
    dropped = replace(LEVER, value=-1.2, p_value=1e-200)
    found = raised(result(replace(FINE, corrected=(dropped,))), drive)
    assert found["survey"].status is Status.WARN
    assert "antenna" in found["survey"].says
    assert "120 cm behind" in found["survey"].says


def test_an_input_that_is_contradicted_still_fails_and_symptoms_point_to_it(drive: Drive) -> None:
    focal = contradiction(Fault.FOCAL, ("front", "rear"), 0, "", -0.045, 0.001, 45.0)
    late = replace(CLOCK, value=0.2, p_value=1e-80)
    evidence = replace(FINE, score_tests=(focal, late, LEVER), held_out={"heave": 9.0})
    found = raised(result(evidence), drive)
    assert set(found) == {"focal length", "held out"}, "the clock explains less of the same residuals"
    assert found["focal length"].status is Status.FAIL
    assert "4.5 % shorter" in found["focal length"].says
    assert found["held out"].says.endswith("see focal length")


def test_a_rival_that_explains_as_much_is_named_as_well() -> None:
    one = contradiction(Fault.SURVEY, ("front",), 0, "", 4.9, 0.1, 37.0)
    other = contradiction(Fault.SURVEY, ("rear",), 0, "", -4.7, 0.1, 36.99)
    finding = check_inputs(replace(FINE, score_tests=(one, other)))[0]
    assert "front lies 490 cm ahead of its survey or the centre of rear" in finding.says


def test_a_small_contradiction_is_none_however_sure_it_is() -> None:
    tiny = replace(CLOCK, value=0.0008, sigma=0.0001, p_value=1e-15)
    assert all(f.status is Status.PASS for f in check_inputs(replace(FINE, score_tests=(tiny,))))


def test_a_straight_drive_says_what_it_cannot_tell() -> None:
    unsure = (replace(CLOCK, sigma=0.01), replace(LEVER, sigma=float("inf")))
    untold = [f for f in check_inputs(replace(FINE, score_tests=unsure)) if f.is_unobservable]
    assert {f.check for f in untold} == {"clock", "survey"}
    assert all("drive a turn" in f.says for f in untold)


@pytest.mark.parametrize(
    ("check", "change"),
    [
        ("fit", {"variance_factor": 6.0}),
        ("fit along the route", {"along_route": np.array([0.15, 3.0, 0.15])}),
        ("rejected", {"fits": {"front": replace(FIT, rejected_share=0.14)}}),
        ("held out", {"held_out": {"heave": 6.5}}),
        ("pose noise", {"pose_noise": {"heading_rad": 4.0}}),
        ("pose jump", {"worst_innovation": 20.0}),
    ],
)
def test_a_bad_fit_is_raised_by_its_own_check(check: str, change: dict[str, object], drive: Drive) -> None:
    assert set(raised(result(replace(FINE, **change)), drive)) == {check}  # type: ignore[arg-type]


def test_markings_that_overlap_are_told_with_a_place(drive: Drive) -> None:
    apart = [square_at(3.0 * n, 0.0) for n in range(12)]
    found = raised(result(FINE, *apart, square_at(6.4, 0.2)), drive)
    assert set(found) == {"double markings"}
    assert "(6.5, 0.5)" in found["double markings"].says


def test_neighbours_of_another_class_or_beside_one_another_are_no_doubles(drive: Drive) -> None:
    other = replace(square_at(0.4, 0.0), kind="stop_line")
    assert raised(result(FINE, square_at(0.0, 0.0), square_at(1.0, 0.0), other), drive) == {}


def test_a_third_of_the_candidates_left_out_is_told(drive: Drive) -> None:
    left_out = tuple(Exclusion("diamond", np.zeros(2), 3, "odd shape") for _ in range(12))
    assert set(raised(result(excluded=left_out), drive)) == {"excluded"}


def test_maps_of_two_cameras_that_are_apart_along_the_route_are_told(drive: Drive) -> None:
    covariance = np.diag([1e-4] * 3 + [1e-8] * 3)
    calibrations = {
        name: Calibration(INFO, extrinsic(yaw, 15.0, 0.0, (1.0, 0.0, 2.4)), covariance)
        for name, yaw in (("front", 0.0), ("rear", 180.0))
    }
    ahead = drive.images[0].map_from_vehicle[:2, 0] * 0.3
    front = tuple(square_at(3.0 * n, 0.0) for n in range(12))
    rear = tuple(replace(m, corners_map=m.corners_map + ahead) for m in front)
    sets = {
        "front": {"Opt": result(FINE, *front, cameras=("front",), calibrations=calibrations)},
        "rear": {"Opt": result(FINE, *rear, cameras=("rear",), calibrations=calibrations)},
        "both": {"Opt": result(FINE, *front, calibrations=calibrations)},
    }
    found = [f for f in check_solution(drive, sets) if f.status is not Status.PASS]
    assert [f.check for f in found] == ["cameras apart"]
    assert "30 cm ahead of where front does" in found[0].says


def test_a_mounting_that_differs_alone_and_together_is_told(drive: Drive) -> None:
    covariance = np.diag([1e-4] * 3 + [1e-8] * 3)
    there, turned = (
        Calibration(INFO, extrinsic(yaw, 15.0, 0.0, (1.0, 0.0, 2.4)), covariance) for yaw in (0.0, 0.2)
    )
    sets = {
        "front": {"Opt": result(cameras=("front",), calibrations={"front": turned})},
        "both": {"Opt": result(calibrations={"front": there})},
    }
    found = [f.check for f in check_solution(drive, sets) if f.status is not Status.PASS]
    assert found == ["alone and together"]
