"""The table of surveyed points: what is read, and what is refused in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.calibration.site import INFO, PLACES, clicked, write_table
from v2hdm.calibration.from_points import calibrate_from_points
from v2hdm.calibration.points import check_points, read_points
from v2hdm.errors import DriveError
from v2hdm.verdict import Status


@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
def test_columns_come_in_any_order_and_with_any_separator(tmp_path: Path, separator: str) -> None:
    rows = [
        ("x_m", "U", "name", "y_m", "v"),
        *((x, u, f"P{n}", y, v) for n, (u, v, x, y) in enumerate(TABLE)),
    ]
    path = tmp_path / "points.csv"
    path.write_text("\ufeff" + "\n".join(separator.join(map(str, row)) for row in rows) + "\n\n# the end\n")
    points = read_points(path)
    np.testing.assert_array_equal(np.column_stack([points.points_px, points.points_vehicle]), TABLE)
    assert points.names[1] == "point P1 (line 3)"
    assert points.labels[:2] == ("P0", "P1")


TABLE = [(10.5, 20.0, 5.0, 1.0), (30.0, 20.5, 5.0, -1.0), (12.0, 12.0, 9.0, 1.5), (28.0, 12.25, 9.0, -1.5)]
TEXT = "u,v,x,y\n" + "".join(",".join(map(str, row)) + "\n" for row in TABLE)

MISTAKES = {
    "empty": ("", "is empty; expected the columns u, v, x, y"),
    "three": ("\n".join(TEXT.splitlines()[:4]), "3 points; 4 barely fix a camera"),
    "no header": (TEXT.split("\n", 1)[1], "no column 'u'; the first line must name u, v, x, y"),
    "millimetres by name": (TEXT.replace("x,y", "x_mm,y_mm"), "no column 'x'; .* it says: u, v, x_mm, y_mm"),
    "twice": (TEXT.replace("u,v", "u,u"), "more than one column 'u'"),
    "height": (
        TEXT.replace("x,y", "x,y,z").replace("0\n", "0,0\n").replace("5\n", "5,0\n"),
        "column 'z' is not",
    ),
    "nan": (TEXT.replace("30.0", "nan"), "line 3: u: 'nan' is not a finite number; drop or mend"),
    "words": (TEXT.replace("30.0", "left"), "line 3: u: 'left' is not a number; mend that line"),
    "decimal comma": (
        TEXT.replace(",", ";").replace("10.5", "10,5"),
        "line 2: u: '10,5' is not a number; write a decimal point",
    ),
    "short line": (TEXT.replace("30.0,", ""), "line 3: 3 cells under 4 columns"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_wrong_table_is_one_line_with_the_place(tmp_path: Path, mistake: str) -> None:
    text, expected = MISTAKES[mistake]
    (tmp_path / "points.csv").write_text(text)
    with pytest.raises(DriveError, match=expected) as caught:
        read_points(tmp_path / "points.csv")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda px, places: px.__setitem__(3, (1300.0, 400.0)), r"point P4 .* \(1300, 400\) lies outside"),
        (lambda px, places: px.__setitem__(3, (-1.0, 400.0)), "lies outside the image of 1280 x 720; mend"),
        (lambda px, places: px.__setitem__(3, px[6]), "P4 .* and point P7 .* have the same pixel"),
        (lambda px, places: places.__setitem__(3, places[6]), "P4 .* have the same place on the ground"),
        (lambda px, places: px.__setitem__(slice(None), px[:, ::-1].copy()), "u and v look exchanged"),
    ],
)
def test_points_outside_the_image_and_repeated_ones_are_named(tmp_path, change, expected) -> None:
    px, places = clicked(seed=3)
    change(px, places)
    points = read_points(write_table(tmp_path, px, places))
    with pytest.raises(DriveError, match=expected) as caught:
        check_points(points, INFO)
    assert "\n" not in str(caught.value)


def test_good_points_pass(tmp_path: Path) -> None:
    check_points(read_points(write_table(tmp_path, *clicked(seed=3))), INFO)
    assert len(PLACES) == 10


def test_a_calibration_from_points_is_data_and_writes_nothing(tmp_path: Path) -> None:
    found = calibrate_from_points(write_table(tmp_path, *clicked(seed=3)), INFO)
    assert found.verdict.status is Status.PASS
    assert found.calibration.covariance is not None
    assert len(found.roi_vehicle) >= 3
    assert [path.name for path in tmp_path.iterdir()] == ["points.csv"]
