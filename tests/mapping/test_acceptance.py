"""Each rule of acceptance refuses what it is meant for, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from v2hdm.mapping.markings.acceptance import Candidates, judge
from v2hdm.mapping.options import AcceptanceOptions
from v2hdm.records import CORNERED_CLASSES, LANE_DASH

DIAMOND = np.array([[0.6, 0.0], [0.0, 0.3], [-0.6, 0.0], [0.0, -0.3]])
COUNT = 12


def row_of_diamonds() -> Candidates:
    """Twelve sound diamonds, five metres apart."""
    return Candidates(
        kind=np.zeros(COUNT, dtype=np.int64),
        corners_map=DIAMOND + np.arange(COUNT)[:, None, None] * np.array([5.0, 0.0]),
        completed=np.zeros(COUNT, dtype=bool),
        sigma_m=np.full(COUNT, 0.01),
        sightings=np.full(COUNT, 10),
        inlier_share=np.ones(COUNT),
        easy_views=np.full(COUNT, 8),
        easy_detections=np.full(COUNT, 8),
    )


def refused(candidates: Candidates) -> dict[int, str]:
    verdict = judge(candidates, AcceptanceOptions())
    return {group: reason for group, reason in enumerate(verdict) if reason is not None}


def test_sound_markings_are_all_accepted() -> None:
    assert refused(row_of_diamonds()) == {}


def test_a_marking_seen_twice_is_refused() -> None:
    sound = row_of_diamonds()
    sound.sightings[3] = 2
    assert list(refused(sound)) == [3]


def test_a_marking_with_a_missing_corner_is_refused() -> None:
    sound = row_of_diamonds()
    sound.corners_map[4, 1] = np.nan
    assert refused(sound) == {4: "a corner was never seen twice"}


def test_a_corner_may_be_implied_where_the_shape_is_known() -> None:
    sound = row_of_diamonds()
    sound.completed[4] = True
    assert refused(sound) == {}


def test_a_corner_may_not_be_implied_where_no_other_has_such_a_shape() -> None:
    sound = row_of_diamonds()
    for group in range(COUNT):
        sound.corners_map[group] = sound.corners_map[group].mean(axis=0) + 1.3**group * DIAMOND / 8
    sound.completed[4] = True
    assert refused(sound) == {4: "a corner was never seen twice"}


def test_contradictory_sightings_are_refused() -> None:
    sound = row_of_diamonds()
    sound.inlier_share[0] = 0.3
    assert refused(sound) == {0: "its sightings contradict each other"}


def test_a_worn_marking_of_known_shape_is_accepted_although_few_images_show_it() -> None:
    sound = row_of_diamonds()
    sound.easy_detections[7] = 1
    assert refused(sound) == {}


def test_without_a_known_shape_what_most_of_its_images_do_not_show_is_refused() -> None:
    sound = row_of_diamonds()
    for group in range(COUNT):
        sound.corners_map[group] = sound.corners_map[group].mean(axis=0) + 1.3**group * DIAMOND / 8
    sound.easy_detections[7] = 1
    assert refused(sound) == {7: "found in too few of its images"}


def test_seldom_seen_is_no_fault_where_there_were_few_chances() -> None:
    sound = row_of_diamonds()
    sound.easy_views[7], sound.easy_detections[7] = 4, 0
    assert refused(sound) == {}


def test_a_marking_twice_as_large_as_all_others_is_refused() -> None:
    sound = row_of_diamonds()
    sound.corners_map[5] = sound.corners_map[5].mean(axis=0) + 2 * DIAMOND
    assert refused(sound) == {5: "not shaped like the others of its class"}


def test_a_class_of_mixed_shapes_has_no_consensus_to_stray_from() -> None:
    sound = row_of_diamonds()
    for group in range(COUNT):
        sound.corners_map[group] = sound.corners_map[group].mean(axis=0) + 1.3**group * DIAMOND / 8
    assert refused(sound) == {}


def test_dashes_of_two_widths_are_two_shapes_and_not_outliers() -> None:
    sound = row_of_diamonds()
    for group in range(0, COUNT, 3):
        sound.corners_map[group] = sound.corners_map[group].mean(axis=0) + [1.0, 2.0] * DIAMOND
    assert refused(sound) == {}


def test_a_shift_that_all_markings_share_speaks_against_none() -> None:
    sound = row_of_diamonds()
    assert refused(replace(sound, sigma_m=np.full(COUNT, 0.4))) == {}


def test_of_two_markings_on_one_spot_the_better_supported_stays() -> None:
    sound = row_of_diamonds()
    sound.corners_map[2] = sound.corners_map[1] + [0.1, 0.0]
    sound.sightings[2] = 4
    assert refused(sound) == {2: "lies on a better supported marking"}


def test_an_uncertain_marking_is_refused() -> None:
    sound = row_of_diamonds()
    assert list(refused(replace(sound, sigma_m=np.where(np.arange(COUNT) == 6, 0.5, 0.01)))) == [6]


def test_the_shaft_of_an_arrow_is_refused_where_other_images_show_the_arrow() -> None:
    sound = row_of_diamonds()
    seen_as_symbol = np.zeros(COUNT, dtype=np.int64)
    seen_as_symbol[[2, 7]] = 1, 4
    dashes = replace(sound, kind=np.full(COUNT, CORNERED_CLASSES.index(LANE_DASH)))
    judged = replace(dashes, seen_as_symbol=seen_as_symbol)
    assert refused(judged) == {7: "part of an arrow or a chevron"}, "one image may err"


def test_a_diamond_like_the_others_stays_one_whatever_some_images_take_it_for() -> None:
    sound = row_of_diamonds()
    seen_as_symbol = np.zeros(COUNT, dtype=np.int64)
    seen_as_symbol[[2, 7]] = 4
    sound.corners_map[7] = sound.corners_map[7].mean(axis=0) + 1.6 * DIAMOND
    judged = replace(sound, seen_as_symbol=seen_as_symbol)
    assert list(refused(judged)) == [7], "the odd one is refused, not the typical one"


def test_the_head_of_an_arrow_is_refused_even_if_it_is_like_the_diamonds() -> None:
    sound = row_of_diamonds()
    seen_as_symbol = np.zeros(COUNT, dtype=np.int64)
    seen_as_symbol[[2, 7]] = sound.sightings[2] - 1, sound.sightings[7]
    judged = replace(sound, seen_as_symbol=seen_as_symbol)
    assert refused(judged) == {7: "part of an arrow or a chevron"}


def test_a_head_that_few_images_show_with_its_arrow_is_refused_if_most_do_not_show_it_alone() -> None:
    sound = row_of_diamonds()
    seen_as_symbol, easy_detections = np.zeros(COUNT, dtype=np.int64), sound.easy_detections.copy()
    seen_as_symbol[[2, 5, 7]] = 2, 1, 2
    easy_detections[[5, 7, 8]] = sound.easy_views[7] // 2 - 1
    judged = replace(sound, seen_as_symbol=seen_as_symbol, easy_detections=easy_detections)
    assert refused(judged) == {7: "part of an arrow or a chevron"}
