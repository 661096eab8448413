"""A site from files: the shipped design, a way with a receiver's noise, and bad files in one line."""

from collections import Counter

import numpy as np
import pytest

from v2hdm.benchmark.layouts import Layout, network_of, route_along
from v2hdm.benchmark.sites import site_of
from v2hdm.cli.main import main
from v2hdm.errors import ConfigError, DriveError, MapFileError


def way(path, points):
    rows = [f"{0.2 * k:.1f} {x:.3f} {y:.3f} 0 0 0 0 1" for k, (x, y) in enumerate(points)]
    path.write_text("\n".join(rows) + "\n")
    return path


def test_the_shipped_design_has_its_paint_beside_its_way():
    network = network_of(site_of("quay").layout, 5.0)
    kinds = Counter(marking.kind for marking in network.hd_map.markings)
    assert kinds == {"lane_dash": 213, "diamond": 91, "stop_line": 4}
    path = network.way(0)
    np.testing.assert_allclose(path.points_map, network.path.points_map)
    (stop,) = [m for m in network.hd_map.markings if m.kind == "stop_line"][:1]
    # The way begins 2 m along the road, in the middle of the right lane, 1.75 m beside its middle.
    np.testing.assert_allclose(stop.corners_map.mean(axis=0), [58.0, 0.0], atol=1e-6)


def test_a_route_through_a_noisy_circle_has_its_bend():
    rng = np.random.default_rng(1)
    angle = np.arange(0.0, 2.0, 0.5 / 40)
    points = 40 * np.column_stack([np.sin(angle), 1 - np.cos(angle)]) + rng.normal(0, 0.01, (len(angle), 2))
    route = route_along(points, 5.0, "here")
    assert route.length_m == pytest.approx(80.0, abs=1.0)
    inner = slice(200, -200)
    assert np.median(route.curvature[inner]) == pytest.approx(1 / 40, rel=0.05)
    assert np.abs(np.linalg.norm(route.points_map - [0, 40], axis=1) - 40).max() < 0.15


def test_a_vehicle_at_rest_does_not_turn_about():
    rng = np.random.default_rng(1)
    ahead = np.column_stack([np.arange(0.0, 60.0, 0.5), np.zeros(120)])
    points = np.concatenate([ahead[:60], ahead[59] + rng.normal(0, 0.02, (100, 2)), ahead[60:]])
    route = route_along(points, 5.0, "here")
    assert np.abs(route.yaw_rad).max() < 0.1
    assert np.ptp(route.points_map[:, 1]) < 0.1


def test_files_that_make_no_site_are_one_line(tmp_path):
    design = site_of("quay").layout.design
    short_way = way(tmp_path / "near.tum", [(0.5 * k, -1.75) for k in range(20)])
    with pytest.raises(DriveError, match=r"near.tum: moves by 9.5 m in all; give 25 m or more"):
        network_of(Layout(design, short_way), 5.0)
    far = way(tmp_path / "far.tum", [(0.5 * k, 900.0) for k in range(100)])
    with pytest.raises(MapFileError, match=r"within 40 m of .*far.tum; give a way in the file's coord"):
        network_of(Layout(design, far), 5.0)
    with pytest.raises(ConfigError, match=r"a.xodr: is a layout without a way; give --way FILE"):
        site_of("a.xodr")
    with pytest.raises(ConfigError, match=r"--way: is for a layout of your own"):
        site_of("quay", far)


def test_a_file_that_is_missing_is_named_before_the_truth_is_made(tmp_path):
    design = site_of("quay").layout.design
    with pytest.raises(MapFileError, match=r"gone\.xodr: no such file"):
        _ = Layout(tmp_path / "gone.xodr", design).digests
    with pytest.raises(DriveError, match=r"gone\.tum: no such file"):
        _ = Layout(design, tmp_path / "gone.tum").digests


def test_a_layout_of_ones_own_is_made_and_scored(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    design = str(site_of("quay").layout.design)
    way(tmp_path / "mine.tum", [(0.5 * k, -1.75) for k in range(60)])
    words = [design, "--way", "mine.tum"]
    assert main(["benchmark", "make", *words, "drive", "--workers", "1"]) == 0
    assert "of a layout of your own" in capsys.readouterr().out
    (tmp_path / "map.geojson").write_text(
        '{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {"class": "diamond"},'
        ' "geometry": {"type": "Polygon", "coordinates": [[[5.4, 3.5], [6, 3.2], [6.6, 3.5], [6, 3.8],'
        " [5.4, 3.5]]]}}]}"
    )
    assert main(["benchmark", "score", "map.geojson", *words, "--crs", "local"]) == 0
    scored = capsys.readouterr().out
    assert "RMSE" in scored
    assert "0.0 cm" in scored
    assert "published" not in scored
