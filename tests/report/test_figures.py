"""Figures are files that can be read back, with something drawn in them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from tests.report.scene import diamond_at, make_truth
from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.records import HdMap
from v2hdm.report import figures, style
from v2hdm.report.figures import save_birdseye, save_growth
from v2hdm.report.photos import save_overlay
from v2hdm.report.terminal import METHODS, results_table


def test_the_birds_eye_view_is_drawn_with_and_without_truth(tmp_path: Path) -> None:
    _, truth = make_truth()
    maps = {"CNI": HdMap((diamond_at(10.1, 0),)), "Opt": HdMap((diamond_at(10, 0),), truth.map.lanes)}
    route = truth.map_from_vehicle[:, :2, 3]
    for name, known in (("with.png", truth), ("without.png", None)):
        save_birdseye(tmp_path / name, maps, "Opt", route, known)
        image = cv2.imread(str(tmp_path / name))
        assert image is not None
        assert image.std() > 5.0


def test_no_unfinished_figure_stays_behind(tmp_path: Path) -> None:
    save_growth(tmp_path / "growth.png", {"CNI": [(1, 0.2), (10, 0.1)], "Opt": [(1, 0.1), (10, 0.02)]})
    assert [p.name for p in tmp_path.iterdir()] == ["growth.png"]


def test_the_overlay_draws_the_marking_where_the_camera_sees_it(tmp_path: Path) -> None:
    drive, _ = make_truth()
    info = drive.cameras["front"].info
    # 2 m above the ground, optical axis level and forward: ground at (10, 0) projects to v = 240 + 100.
    cam_from_vehicle = np.array([[0.0, -1, 0, 0], [0, 0, -1, 2.0], [1, 0, 0, 0], [0, 0, 0, 1]])
    views = {"Opt": np.linalg.inv(ipm_from_extrinsic(info, cam_from_vehicle))}
    black = np.zeros((480, 640, 3), np.uint8)
    save_overlay(tmp_path / "overlay.png", black, info, HdMap((diamond_at(10, 0),)), np.zeros(2), views)
    drawn = cv2.imread(str(tmp_path / "overlay.png"))
    assert len(drawn) > 480  # the legend stands below
    drawn = drawn[:480].any(axis=2)
    rows, columns = np.nonzero(drawn)
    assert abs(columns.mean() - 320) < 2
    assert 240 + 1000 / 10.5 - 3 <= rows.min() <= rows.max() <= 240 + 1000 / 9.5 + 3


def test_before_and_after_differ_in_dashes_and_not_in_colour_alone(tmp_path: Path) -> None:
    drive, truth = make_truth()
    info = drive.cameras["front"].info
    cam_from_vehicle = np.array([[0.0, -1, 0, 0], [0, 0, -1, 2.0], [1, 0, 0, 0], [0, 0, 0, 1]])
    lane = HdMap((), truth.map.lanes)
    view = np.linalg.inv(ipm_from_extrinsic(info, cam_from_vehicle))
    covered = {}
    for name in ("ENI", "Opt"):
        black = np.zeros((480, 640, 3), np.uint8)
        save_overlay(tmp_path / "a.png", black, info, lane, np.zeros(2), {name: view})
        covered[name] = np.count_nonzero(cv2.imread(str(tmp_path / "a.png"))[:480].max(axis=2) > 60)
    assert 0.3 < covered["ENI"] / covered["Opt"] < 0.85


def test_every_method_has_a_line_style_and_a_marker_of_its_own() -> None:
    for look in (style.LINE, style.MARKER, style.METHOD):
        assert set(look) == set(METHODS)
        assert len({str(one) for one in look.values()}) == len(METHODS)


def test_the_close_up_cuts_no_marking_off() -> None:
    centre = np.zeros(2)
    inside, across = diamond_at(3, 0), diamond_at(5.3, 0)
    assert len(figures._wholly_near(HdMap((inside, across)), centre)) == 1


def test_the_table_shows_every_method_and_camera_set_once() -> None:
    row = {"markings": 3, "recall": 1.0, "false_markings": 0, "corner_rmse_m": 0.0123, "corner_bias_m": 0.001}
    table = results_table("t", {"front": {"Opt": row, "CNI": row}, "both": {"Opt": row}})
    assert list(table.columns[0].cells) == ["CNI", "Opt", "Opt"]
    assert list(table.columns[5].cells) == ["1.2", "1.2", "1.2"]
