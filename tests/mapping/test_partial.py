"""Sightings that show a marking in part, and paint that is none."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.mapping.scene import MATCH_M, Scene, SceneOptions, _detection, _inside, _project, make_scene, match
from v2hdm.association.ground import locate, views_of
from v2hdm.association.groups import attach, fuse_groups, in_view
from v2hdm.association.sightings import collect_sightings
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.optimise import Optimiser, initial_rig
from v2hdm.mapping.options import MappingOptions
from v2hdm.records import DIAMOND, HDMap, ImageDetections

CAMERAS = ("front", "rear")


def cut_short(detection, rng):
    """A dash of which one end is hidden: it seems to end earlier, where nothing is known along it."""
    corners, covariance, valid = (
        detection.corners_px.copy(),
        detection.covariance_px.copy(),
        detection.corner_valid.copy(),
    )
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    k = int(np.argmax(sides[:2] + sides[2:]))
    ends = [(k, (k + 1) % 4), ((k + 3) % 4, (k + 2) % 4)]
    share, turned = rng.uniform(0.2, 0.8), bool(rng.integers(2))
    for pair in ends:
        hidden, visible = pair[::-1] if turned else pair
        along = corners[hidden] - corners[visible]
        corners[hidden] = corners[visible] + share * along
        along = along / np.linalg.norm(along)
        rows = slice(2 * hidden, 2 * hidden + 2)
        covariance[rows, rows] += rng.uniform(100, 1000) ** 2 * np.outer(along, along)
        valid[hidden] = False
    return replace(detection, corners_px=corners, covariance_px=covariance, corner_valid=valid)


def both_ends_hidden(detection, rng):
    """A dash of which nothing but the sides is known."""
    sides = np.roll(detection.corners_px, -1, axis=0) - detection.corners_px
    along = sides[np.argmax(np.linalg.norm(sides, axis=1))]
    along = along / np.linalg.norm(along)
    covariance = detection.covariance_px + rng.uniform(100, 1000) ** 2 * np.kron(
        np.eye(4), np.outer(along, along)
    )
    return replace(detection, covariance_px=covariance, corner_valid=np.zeros(4, dtype=bool))


def with_cut_dashes(scene, share, cut=cut_short):
    """The detections of a scene, so many of whose whole dashes are cut."""
    rng = np.random.default_rng(0)

    def seen(m):
        return cut(m, rng) if m.kind == "lane_dash" and m.corner_valid.all() and rng.random() < share else m

    return [
        replace(in_image, markings=tuple(seen(m) for m in in_image.markings)) for in_image in scene.detections
    ]


STREET = SceneOptions(length_m=45.0, seed=3, false_rate=0.0, wild_rate=0.0, hidden_corner_rate=0.0)


@pytest.fixture(scope="module")
def scene():
    """A short street, seen by detectors that err by their noise alone."""
    return make_scene(STREET)


@pytest.fixture(scope="module")
def sightings(scene):
    return collect_sightings(scene.drive, with_cut_dashes(scene, 1.0), CAMERAS)


def optimiser_of(scene, sightings, options):
    drive = scene.drive
    return Optimiser(sightings, views_of(drive, CAMERAS), drive.cameras, drive.noises, options)


def test_corners_on_a_line_inform_and_are_no_points_and_those_without_covariance_do_not(sightings):
    assert (sightings.informs & ~sightings.valid).any()
    assert (sightings.informs >= sightings.valid).all()
    vague = np.broadcast_to(7.0**2 * np.eye(2), sightings.covariance_px.shape)
    assert replace(sightings, covariance_px=vague).informs.all()
    assert not replace(sightings, covariance_px=np.nan * vague).informs.any()


def test_a_dash_of_which_every_image_hides_an_end_is_mapped_as_a_whole(scene):
    detections = with_cut_dashes(scene, 0.6)
    whole, cut = (
        run_methods(scene.drive, detections_of_run, CAMERAS, MappingOptions(pose_model="heave"))["Opt"]
        for detections_of_run in (scene.detections, detections)
    )
    dashes = [len([m for m in result.hd_map.markings if m.kind == "lane_dash"]) for result in (whole, cut)]
    assert dashes[1] >= dashes[0] - 1
    pairs, rmse_m = match(cut.hd_map, scene.markings, MATCH_M)
    assert len(pairs) == len(cut.hd_map.markings)
    assert rmse_m < match(whole.hd_map, scene.markings, MATCH_M)[1] + 0.01
    assert cut.reprojection_rmse_px == pytest.approx(whole.reprojection_rmse_px, rel=0.3)
    incremental = run_methods(scene.drive, detections, CAMERAS, MappingOptions(mode="incremental"))["Opt"]
    matches, grown_rmse_m = match(incremental.hd_map, scene.markings, MATCH_M)
    assert len(matches) >= len(pairs) - 3
    assert grown_rmse_m < rmse_m + 0.03


def test_a_line_that_no_image_ends_is_known_across_and_not_along(scene, sightings):
    optimiser = optimiser_of(scene, sightings, MappingOptions(rounds=1, pose_model="heave"))
    bundle = optimiser.settle(optimiser.initial_tracks())
    order = bundle.association.corner_order()
    point = np.zeros((bundle.association.count, 4), dtype=bool)
    sharp = sightings.valid | (np.linalg.eigvalsh(sightings.covariance_px)[..., 1] < 1.0)
    shown = sharp[bundle.row, order[bundle.row, bundle.corner]]
    np.logical_or.at(point, (bundle.group, bundle.corner), shown)
    index = bundle.corner_index[(bundle.corner_index >= 0) & ~point]
    variance = np.linalg.eigvalsh(bundle.solution.corner_covariance(index[:, None]))
    assert np.isfinite(variance).all()
    assert bundle.solution.observation_factor == pytest.approx(1.0, abs=0.3)
    assert len(index)
    # Where lines of two sides cross, the corner is known both ways.
    assert (np.sqrt(variance[:, 1]) > 0.3).mean() > 0.75
    assert (np.sqrt(variance[:, 0]) < 0.2).all()


def test_a_corner_behind_the_camera_is_not_observed_by_its_line(scene, sightings):
    rig = initial_rig(scene.drive.cameras, sightings.map_from_vehicle)
    optimiser = optimiser_of(scene, sightings, MappingOptions())
    tracks, located = optimiser.initial_tracks(), locate(sightings, rig)
    usable = in_view(tracks, located, sightings, rig, 0.003)
    assert (usable <= located.informs).all()
    assert (usable >= located.valid).all()
    assert usable.sum() > located.valid.sum()
    fused = fuse_groups(tracks, located, 0.003)
    assert (fused.point_sightings > 0).sum() < np.isfinite(fused.corners_map).all(axis=2).sum()


def test_the_naive_methods_use_whole_sightings_only(scene):
    results = run_methods(
        scene.drive, with_cut_dashes(scene, 1.0), CAMERAS, MappingOptions(pose_model="heave", rounds=1)
    )
    naive: HDMap = results["CNI"].hd_map
    assert not [marking for marking in naive.markings if marking.kind == "lane_dash"]


def test_sides_without_ends_are_attached_to_the_dash_that_they_are_of(scene):
    whole = collect_sightings(scene.drive, scene.detections, CAMERAS)
    sightings = collect_sightings(scene.drive, with_cut_dashes(scene, 0.4, both_ends_hidden), CAMERAS)
    assert len(sightings) == len(whole)
    truth = np.stack([scene.cam_from_vehicle[name] for name in CAMERAS])
    rig = replace(initial_rig(scene.drive.cameras, sightings.map_from_vehicle), cam_from_vehicle=truth)
    optimiser = optimiser_of(scene, sightings, MappingOptions())
    tracks, located = optimiser.initial_tracks(), locate(sightings, rig)
    fused = fuse_groups(tracks, located, 0.002)
    attached = attach(tracks, sightings, located, rig, fused, 0.002)
    new = np.flatnonzero((attached.group >= 0) & (tracks.group < 0))
    lines = np.flatnonzero((sightings.informs & ~sightings.valid).all(axis=1))
    assert np.isin(lines, new).mean() > 0.3
    centres = locate(whole, rig).corners_map[new].mean(axis=1)
    distances_m = np.linalg.norm(fused.corners_map[attached.group[new]].mean(axis=1) - centres, axis=1)
    assert (distances_m < 1.0).mean() > 0.98
    shown = np.stack([attached.group, sightings.image])[:, attached.group >= 0]
    assert len(np.unique(shown, axis=1).T) == len(shown.T)


STOP_LINE = np.array([[0.0, 1.5], [-0.4, 1.5], [-0.4, -1.5], [0.0, -1.5]])
"""Three metres across the lane, the ends at corners 0, 1 and 2, 3."""


def with_a_stop_line(markings):
    """A stop line in the place of the diamond nearest to the way, where the street begins."""
    nearest = min(
        range(len(markings)), key=lambda k: float(np.linalg.norm(markings[k].corners_map[0] - [12, 4]))
    )
    turn = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    corners = markings[nearest].corners_map.mean(axis=0) + STOP_LINE @ turn.T
    out = [m for k, m in enumerate(markings) if k != nearest]
    return [*out, replace(markings[nearest], kind="stop_line", corners_map=corners)]


def crossed(detection, is_left):
    """The half of a stop line that lies on one side of an arrow, which ends where that begins."""
    corners = detection.corners_px.astype(np.float32)
    # Seen anticlockwise from above, whichever corner comes first; only the nearer or farther end is left.
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    k = int(np.argmax(sides[:2] + sides[2:]))
    flat = np.roll(np.array([[0, 0], [3, 0], [3, 0.4], [0, 0.4]], np.float32), k, axis=0)
    kept_part = np.array([[0, 0], [1.4, 0], [1.4, 0.4], [0, 0.4]], np.float32)
    cut = np.array([False, True, True, False])
    if not is_left:
        kept_part, cut = np.array([[1.6, 0], [3, 0], [3, 0.4], [1.6, 0.4]], np.float32), ~cut
    image_from_flat = cv2.getPerspectiveTransform(flat, corners)
    at = cv2.perspectiveTransform(np.roll(kept_part, k, axis=0)[:, None], image_from_flat)[:, 0]
    covariance, valid = detection.covariance_px.copy(), ~np.roll(cut, k)
    for end in np.flatnonzero(~valid):
        along = corners[end] - corners[(end + 1) % 4 if valid[(end + 1) % 4] else (end + 3) % 4]
        rows = slice(2 * end, 2 * end + 2)
        covariance[rows, rows] += 12.0**2 * np.outer(along, along) / (along @ along)
    return replace(detection, corners_px=at.astype(float), covariance_px=covariance, corner_valid=valid)


def stop_lines(whole_images):
    """Stop lines of the map, and the true one, which all but so many images of each camera show by halves."""
    scene = make_scene(STREET, with_a_stop_line)
    left = dict.fromkeys(CAMERAS, whole_images)
    detections = []
    for in_image in scene.detections[::-1]:
        name, markings = scene.drive.images[in_image.image].camera, []
        for detection in in_image.markings:
            if detection.kind != "stop_line" or (detection.corner_valid.all() and left[name] > 0):
                markings.append(detection)
                left[name] -= detection.kind == "stop_line"
            elif detection.corner_valid.all():
                markings += [crossed(detection, True), crossed(detection, False)]
        detections.append(replace(in_image, markings=tuple(markings)))
    mapped = run_methods(scene.drive, detections[::-1], CAMERAS, MappingOptions(pose_model="heave"))["Opt"]
    true = next(m for m in scene.markings if m.kind == "stop_line")
    return [m for m in mapped.hd_map.markings if m.kind == "stop_line"], true


def test_a_stop_line_that_an_arrow_cuts_in_most_images_has_the_ends_that_the_others_show():
    (mapped_line,), true = stop_lines(whole_images=1)
    off = min(
        np.linalg.norm(np.roll(mapped_line.corners_map, k, axis=0) - true.corners_map, axis=1).max()
        for k in range(4)
    )
    assert off < 0.05


def test_halves_that_all_images_cut_alike_are_no_stop_lines():
    assert stop_lines(whole_images=0)[0] == []


OPTIONS = SceneOptions(seed=5, length_m=90.0, wild_rate=0.0, false_rate=0.0)
_DIAMOND_M = np.array([[0.6, 0.0, 0.0], [0.0, 0.3, 0.0], [-0.6, 0.0, 0.0], [0.0, -0.3, 0.0]])


@pytest.fixture(scope="module")
def yard():
    return make_scene(OPTIONS)


def mapped(yard, detections):
    return run_methods(yard.drive, detections, OPTIONS.cameras)["Opt"].hd_map


def errors_m(yard, hd_map):
    """The largest corner error of each marking that is there, and how many are not."""
    centres = np.array([marking.corners_map.mean(axis=0) for marking in yard.markings])
    errors_found_m, false = [], 0
    for marking in hd_map.markings:
        i = int(np.linalg.norm(centres - marking.corners_map.mean(axis=0), axis=1).argmin())
        true = yard.markings[i]
        rolled = [np.roll(marking.corners_map, k, axis=0) - true.corners_map for k in range(4)]
        off_m = min(float(np.linalg.norm(difference, axis=1).max()) for difference in rolled)
        if true.kind != marking.kind or off_m > 0.3:
            false += 1
        else:
            errors_found_m.append(off_m)
    return np.array(errors_found_m), false


@pytest.fixture(scope="module")
def clean_m(yard):
    """Errors of the map of what is painted and nothing else."""
    return errors_m(yard, mapped(yard, yard.detections))[0]


def with_paint(yard, more):
    return [replace(in_image, markings=(*in_image.markings, *more(in_image))) for in_image in yard.detections]


def anywhere(yard, share):
    """So many of all detections are diamonds anywhere in the image."""
    rng = np.random.default_rng(8)

    def more(in_image):
        count = rng.poisson(len(in_image.markings) * share / (1 - share))
        places = rng.uniform([100, 320], [1180, 680], (count, 2))
        shape = np.array([[30.0, 0], [0, -15], [-30, 0], [0, 15]])
        return [
            _detection(DIAMOND, place + shape * rng.uniform(0.5, 2), np.ones(4, bool), OPTIONS, rng)
            for place in places
        ]

    return with_paint(yard, more)


def on_a_truck(yard, ahead_m, gains_m):
    """A diamond, flat on a low trailer at the height of the ground, that drives ahead and draws away."""
    rng = np.random.default_rng(9)

    def more(in_image):
        image = yard.drive.images[in_image.image]
        vehicle = _DIAMOND_M + np.array([ahead_m + gains_m * image.stamp_s, 0.4, 0.0])
        matrix = image.map_from_vehicle
        on_map = vehicle @ matrix[:3, :3].T + matrix[:3, 3]
        cam_from_map = yard.cam_from_vehicle[image.camera] @ np.linalg.inv(matrix)
        px, depth = _project(yard.drive.cameras[image.camera].info, cam_from_map, on_map[:, :2])
        inside = _inside(px, depth, OPTIONS)
        return [_detection(DIAMOND, px, inside, OPTIONS, rng)] if inside.all() else []

    return with_paint(yard, more)


SPOILT: dict[str, Callable[[Scene], list[ImageDetections]]] = {
    "30 % of all detections are false": lambda yard: anywhere(yard, 0.3),
    "a truck ahead at the same speed": lambda yard: on_a_truck(yard, 8.0, 0.0),
    "a truck that draws away": lambda yard: on_a_truck(yard, 5.0, 0.8),
}


@pytest.mark.parametrize("name", SPOILT)
def test_false_and_moving_paint_stays_out_of_the_map(yard, clean_m, name):
    detections = SPOILT[name](yard)
    added = sum(len(in_image.markings) for in_image in detections) - sum(
        len(in_image.markings) for in_image in yard.detections
    )
    assert added > 20
    off_m, false = errors_m(yard, mapped(yard, detections))
    assert false == 0
    assert len(off_m) >= len(clean_m) - 1
    assert np.sqrt(np.mean(off_m**2)) < 1.3 * np.sqrt(np.mean(clean_m**2))
