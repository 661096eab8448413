"""A yard that was painted anew in places, seen by a second drive: what stayed, moved, vanished and is new."""

from dataclasses import replace

import numpy as np
import pytest

from tests.mapping.scene import ADDED, DIAMOND, MOVED, REMOVED, SceneOptions, make_scene, match, repainted
from v2hdm.errors import MappingError
from v2hdm.geometry.ipm import apply_homography, pinhole_px_from_ground
from v2hdm.geometry.rigid import inverse
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.maps.reading import read_geojson
from v2hdm.mapping.methods import run_methods
from v2hdm.records import Fate, Lane, Marking
from v2hdm.site.living.changes import Base, fused_markings
from v2hdm.site.living.fates import Watched, decide
from v2hdm.site.living.map_errors import Errors, updated_lanes


def base_of(result, folder):
    """A result as the base of the next one, by way of its file."""
    write_geojson(result.hd_map, folder / "map.geojson")
    left_out = tuple(
        (exclusion.kind, exclusion.position_map, exclusion.sightings) for exclusion in result.excluded
    )
    return Base(read_geojson(folder / "map.geojson"), result.poses.map_from_vehicle, left_out)


@pytest.fixture(scope="module")
def before():
    return make_scene(SceneOptions(length_m=70.0, seed=21))


@pytest.fixture(scope="module")
def base(before, tmp_path_factory):
    optimum = run_methods(before.drive, before.detections, ("front", "rear"))["Opt"]
    return base_of(optimum, tmp_path_factory.mktemp("base"))


@pytest.fixture(scope="module")
def updated(base):
    now = make_scene(SceneOptions(length_m=70.0, seed=22), repainted)
    return now, run_methods(now.drive, now.detections, ("front", "rear"), base=base)["Opt"]


def changes_of(result):
    assert result.changes is not None
    return result.changes


def near(corners, centre):
    return corners is not None and bool(np.linalg.norm(corners.mean(axis=0) - centre) < 0.1)


def test_what_moved_is_listed_with_its_way_and_nothing_else(before, updated):
    moved = changes_of(updated[1]).of(Fate.MOVED)
    assert len(moved) == len(MOVED)
    for number, shift in MOVED.items():
        centre = before.markings[number].corners_map.mean(axis=0)
        (change,) = [change for change in moved if near(change.before, centre)]
        assert change.shift_m == pytest.approx(np.array(shift), abs=0.03)
        assert change.shift_sigma_m is not None
        assert (change.shift_sigma_m < 0.02).all()
        assert near(change.after, centre + shift)
        assert change.probability > 0.99


def test_what_vanished_left_the_map_and_stays_in_the_list(before, updated):
    now, result = updated
    gone = changes_of(result).of(Fate.VANISHED)
    centres = [before.markings[k].corners_map.mean(axis=0) for k in REMOVED]
    assert all(any(near(change.before, centre) for change in gone) for centre in centres)
    assert len(gone) == len(REMOVED)
    assert all(change.views >= 5 and change.views_showing == 0 and change.after is None for change in gone)
    assert not {feature.id for feature in gone} & {feature.id for feature in result.hd_map.markings}
    pairs, _ = match(result.hd_map, now.markings, 0.3)
    assert len(pairs) == len(result.hd_map.markings)


def test_new_paint_has_an_id_that_no_other_ever_had(base, updated):
    result = updated[1]
    new = changes_of(result).of(Fate.NEW)
    assert len(new) == len(ADDED)
    assert all(any(near(change.after, np.array(place)) for change in new) for place in ADDED)
    ids_of_base = [feature.id or 0 for feature in (*base.hd_map.markings, *base.hd_map.lanes)]
    assert min(change.id for change in new) > max(ids_of_base)


def test_ids_stay(base, updated):
    vanished = {change.id for change in changes_of(updated[1]).of(Fate.VANISHED)}
    moved = {change.id for change in changes_of(updated[1]).of(Fate.MOVED)}
    now = {marking.id: marking for marking in updated[1].hd_map.markings}
    for marking in base.hd_map.markings:
        if marking.id not in vanished | moved:
            assert now[marking.id].corners_map == pytest.approx(marking.corners_map, abs=0.05)
    assert {marking.id for marking in base.hd_map.markings} - vanished <= set(now)
    ids = [feature.id for feature in (*updated[1].hd_map.markings, *updated[1].hd_map.lanes)]
    assert len(set(ids)) == len(ids)
    assert {lane.id for lane in base.hd_map.lanes} <= set(ids)


def test_observations_bear_the_ids_and_corners_of_the_updated_map(updated):
    now, result = updated
    assert result.residuals is not None
    corners = {marking.id: marking.corners_map for marking in result.hd_map.markings}
    images = {image.path.as_posix(): image for image in now.drive.images}
    residuals, off_px = result.residuals, []
    for k in np.flatnonzero((residuals.marking > 0) & residuals.is_point):
        image = images[residuals.image[residuals.row_image[k]]]
        calibration = result.calibrations[image.camera]
        cam_from_map = calibration.cam_from_vehicle @ inverse(result.poses.of_image(image))
        corner = corners[residuals.marking[k]][residuals.corner[k]]
        px = apply_homography(pinhole_px_from_ground(calibration.info.intrinsic, cam_from_map), corner)
        off_px.append(np.linalg.norm(px - residuals.observed_px[k]))
    assert {change.id for change in changes_of(result).of(Fate.NEW)} <= set(residuals.marking)
    assert len(off_px) > 500
    assert np.percentile(off_px, 90) < 8.0


def test_an_id_that_is_gone_is_never_given_again(tmp_path, updated):
    hd_map = updated[1].hd_map
    last = max(feature.id or 0 for feature in hd_map.markings)
    without = replace(hd_map, markings=tuple(marking for marking in hd_map.markings if marking.id != last))
    fresh = replace(hd_map.markings[0], id=None)
    write_geojson(replace(without, markings=(*without.markings, fresh)), tmp_path / "map.geojson")
    again = read_geojson(tmp_path / "map.geojson")
    assert again.markings[-1].id == hd_map.largest_id + 1
    assert again.largest_id == hd_map.largest_id + 1


def test_a_map_of_another_place_is_refused(base, updated):
    elsewhere = [replace(marking, corners_map=marking.corners_map + 2.4) for marking in base.hd_map.markings]
    wrong = replace(base, hd_map=replace(base.hd_map, markings=tuple(elsewhere)))
    with pytest.raises(MappingError, match="is the map of this site and in this frame"):
        run_methods(updated[0].drive, updated[0].detections, ("front", "rear"), base=wrong)


# Two maps made up from their errors: what is shared, and what is each marking's own.

SHARED_M, OWN_M = 0.015, 0.004


def street(count):
    """Corners (count, 4, 2) of diamonds 4 m apart."""
    places = np.column_stack([4.0 * np.arange(count), np.where(np.arange(count) % 2, 3.0, -3.0)])
    return DIAMOND + places[:, None]


def mapped(corners, rng, over_m=30.0):
    """A map of the street: a drift that all share, and errors of each corner."""
    centres = corners.mean(axis=1)
    distances_m = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    root = np.linalg.cholesky(SHARED_M**2 * np.exp(-distances_m / over_m) + 1e-12 * np.eye(len(corners)))
    drift = root @ rng.standard_normal((len(corners), 2))
    whole = OWN_M**2 * np.eye(8) + SHARED_M**2 * np.kron(np.ones((4, 4)), np.eye(2))
    noisy = corners + drift[:, None] + OWN_M * rng.standard_normal(corners.shape)
    return [
        Marking("diamond", corners_of_one, 10, whole, OWN_M / 2, id=k + 1)
        for k, corners_of_one in enumerate(noisy)
    ]


def decided(old, new, looks=8):
    def watched(markings):
        return Watched(np.full(len(markings), -np.log(10.0 * (looks + 1))), np.full(len(markings), -0.05))

    errors = [Errors.of(markings, 30.0) for markings in (old, new)]
    return decide(old, new, *errors, watched(old), watched(new))


def test_the_drift_of_either_map_counts_once():
    squared, stated = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        corners = street(40)
        old, new = mapped(corners, rng), mapped(corners, rng)
        by_old, by_new = fused_markings(old, new, decided(old, new))
        assert not by_new
        off = np.stack([by_old[k].corners_map for k in range(40)]) - corners
        squared.append(np.mean(off**2))
        stated.append(np.mean([np.trace(change.covariance_m2) / 8 for change in by_old.values()]))
    expected = (SHARED_M**2 + OWN_M**2) / 2
    assert np.mean(stated) == pytest.approx(expected, rel=0.1)
    assert np.mean(squared) == pytest.approx(expected, rel=0.35)


def test_what_a_drive_did_not_pass_moves_with_what_it_did():
    """The old map's drift is found out along half of the street; nearby the other half is better, too."""
    before, after, stated = [], [], []
    for seed in range(40):
        rng = np.random.default_rng(100 + seed)
        corners = street(40)
        old, new = mapped(corners, rng), mapped(corners, rng)[:20]
        decision = decided(old, new)
        by_old, _ = fused_markings(old, new, decision)
        before.append(old[20].corners_map - corners[20])
        after.append(by_old[20].corners_map - corners[20])
        stated.append(np.trace(by_old[20].covariance_m2) / 8)
    assert np.mean(np.square(after)) < 0.8 * np.mean(np.square(before))
    assert np.mean(np.square(after)) == pytest.approx(np.mean(stated), rel=0.4)


@pytest.mark.parametrize("shift_m", [0.1, 0.3, 1.0])
def test_a_move_is_told_from_the_drift_of_two_maps(shift_m):
    rng = np.random.default_rng(5)
    corners = street(40)
    now = corners.copy()
    now[17] += (shift_m, 0.0)
    decision = decided(mapped(corners, rng), mapped(now, rng))
    assert [pair.old for pair in decision.pairs if pair.moved > 0.5] == [17]
    assert not decision.gone
    assert not decision.fresh


def test_what_no_image_looked_at_is_not_gone():
    rng = np.random.default_rng(6)
    corners = street(30)
    old, new = (
        mapped(corners, rng),
        [marking for k, marking in enumerate(mapped(corners, rng)) if k not in (4, 9)],
    )
    errors = [Errors.of(markings, 30.0) for markings in (old, new)]
    log_odds, bare = np.zeros(30), np.zeros(30)
    log_odds[4] = -9.0
    decision = decide(old, new, *errors, Watched(log_odds, bare), Watched.never(28))
    assert decision.gone[4] > 0.95
    assert decision.gone[9] < 0.1


def test_a_lane_keeps_its_id_and_its_course_where_the_drive_has_none():
    along = np.arange(0.0, 60.0, 0.5)
    old = [Lane("lane_line", np.column_stack([along, 0.0 * along]), 5, id=3)]
    part = along[(along > 20) & (along < 40)]
    new = [
        Lane("lane_line", np.column_stack([part, 0.0 * part + 0.1])[::-1], 4),
        Lane("lane_line", np.column_stack([along, 0.0 * along + 3.5]), 4),
    ]
    nothing = decided([], [])
    course, added = updated_lanes(old, new, nothing.shift, iter([8]).__next__)
    assert (course.id, course.sightings, added.id) == (3, 9, 8)
    assert (np.diff(course.points_map[:, 0]) > 0).all()
    inside = (course.points_map[:, 0] > 20.1) & (course.points_map[:, 0] < 39.4)
    assert course.points_map[inside, 1] == pytest.approx(0.1)
    assert course.points_map[~inside, 1] == pytest.approx(0.0, abs=0.11)
    assert (course.points_map[0, 0], course.points_map[-1, 0]) == (0.0, 59.5)
