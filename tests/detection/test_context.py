"""What the other markings of an image say of one: those of the same stencil speak for it."""

import numpy as np
import pytest

from v2hdm.detection.classifier import COMPANY, classify_among, company
from v2hdm.records import DIAMOND, LANE_DASH, FloatArray


def diamond(x: float, y: float, length: float = 1.2, width: float = 0.8) -> FloatArray:
    return np.array([[x + length / 2, y], [x, y + width / 2], [x - length / 2, y], [x, y - width / 2]])


def dash(x: float, y: float, length: float = 2.0, heading: float = 0.0) -> FloatArray:
    along, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    box = np.array([[-1, -0.075], [1, -0.075], [1, 0.075], [-1, 0.075]]) * [length / 2, 1.0]
    return box[:, :1] * along + box[:, 1:] * left + (x, y)


def reported(ground: list[FloatArray], kinds: list[str], probability: list[float]) -> dict[str, FloatArray]:
    columns = company(np.stack(ground), kinds, np.array(probability)).T
    return dict(zip(COMPANY, columns, strict=True))


def test_diamonds_of_one_stencil_are_alike_and_others_are_not() -> None:
    small, across = diamond(8, 0, 0.6, 0.4), diamond(10, 0, 0.8, 1.2)
    said = reported([diamond(4, 0), diamond(6, 0), small, across], [DIAMOND] * 4, [0.9, 0.8, 0.5, 0.25])
    assert said["alike"][:2] == pytest.approx([0.8, 0.9], abs=1e-3)
    assert said["most_alike"] == pytest.approx([0.8, 0.9, 0.0, 0.0], abs=0.01)
    assert said["unlike"][0] == pytest.approx(0.75, abs=0.01)
    assert said["surest_other"].tolist() == [0.8, 0.9, 0.9, 0.9]


def test_neither_another_class_nor_another_reading_of_the_same_paint_is_company() -> None:
    said = reported([diamond(4, 0), diamond(4.1, 0), dash(6, 0)], [DIAMOND, DIAMOND, LANE_DASH], [0.9] * 3)
    assert not any(column.any() for column in said.values())


def test_a_dash_has_others_in_its_line_after_a_gap_only() -> None:
    for other, in_line in (
        (dash(9, 0), 0.9),
        (dash(6.5, 0), 0.0),  # goes on where it ends
        (dash(9, 1.0), 0.0),
        (dash(9, 0, heading=0.5), 0.0),
        (dash(29, 0), 0.0),
    ):
        assert reported([dash(4, 0), other], [LANE_DASH] * 2, [0.5, 0.9])["in_line"][0] == in_line
    assert not reported([diamond(4, 0), diamond(9, 0)], [DIAMOND] * 2, [0.5, 0.9])["in_line"].any()


def test_a_row_of_dashes_may_be_an_arc() -> None:
    def on_circle(metres: float, turned: float = 0.0) -> FloatArray:
        angle = metres / 15
        return dash(15 * np.sin(angle), 15 - 15 * np.cos(angle), 3.0, angle + turned)

    for other, in_line in (
        (on_circle(6), 0.9),
        (on_circle(-6), 0.9),
        (on_circle(6, np.pi), 0.9),  # axes have no sense of direction
        (on_circle(6, 0.3), 0.0),
        (on_circle(6, -0.4), 0.0),
        (on_circle(4), 0.0),
    ):
        assert reported([on_circle(0), other], [LANE_DASH] * 2, [0.5, 0.9])["in_line"][0] == in_line


def test_diamonds_far_apart_may_be_turned_by_a_bend() -> None:
    def turned(x: float, angle: float) -> FloatArray:
        around = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        return (diamond(0, 0) @ around) + (x, 0)

    near = reported([diamond(4, 0), turned(6, 0.5)], [DIAMOND] * 2, [0.5, 0.9])["most_alike"][0]
    far = reported([diamond(4, 0), turned(16, 0.5)], [DIAMOND] * 2, [0.5, 0.9])["most_alike"][0]
    assert near < 0.05
    assert far > 0.6


def test_one_that_is_alone_or_above_the_horizon_has_no_company() -> None:
    assert not company(diamond(4, 0)[None], [DIAMOND], np.array([0.9])).any()
    above = np.full((4, 2), np.nan)
    assert np.isfinite(company(np.stack([above, diamond(4, 0)]), [DIAMOND] * 2, np.array([0.9, 0.9]))).all()


def test_a_doubtful_diamond_is_believed_among_others_like_it() -> None:
    odds, kinds = np.array([0.5, 4.0, 4.0, 4.0]), [DIAMOND] * 4
    field = np.stack([diamond(4.0 + 3 * k, 0) for k in range(4)])
    mixed = field.copy()
    mixed[1:] = 4 + 0.4 * (mixed[1:] - 4)
    among, apart = (classify_among(odds, ground, kinds)[0] for ground in (field, mixed))
    assert 1 - apart > 2 * (1 - among)
