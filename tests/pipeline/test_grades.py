"""Accuracy is a grade by the goal, of everything that was mapped, and one key says what to leave out."""

from dataclasses import replace

import numpy as np
import pytest

from tests.verdict.drives import square_at
from v2hdm.errors import ConfigError, MappingError
from v2hdm.io.maps.corrections import ACCEPTED, REJECTED, Correction
from v2hdm.io.maps.evidence import Residuals
from v2hdm.io.maps.features import features_of
from v2hdm.mapping.options import MappingOptions
from v2hdm.mapping.results import MethodResult
from v2hdm.pipeline.grades import accurate_enough, graded_sets, of_all_grades, with_composed, without_worse
from v2hdm.pipeline.map_drive import map_drive
from v2hdm.pipeline.stages import MappedSet
from v2hdm.records import ACCURACIES, SIGMAS_95, HDMap, Lane, Symbol
from v2hdm.site.accuracy import LEFT_OUT_BY_GRADE, accuracy_of, corner_radii_m, objection_to
from v2hdm.site.markings import Suspicion
from v2hdm.site.options import AcceptanceOptions
from v2hdm.survey.run import Survey

GOAL_M = 0.05
OUTLINE = np.array([[0.0, 0.0], [1.0, 0.0], [0.5, 1.0]])


def marking(number, radius_m, corner=2):
    """A marking with one corner known to that 95 % radius, and all others exactly."""
    covariance = np.zeros((8, 8))
    rows = slice(2 * corner, 2 * corner + 2)
    covariance[rows, rows] = np.eye(2) * (radius_m / SIGMAS_95) ** 2
    return replace(square_at(3.0 * number, 0.0), covariance_m2=covariance)


def arrow(radius_m):
    return Symbol("arrow", OUTLINE, 4, covariance_m2=np.eye(6) * (radius_m / SIGMAS_95) ** 2)


def mapped():
    """Markings of grades A, C, B and of unknown accuracy, a lane, and arrows of grades A and C."""
    markings = [marking(number, radius_m) for number, radius_m in enumerate((0.02, 0.2, 0.08))]
    unknown = square_at(30.0, 0.0)
    lane = Lane("lane_line", np.array([[0.0, 0.0], [9.0, 0.0]]), 5)
    hd_map = HDMap((*markings, unknown), (lane,), None, (arrow(0.01), arrow(0.3)))
    count = len(hd_map.markings)
    residuals = Residuals(
        image=("front/0.png",),
        camera=("front",),
        taken_s=np.zeros(1),
        row_image=np.zeros(count, dtype=np.int64),
        marking=np.arange(1, count + 1),
        corner=np.zeros(count, dtype=np.int64),
        is_point=np.ones(count, dtype=bool),
        observed_px=np.zeros((count, 2)),
        residual_px=np.zeros((count, 2)),
        distance_sigma=np.zeros(count),
    )
    suspicions = [Suspicion(number, 0.1, 0.1, 0.1, 0.0) for number in (2, 3)]
    result = MethodResult("Opt", ("front",), hd_map, residuals=residuals, suspicions=suspicions)
    return graded_sets({"front": MappedSet({"Opt": result})}, GOAL_M)["front"].methods["Opt"]


def grades(hd_map):
    return [paint.accuracy for paint in (*hd_map.markings, *hd_map.symbols)]


@pytest.mark.parametrize(
    ("radius_m", "grade"),
    [(0.0, "A"), (0.0495, "A"), (0.0505, "B"), (0.0995, "B"), (0.1005, "C"), (9.0, "C")],
)
@pytest.mark.parametrize("corner", range(4))
def test_the_grade_is_that_of_the_worst_corner_by_the_goal_and_twice_the_goal(radius_m, grade, corner):
    assert accuracy_of(marking(0, radius_m, corner).covariance_m2, GOAL_M) == grade
    assert accuracy_of(marking(0, 2 * radius_m, corner).covariance_m2, 2 * GOAL_M) == grade


def test_what_states_no_covariance_has_no_grade_and_is_not_left_out_for_it():
    assert accuracy_of(None, GOAL_M) is None
    assert objection_to(None, "A") is None


def test_a_symbol_has_a_radius_at_every_vertex():
    radii_m = corner_radii_m(np.diag([1.0, 1.0, 4.0, 4.0, 9.0, 9.0]))
    np.testing.assert_allclose(radii_m, SIGMAS_95 * np.array([1.0, 2.0, 3.0]), rtol=2e-3)


def test_everything_that_was_mapped_is_graded_anew_by_the_goal_of_the_run():
    result = mapped()
    assert grades(result.hd_map) == ["A", "C", "B", None, "A", "C"]
    strict = graded_sets({"front": MappedSet({"Opt": result, "ENI": result})}, GOAL_M / 4)["front"].methods
    assert grades(strict["Opt"].hd_map) == grades(strict["ENI"].hd_map) == ["B", "C", "C", None, "A", "C"]


def test_an_earlier_grade_goes_where_the_covariance_is_gone():
    result = mapped()
    redrawn = replace(result.hd_map.markings[0], covariance_m2=None)
    result = replace(result, hd_map=replace(result.hd_map, markings=(redrawn,)))
    assert redrawn.accuracy == "A"
    (again,) = (
        graded_sets({"front": MappedSet({"Opt": result})}, GOAL_M)["front"].methods["Opt"].hd_map.markings
    )
    assert again.accuracy is None


@pytest.mark.parametrize(
    ("least_accuracy", "left"),
    [("A", ["A", None, "A"]), ("B", ["A", "B", None, "A"]), ("C", ["A", "C", "B", None, "A", "C"])],
)
def test_what_is_of_a_worse_grade_than_asked_is_left_out_with_its_reason(least_accuracy, left):
    result = mapped()
    chosen = without_worse(result, least_accuracy)
    assert grades(chosen.hd_map) == left
    reasons = [exclusion.reason for exclusion in chosen.excluded]
    assert len(reasons) == len(grades(result.hd_map)) - len(left)
    assert set(reasons) <= LEFT_OUT_BY_GRADE
    if least_accuracy == "B":
        assert set(reasons) == {"accuracy C, and mapping.acceptance.accuracy asks for B"}
        places = [exclusion.position_map for exclusion in chosen.excluded]
        np.testing.assert_allclose(
            places, [square_at(3.0, 0.0).corners_map.mean(axis=0), OUTLINE.mean(axis=0)]
        )
        assert [exclusion.kind for exclusion in chosen.excluded] == ["diamond", "arrow"]


def test_what_stays_keeps_the_id_of_the_whole_map_and_the_evidence_follows():
    result = mapped()
    whole_ids = [feature.id for feature in features_of(result.hd_map)]
    chosen = without_worse(result, "B")
    assert whole_ids == [1, 2, 3, 4, 5, 6, 7]
    assert [feature.id for feature in features_of(chosen.hd_map)] == [1, 3, 4, 5, 6]
    assert chosen.hd_map.largest_id == 7
    np.testing.assert_array_equal(chosen.residuals.marking, [1, 0, 3, 4])
    assert [suspicion.marking for suspicion in chosen.suspicions] == [3]


def test_a_give_way_line_has_the_first_id_of_its_pieces_and_all_others_keep_theirs():
    result = mapped()
    markings = list(result.hd_map.markings)
    pieces = np.array([[3.8, -0.25], [4.2, -0.25], [4.2, 0.25], [3.8, 0.25]])
    for number in (0, 1, 3):
        corners = pieces + np.array([0.0, 0.75 * number])
        markings[number] = replace(markings[number], kind="stop_line", corners_map=corners)
    markings[3] = replace(markings[3], corners_map=pieces + np.array([0.0, 1.5]))
    result = replace(result, hd_map=replace(result.hd_map, markings=tuple(markings)))
    composed = with_composed({"front": {"Opt": result}}, GOAL_M)["front"]["Opt"]
    assert [(marking.kind, marking.variety, marking.id) for marking in composed.hd_map.markings] == [
        ("diamond", None, 3),
        ("stop_line", "give_way", 1),
    ]
    assert [feature.id for feature in features_of(composed.hd_map)] == [3, 1, 5, 6, 7]
    np.testing.assert_array_equal(composed.residuals.marking, [1, 0, 3, 0])
    assert [suspicion.marking for suspicion in composed.suspicions] == [3]


def test_a_map_of_which_nothing_would_be_left_is_one_line_that_says_what_to_ask_for():
    result = mapped()
    coarse = replace(result, hd_map=replace(result.hd_map, markings=result.hd_map.markings[1:3]))
    with pytest.raises(MappingError, match=r"none of 2 markings is of accuracy A, .*best are of accuracy B"):
        accurate_enough({"front": {"Opt": coarse}}, "A")
    one_camera = {"front": {"Opt": coarse}, "both": {"Opt": result}}
    assert not accurate_enough(one_camera, "A")["front"]["Opt"].hd_map.markings


def test_maps_in_the_cache_are_the_same_whatever_grade_is_asked_for():
    surveys = [Survey(MappingOptions(acceptance=AcceptanceOptions(accuracy=grade))) for grade in ACCURACIES]
    assert len({repr(of_all_grades(survey)) for survey in surveys}) == 1


def test_a_grade_that_does_not_exist_is_refused_before_anything_is_read():
    options = MappingOptions(acceptance=AcceptanceOptions(accuracy="D"))
    with pytest.raises(ConfigError, match=r"^mapping.acceptance.accuracy is 'D'; choose from A, B or C.$"):
        map_drive("no such drive", options=options)


def test_what_a_person_accepted_stays_however_well_it_is_known():
    coarse = mapped().hd_map.markings[1]
    arrows = mapped().hd_map.symbols
    said = [
        Correction(says=ACCEPTED, kind=coarse.kind, outline_map=coarse.corners_map.tolist()),
        Correction(says=REJECTED, kind="arrow", outline_map=arrows[1].outline_map.tolist()),
    ]
    left = without_worse(mapped(), "A", said)
    assert [marking.accuracy for marking in left.hd_map.markings] == ["A", "C", None]
