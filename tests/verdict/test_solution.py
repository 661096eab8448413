"""The checks after the solve, and what check points say."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from tests.cameras import mounted
from tests.mapping.scene import SceneOptions, make_scene
from tests.report.yard import SURVEY_M, checked, point, yard
from tests.verdict.drives import INFO, square_at
from v2hdm.faults import Contradiction, table
from v2hdm.faults.odds import probability_of_any
from v2hdm.mapping.results import CameraFit, ForeignSegment, MethodResult, SolveEvidence
from v2hdm.records import Calibration, Exclusion, GroundStrip, HDMap
from v2hdm.site.candidates import LACKS_A_CORNER
from v2hdm.verdict import Finding, Status, Verdict
from v2hdm.verdict.results.accuracy import SIGNIFICANCE, check_frame, check_goal, check_points
from v2hdm.verdict.results.solution import (
    check_inputs,
    check_solution,
    doubted,
    over_ground,
    told_by_poses,
)
from v2hdm.verdict.verdict import passed

FIT = CameraFit(observations=2000, variance_factor=0.15, rejected_share=0.01, sightings=400.0)


def contradiction(fault, cameras, axis, about, value, sigma, sigmas):
    numbers = value, sigma, sigma, 2 * norm.sf(sigmas), sigmas**2 / 2
    return Contradiction(fault.name, 0 if len(cameras) == 1 else -1, axis, -1, *numbers, cameras, about)


CLOCK = contradiction(table.CLOCK, ("front", "rear"), 0, "", 0.001, 0.001, 1.0)
LEVER = contradiction(table.LEVER, ("front", "rear"), 0, "", 0.01, 0.02, 0.5)
FINE = SolveEvidence(
    score_tests=(CLOCK, LEVER),
    corrected=(),
    pose_model="heave",
    held_out={"heave": 1.95},
    fits={"front": FIT, "rear": FIT},
    variance_factor=0.15,
    pose_noise={"position_m": 0.7, "heading_rad": 0.8},
    worst_innovation=3.0,
    worst_innovation_s=4.0,
)


@pytest.fixture(scope="module")
def drive():
    return make_scene(SceneOptions(length_m=20.0, turns=False)).drive


def result(evidence=FINE, *markings, **changes):
    mapped = HDMap(markings or tuple(square_at(3.0 * n, 0.0) for n in range(12)))
    return replace(MethodResult("Opt", ("front", "rear"), mapped, evidence=evidence), **changes)  # type: ignore[arg-type]


def raised(result, drive):
    findings = check_solution(drive, result)
    return {finding.check: finding for finding in findings if finding.status is not Status.PASS}


@pytest.mark.parametrize(
    ("check", "status", "about", "is_kept"),
    [
        ("heading", Status.FAIL, "poses", False),
        ("heading", Status.WARN, "poses", True),
        ("focal length", Status.FAIL, "front", True),
    ],
    ids=["under poses that failed", "under poses that may be right", "beside a camera that failed"],
)
def test_what_a_solve_contradicts_is_told_but_under_poses_that_failed(check, status, about, is_kept):
    before = Finding(check, status, 1.0, 0.5, "", "it is wrong", about)
    passed = Finding("survey", Status.PASS, 1.0, 4.0, "sigmas", "it agrees", "front")
    late = Finding("clock", Status.FAIL, 9.0, 4.0, "sigmas", "it is late", "front, rear")
    assert told_by_poses([late, passed], [before]) == ([late, passed] if is_kept else [passed])


def test_a_clean_result_raises_nothing(drive):
    assert raised(result(), drive) == {}


@pytest.mark.parametrize(("ratio", "named"), [(1.2, False), (5.0, True)])
def test_noise_along_the_way_alone_is_of_stamps_that_jitter(drive, ratio, named):
    noisy = replace(FINE, pose_noise={"position_m": 4.0}, jitter_s=0.02, along_over_across=ratio)
    findings = raised(result(replace(noisy, variance_factor=4.0)), drive)
    assert ("image stamps" in findings) is named
    assert findings["fit"].says.endswith("see image stamps") is named
    quiet = replace(noisy, jitter_s=0.003)
    assert "image stamps" not in raised(result(quiet), drive)


@pytest.mark.parametrize(("factor", "named"), [(0.5, False), (3.3, True)])
def test_stamps_that_may_jitter_are_named_where_the_corners_fit_badly(drive, factor, named):
    """The ratio is that of a made drive whose stamps jitter by 20 ms; right drives reach 1.25."""
    noisy = replace(FINE, pose_noise={"position_m": 6.4}, jitter_s=0.012, along_over_across=2.06)
    findings = raised(result(replace(noisy, variance_factor=factor)), drive)
    assert ("image stamps" in findings) is named
    assert not named or findings["fit"].says.endswith("see image stamps")
    right = replace(noisy, variance_factor=3.3, along_over_across=1.25)
    assert "image stamps" not in raised(result(right), drive)


@pytest.mark.parametrize(("noise", "status"), [(2.9, Status.WARN), (4.0, Status.FAIL)])
def test_stamps_that_jitter_within_the_noise_that_is_allowed_for_are_a_warning(drive, noise, status):
    noisy = replace(FINE, pose_noise={"position_m": noise}, jitter_s=0.02, along_over_across=5.0)
    assert raised(result(noisy), drive)["image stamps"].status is status


def test_an_input_that_was_dropped_is_a_warning_that_names_it(drive):
    dropped = replace(LEVER, value=-1.2, p_value=1e-200)
    findings = raised(result(replace(FINE, corrected=(dropped,))), drive)
    assert findings["survey"].status is Status.WARN
    assert "antenna" in findings["survey"].says
    assert "120 cm behind" in findings["survey"].says


@pytest.mark.parametrize(
    ("fault", "value", "of", "status"),
    [
        (table.CLOCK_DRIFT, 0.017, ("front", "rear"), Status.FAIL),
        (table.CLOCK_DRIFT, 0.007, ("front", "rear"), Status.WARN),
        (table.CLOCK_DRIFT, 0.017, ("rear",), Status.WARN),
        (table.FOCAL, 0.017, ("front", "rear"), Status.WARN),
    ],
)
def test_a_clock_is_corrected_only_if_no_drift_of_it_is_likelier_than_none(drive, fault, value, of, status):
    mended = ("front",) if of == ("rear",) else of
    clock = contradiction(table.CLOCK, mended, 0, "", 0.02, 0.002, 10.0)
    left = contradiction(fault, of, 0, "", value, 0.006, 2.7)
    alone = raised(result(replace(FINE, score_tests=(left,))), drive)
    findings = raised(result(replace(FINE, score_tests=(left,), corrected=(clock,))), drive)
    assert not alone, "as likely as chance in a drive whose clock is right"
    assert max((finding.status for finding in findings.values()), key=lambda finding: finding.rank) is status


def test_an_input_that_is_contradicted_still_fails_and_symptoms_point_to_it(drive):
    focal = contradiction(table.FOCAL, ("front", "rear"), 0, "", -0.045, 0.001, 45.0)
    late = replace(CLOCK, value=0.2, p_value=1e-80)
    evidence = replace(FINE, score_tests=(focal, late, LEVER), held_out={"heave": 9.0})
    findings = raised(result(evidence), drive)
    assert set(findings) == {"focal length", "held out"}, "the clock explains less of the same residuals"
    assert findings["focal length"].status is Status.FAIL
    assert "4.5 % shorter" in findings["focal length"].says
    assert findings["held out"].says.endswith("see focal length")


@pytest.mark.parametrize(
    ("odds", "named"),
    [
        (9.0, ["focal length"]),
        (19.0, ["focal length", "foreign images"]),
        (21.0, ["foreign images", "focal length"]),
        (30.0, ["foreign images"]),
    ],
)
def test_foreign_images_are_named_by_their_odds_among_other_causes(odds, named):
    focal = replace(contradiction(table.FOCAL, ("front", "rear"), 0, "", -0.02, 0.003, 7.0), gain=20.7)
    evidence = replace(FINE, score_tests=(focal,), foreign=ForeignSegment(4.0, 8.0, odds))
    assert [f.check for f in check_inputs(evidence) if f.status is Status.FAIL] == named


@pytest.mark.parametrize(("model_sigma", "is_told"), [(0.015, True), (0.023, False)])
def test_a_step_within_the_noise_that_is_stated_is_unobservable_however_quiet_the_drive(model_sigma, is_told):
    step = contradiction(table.STEP, ("front", "rear"), 2, "from 9.0 s on", -0.048, 0.018, 1.5)
    evidence = replace(FINE, score_tests=(replace(step, model_sigma=model_sigma),))
    (finding,) = [f for f in check_inputs(evidence) if f.check == "position step"]
    assert finding.status is Status.PASS
    assert finding.is_unobservable is not is_told
    assert is_told or "below 9.2 cm" in finding.says


@pytest.mark.parametrize(("of_all", "is_told"), [(0.004, True), (0.03, False)])
def test_a_focal_length_that_both_cameras_may_share_unseen_is_unobservable(of_all, is_told):
    sigmas = {("front",): 0.001, ("rear",): 0.001, ("front", "rear"): of_all}
    tests = tuple(contradiction(table.FOCAL, who, 0, "", 0.001, sigma, 1.0) for who, sigma in sigmas.items())
    (finding,) = [f for f in check_inputs(replace(FINE, score_tests=tests)) if f.check == "focal length"]
    assert finding.status is Status.PASS
    assert finding.is_unobservable is not is_told
    assert is_told or "errors that all cameras share below 0.12" in finding.says


def test_a_rival_that_explains_as_much_is_named_as_well():
    survey = contradiction(table.SURVEY, ("front",), 0, "", 4.9, 0.1, 37.0)
    other = contradiction(table.SURVEY, ("rear",), 0, "", -4.7, 0.1, 36.99)
    finding = check_inputs(replace(FINE, score_tests=(survey, other)))[0]
    assert "front lies 490 cm ahead of its survey or the centre of rear" in finding.says


@pytest.mark.parametrize(("sigmas", "is_told"), [(3.72, True), (2.5, False)])
def test_an_input_that_may_well_be_wrong_is_a_warning(sigmas, is_told, drive):
    focal = contradiction(table.FOCAL, ("front", "rear"), 0, "", -0.024, 0.0057, sigmas)
    findings = raised(result(replace(FINE, score_tests=(replace(focal, gain=0.2),))), drive)
    assert [finding.status for finding in findings.values()] == [Status.WARN] * is_told
    assert not is_told or "2.4 % shorter" in findings["focal length"].says
    sure = replace(square_at(0.0, 0.0), covariance_m2=1e-6 * np.eye(8))
    (accuracy, *_) = check_goal(result(replace(FINE, score_tests=(focal,)), sure), 0.05, "poses")
    assert ("unless the focal length is off" in accuracy.says) is is_told


def test_stamps_that_jitter_explain_a_step_that_they_are_likelier_than_and_no_doubt_stands_beside_them():
    noisy = replace(FINE, pose_noise={"position_m": 2.0}, jitter_s=0.018, along_over_across=20.0)
    step = replace(
        contradiction(table.STEP, ("front", "rear"), 0, "from 9.0 s on", -0.09, 0.012, 5.0), gain=23.0
    )
    findings = [f for f in check_inputs(replace(noisy, score_tests=(step,))) if f.status is not Status.PASS]
    assert [(f.check, f.status) for f in findings] == [("image stamps", Status.FAIL)], "the noise does harm"
    scale = replace(contradiction(table.SCALE, ("front",), 0, "", -0.13, 0.025, 4.0), gain=13.5)
    findings = [f for f in check_inputs(replace(noisy, score_tests=(scale,))) if f.status is not Status.PASS]
    assert [(f.check, f.status) for f in findings] == [("image stamps", Status.WARN)]
    assert doubted(replace(noisy, score_tests=(scale,))) is None, "nor does the headline doubt it"
    assert doubted(replace(FINE, score_tests=(scale,))) == scale
    clock = replace(contradiction(table.CLOCK, ("front",), 0, "", 0.03, 0.002, 12.0), gain=72.0)
    findings = [f for f in check_inputs(replace(noisy, score_tests=(clock,))) if f.status is not Status.PASS]
    assert [f.check for f in findings] == ["clock", "image stamps"], "what is likelier than them is told"


@pytest.mark.parametrize(("value", "is_told"), [(0.0019, True), (0.0005, False)])
def test_an_error_is_doubted_by_how_probably_it_is_larger_than_what_matters(value, is_told):
    knock = contradiction(table.KNOCK, ("front",), 2, "from 9.0 s on", value, 0.0002, 5.4)
    findings = [f for f in check_inputs(replace(FINE, score_tests=(knock,))) if f.status is not Status.PASS]
    assert [(f.check, f.status) for f in findings] == [("mounting", Status.WARN)] * is_told


def test_a_doubt_names_every_cause_that_is_nearly_as_likely():
    focal = contradiction(table.FOCAL, ("front",), 1, "", -0.0077, 0.0019, 3.6)
    principal = contradiction(table.PRINCIPAL, ("front", "rear"), 0, "", -13.0, 3.8, 3.1)
    (doubt,) = [
        f for f in check_inputs(replace(FINE, score_tests=(focal, principal))) if f.status is Status.WARN
    ]
    assert "focal length fy of front is 0.8 % shorter" in doubt.says
    assert "or the principal point of front and rear lies -13 px" in doubt.says


@pytest.mark.parametrize(("count", "is_told"), [(1, False), (2, True)])
def test_causes_each_of_which_is_unlikely_are_doubted_together(count, is_told):
    tests = tuple(
        contradiction(table.SURVEY, (camera,), 0, "", 0.09, 0.026, 3.1)
        for camera in ("front", "rear")[:count]
    )
    assert 0.025 < probability_of_any(tests[:1]) < 0.05
    findings = [f for f in check_inputs(replace(FINE, score_tests=tests)) if f.status is not Status.PASS]
    assert [(f.check, f.status) for f in findings] == [("survey", Status.WARN)] * is_told
    assert all("front" in f.says and "rear" in f.says for f in findings)


@pytest.mark.parametrize("recorded", [Status.WARN, Status.FAIL])
@pytest.mark.parametrize(("is_curved", "is_tried"), [(True, True), (False, True), (False, False)])
def test_a_bend_of_the_recorded_heights_matters_as_the_map_s_ground_says(recorded, is_curved, is_tried):
    grid = np.zeros((2, 2))
    strip = GroundStrip(grid, grid, 0.5, np.zeros(2), grid, grid)
    mapped = replace(result(), hd_map=HDMap((), ground=(strip,) * is_curved))
    bends = Finding("road", recorded, 2.0, 1.0, "deg", "the ground bends by 0.2 m", "poses")
    (answer,) = over_ground([bends], mapped, is_tried)
    is_fine = is_curved or (is_tried and recorded is Status.WARN)
    assert (answer.status is Status.PASS) is is_fine
    assert (answer == bends) is not is_fine
    # So may images be that move otherwise than over a plane, unless by far.
    moves = replace(bends, check="poses against ground")
    (answer,) = over_ground([moves], mapped, is_tried)
    assert (answer.status is Status.PASS) is (is_curved and recorded is Status.WARN)


def test_a_small_contradiction_is_none_however_sure_it_is():
    tiny = replace(CLOCK, value=0.0008, sigma=0.0001, p_value=1e-15)
    assert all(f.status is Status.PASS for f in check_inputs(replace(FINE, score_tests=(tiny,))))


@pytest.mark.parametrize(
    ("sigmas", "says"),
    [
        (1.2, "the markings agree with the inputs, the largest deviation being 1.2 sigmas; they show errors"),
        (5.8, "the markings fit better if the focal length of front is 0.1 % longer than camera_info says "
              "(5.8 sigmas): too little to matter by itself; they show errors from 0.001"),
    ],
)  # fmt: skip
def test_a_check_that_passes_says_of_its_largest_deviation_what_it_is(sigmas, says):
    focal = contradiction(table.FOCAL, ("front",), 0, "", 0.0014, 0.00025, sigmas)
    (finding,) = [f for f in check_inputs(replace(FINE, score_tests=(focal,))) if f.check == "focal length"]
    assert finding.status is Status.PASS
    assert finding.says.startswith(says)
    # It is below the limit, or the limit is not what decides.
    assert (finding.limit is None) is (sigmas == 5.8)
    assert finding.limit is None or finding.value < finding.limit


def test_nothing_agrees_that_deviates_by_many_sigmas_however_rare_such_a_small_error_is():
    sure = contradiction(table.FOCAL, ("front",), 0, "", 0.00006, 0.00001, 5.8)
    (finding,) = [f for f in check_inputs(replace(FINE, score_tests=(sure,))) if f.check == "focal length"]
    assert finding.status is Status.PASS
    assert finding.limit is None or finding.value < finding.limit
    assert "agree" not in finding.says
    assert "too little to matter by itself" in finding.says


def test_a_warning_states_the_limit_that_it_is_beyond():
    focal = contradiction(table.FOCAL, ("front",), 1, "", -0.0077, 0.0019, 3.6)
    (warning,) = [f for f in check_inputs(replace(FINE, score_tests=(focal,))) if f.status is Status.WARN]
    assert warning.limit < warning.value


def test_a_straight_drive_says_what_it_cannot_tell():
    unsure = replace(FINE, score_tests=(replace(CLOCK, sigma=0.01), replace(LEVER, sigma=float("inf"))))
    unobservable = [f for f in check_inputs(unsure) if f.is_unobservable]
    assert {f.check for f in unobservable} == {"clock", "survey"}
    assert all("include a turn" in f.says for f in unobservable)
    (survey,) = (f for f in unobservable if f.check == "survey")
    assert "nothing checks the surveyed centres and the antenna" in survey.says
    slope = passed("slope", "all cameras", "include a turn")
    assert [f.check for f in Verdict.of([slope, *unobservable]).unobservable] == ["clock", "survey", "slope"]
    sure = replace(square_at(0.0, 0.0), covariance_m2=1e-6 * np.eye(8))
    for evidence, is_told in ((unsure, True), (FINE, False)):
        headline = Verdict.of(check_goal(result(evidence, sure), 0.05, "poses")).headline
        assert headline.startswith("PASS")
        assert ("if the clocks and the surveyed centres are right" in headline) is is_told
    unknown = replace(unsure, clock_m=0.2)
    headline = Verdict.of(check_goal(result(unknown, sure), 0.05, "poses")).headline
    assert "(if the surveyed centres are right, which this drive cannot show)" in headline


@pytest.mark.parametrize(
    ("check", "change"),
    [
        ("fit", {"variance_factor": 6.0}),
        ("foreign images", {"foreign": ForeignSegment(4.0, 8.0, 20.0)}),
        ("rejected", {"fits": {"front": replace(FIT, rejected_share=0.14)}}),
        ("held out", {"held_out": {"heave": 6.5}}),
        ("pose noise", {"pose_noise": {"heading_rad": 4.0}}),
        ("pose jump", {"worst_innovation": 20.0}),
    ],
)
def test_a_bad_fit_is_raised_by_its_own_check(check, change, drive):
    assert set(raised(result(replace(FINE, **change)), drive)) == {check}  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("share", "sightings", "is_wrong"),
    [
        (0.06, 28, False),  # a map of four markings
        (0.06, 88, False),
        (0.06, 1000, True),
        (0.14, 60, True),
        (0.01, 1000, False),
        (1.0, 6, True),
    ],
)
def test_a_share_of_rejected_corners_is_judged_by_how_many_sightings_it_is_of(
    share, sightings, is_wrong, drive
):
    fit = replace(FIT, rejected_share=share, sightings=float(sightings))
    findings = raised(result(replace(FINE, fits={"front": fit})), drive)
    assert set(findings) == ({"rejected"} if is_wrong else set())
    assert not is_wrong or findings["rejected"].value > findings["rejected"].limit


@pytest.mark.parametrize(
    ("candidates", "is_wrong"),
    [
        # Three dashes and two running boards, half of whose sightings are contradicted.
        ([(8, 0), (10, 0), (12, 0), (6, 4), (6, 3)], False),
        # As large a share of all, spread over forty markings alike.
        (40 * [(6, 1)], True),
        # Among forty markings two that stand, which a right camera meets.
        ([*38 * [(6, 0)], (6, 5), (6, 4)], False),
    ],
)
def test_rejected_corners_of_a_few_candidates_are_theirs_and_of_all_alike_the_cameras(
    candidates, is_wrong, drive
):
    by_candidate = np.array(candidates, dtype=np.float64)
    count, contradicted = by_candidate.sum(axis=0)
    share = float(contradicted / count)
    fit = replace(FIT, rejected_share=share, sightings=float(count), by_candidate=by_candidate)
    findings = raised(result(replace(FINE, fits={"front": fit})), drive)
    assert set(findings) == ({"rejected"} if is_wrong else set())


def test_markings_that_overlap_are_told_with_a_place_and_neighbours_are_no_doubles(drive):
    squares = [square_at(3.0 * n, 0.0) for n in range(12)]
    findings = raised(result(FINE, *squares, square_at(6.4, 0.2)), drive)
    assert set(findings) == {"double markings"}
    assert "(6.5, 0.5)" in findings["double markings"].says
    other = replace(square_at(0.4, 0.0), kind="stop_line")
    assert raised(result(FINE, square_at(0.0, 0.0), square_at(1.0, 0.0), other), drive) == {}
    for reason, is_told in (("odd shape", True), (LACKS_A_CORNER, False)):
        left_out = tuple(Exclusion("diamond", np.zeros(2), 3, reason) for _ in range(12))
        assert set(raised(result(excluded=left_out), drive)) == ({"excluded"} if is_told else set())


def calibrated(yaw_deg):
    covariance = np.diag([1e-4] * 3 + [1e-8] * 3)
    return Calibration(INFO, mounted((1.0, 0.0, 2.4), 15.0, yaw_deg), covariance)


def test_maps_of_two_cameras_that_are_apart_along_the_route_are_told(drive):
    calibrations = {"front": calibrated(0.0), "rear": calibrated(180.0)}
    ahead = drive.images[0].map_from_vehicle[:2, 0] * 0.3
    front = tuple(square_at(3.0 * n, 0.0) for n in range(12))
    rear = tuple(replace(m, corners_map=m.corners_map + ahead) for m in front)
    alone = {
        "front": result(FINE, *front, cameras=("front",), calibrations=calibrations),
        "rear": result(FINE, *rear, cameras=("rear",), calibrations=calibrations),
    }
    together = result(FINE, *front, calibrations=calibrations, alone=alone)
    findings = [f for f in check_solution(drive, together) if f.status is not Status.PASS]
    assert [f.check for f in findings] == ["cameras apart"]
    assert "30 cm ahead of where front does" in findings[0].says


def test_a_mounting_that_differs_alone_and_together_is_told(drive):
    alone = {"front": result(cameras=("front",), calibrations={"front": calibrated(0.2)})}
    together = result(calibrations={"front": calibrated(0.0)}, alone=alone)
    checks = [f.check for f in check_solution(drive, together) if f.status is not Status.PASS]
    assert checks == ["alone and together"]


COUNT = 12


def found(seed, off_m):
    """A map in error as it states, and check points that are off by ``off_m`` (12, 2) more than stated."""
    rng, truth = np.random.default_rng(seed), yard()
    points = [
        point(*(truth.markings[k].corners_map[k % 4] + SURVEY_M * rng.standard_normal(2) + off_m[k]), f"P{k}")
        for k in range(COUNT)
    ]
    return check_points(checked(yard(rng), *points))


def test_maps_as_good_as_they_state_are_contradicted_as_seldom_as_the_test_says():
    raised = [found(seed, np.zeros((COUNT, 2))).status is not Status.PASS for seed in range(400)]
    assert SIGNIFICANCE * 400 < 1
    assert sum(raised) <= 3


ONE_OFF = np.where(np.arange(COUNT)[:, None] == 7, [0.15, 0.0], 0.0)


@pytest.mark.parametrize(
    ("off_m", "status", "says"),
    [
        (ONE_OFF, Status.WARN, "^P7 lies .*the others where they should"),
        (np.tile([0.15, -0.13], (COUNT, 1)), Status.FAIL, "another datum or origin"),
        (np.random.default_rng(5).normal(0, 0.05, (COUNT, 2)), Status.FAIL, "the map is worse than stated"),
    ],
    ids=["one point", "all alike", "a worse map"],
)
def test_points_that_are_off_name_the_cause(off_m, status, says):
    finding = found(1, off_m)
    assert finding.status is status
    assert re.search(says, finding.says)
    assert finding.value > finding.limit


def test_points_that_the_map_has_nowhere_are_told_with_the_distance():
    (finding,) = check_frame({"": 0, "with x_m and y_m swapped": 0})
    assert finding.status is Status.WARN
    assert "no corner of the map has a surveyed point within reach" in finding.says
    finding = check_points(checked(yard(), point(30.5, 8.0, "Q1")))
    assert finding.status is Status.WARN
    assert re.search("none of 1.*7.02 m away", finding.says)


@pytest.mark.parametrize(
    ("counts", "status"),
    [
        ({"": 9, "with x_m and y_m swapped": 1}, Status.PASS),
        ({"": 1, "with x_m and y_m swapped": 7, "in feet": 2}, Status.WARN),
        ({"": 3}, Status.PASS),
    ],
)
def test_a_survey_that_fits_better_when_read_otherwise_is_told_how(counts, status):
    (finding,) = check_frame(counts)
    assert finding.status is status
    assert ("7 would with x_m and y_m swapped" in finding.says) is (status is Status.WARN)
