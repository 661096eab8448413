"""Of several readings of one place, the surest is believed."""

import numpy as np

from v2hdm.detection.corners.rivals import surest_readings

SQUARE = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])


def shifted(right: float) -> np.ndarray:
    return SQUARE + np.array([right, 0.0])


def believed(*readings: tuple[np.ndarray, int, float]) -> list[bool]:
    """Which of (corners, plane, score) are believed."""
    corners, plane, score = zip(*readings, strict=True)
    return surest_readings(np.stack(corners), np.array(plane), np.array(score)).tolist()


def test_the_surer_of_two_readings_of_one_place_is_believed_whichever_way_round_they_run() -> None:
    assert believed((SQUARE, 0, 0.4), (SQUARE + 1.0, 1, 0.6)) == [False, True]
    assert believed((SQUARE, 0, 0.6), (SQUARE[::-1] + 1.0, 1, 0.4)) == [True, False]
    assert believed((SQUARE, 0, 0.5), (SQUARE, 1, 0.5)) == [True, False], "of equals the first"


def test_readings_of_different_places_are_both_believed() -> None:
    assert believed((SQUARE, 0, 0.4), (shifted(12.0), 1, 0.6)) == [True, True]
    assert believed((SQUARE, 0, 0.4), (shifted(9.0), 1, 0.6)) == [True, True], "they hardly overlap"


def test_blobs_of_one_reading_do_not_contradict_each_other() -> None:
    assert believed((SQUARE, 0, 0.4), (SQUARE + 1.0, 0, 0.6)) == [True, True]


def test_a_sure_whole_takes_the_place_of_its_parts_and_sure_parts_that_of_the_whole() -> None:
    left, right = SQUARE * [0.45, 1.0], SQUARE * [0.45, 1.0] + np.array([5.5, 0.0])
    assert believed((left, 0, 0.5), (right, 0, 0.4), (SQUARE, 2, 0.9)) == [False, False, True]
    assert believed((left, 1, 0.9), (right, 1, 0.8), (SQUARE, 0, 0.7)) == [True, True, False]


def test_what_is_contradicted_contradicts_nothing() -> None:
    chain = (SQUARE, 0, 0.9), (shifted(5.0), 1, 0.8), (shifted(10.0), 2, 0.7)
    assert believed(*chain) == [True, False, True]


def test_corners_that_are_nowhere_contradict_nothing() -> None:
    assert believed((SQUARE, 0, 0.4), (np.full((4, 2), np.nan), 1, 0.6)) == [True, True]
