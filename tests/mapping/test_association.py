"""Tracks stay pure under a wrong IPM; merging joins what is one marking and nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from tests.mapping.scene import SceneOptions, make_scene
from v2hdm.association.ground import Located, locate
from v2hdm.association.groups import (
    Association,
    FusedGroups,
    fuse_groups,
    keep_rows,
    merge_groups,
    same_groups,
)
from v2hdm.association.sightings import Rig, collect_sightings
from v2hdm.association.tracks import build_tracks
from v2hdm.geometry.planar import align
from v2hdm.mapping.optimise import initial_rig
from v2hdm.records import PoseNoise

MAX_RANGE_M = 16.0


@pytest.fixture(scope="module")
def scene():
    return make_scene(SceneOptions(length_m=80.0, seed=11, false_rate=0.0))


@pytest.fixture(scope="module")
def sightings(scene):
    return collect_sightings(scene.drive, scene.detections, ("front", "rear"))


def true_rig(scene, sightings):
    rig = initial_rig(scene.drive.cameras, sightings.map_from_vehicle)
    truth = np.stack([scene.cam_from_vehicle[name] for name in sightings.cameras])
    return Rig(rig.intrinsic, truth, sightings.map_from_vehicle)


MERGING = {"floor_m": 0.05, "gate_sigmas": 4.0, "max_distance_m": 1.5, "shape_tolerance": 0.25}
SQUARE = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])


def true_marking(scene, sightings):
    """Index of the marking (S,) that each sighting shows, by its corners under the true extrinsic."""
    located = locate(sightings, true_rig(scene, sightings))
    corners = np.stack([m.corners_map for m in scene.markings])
    distance = np.linalg.norm(located.corners_map[:, None, :, None] - corners[None, :, None, :], axis=-1)
    distance = np.where(sightings.valid[:, None, :, None], distance, np.nan).min(axis=3)
    return np.nanmean(distance, axis=2).argmin(axis=1)


def located_at(corners, ray):
    """Corners (n, 4, 2) that are known to a centimetre, along such rays."""
    count, everywhere = len(corners), np.ones((len(corners), 4), bool)
    covariance = np.tile(np.eye(2) * 1e-4, (count, 4, 1, 1))
    return Located(corners, covariance, ray, np.full(count, 2.4), everywhere, everywhere)


def tracks_under(rig, sightings, sigma_rad):
    located = locate(sightings, rig)
    is_near = located.range_m <= MAX_RANGE_M
    located = replace(located, valid=located.valid & is_near, informs=located.informs & is_near)
    return build_tracks(sightings, located, rig, sigma_rad, PoseNoise(0.01, roll_pitch_rad=0.0017)), located


@pytest.fixture(scope="module")
def tracks(scene, sightings):
    """Under an IPM that is wrong by decimetres."""
    return tracks_under(initial_rig(scene.drive.cameras, sightings.map_from_vehicle), sightings, 0.015)[0]


def test_no_track_mixes_two_markings_and_all_are_long_although_images_miss_some(scene, sightings, tracks):
    marking = true_marking(scene, sightings)
    grouped = tracks.group >= 0
    per_track = np.unique(np.stack([tracks.group[grouped], marking[grouped]]), axis=1)
    assert per_track.shape[1] == tracks.count
    assert np.median(np.bincount(tracks.group[grouped])) >= 8


def test_corner_orders_agree_within_a_track(scene, sightings, tracks):
    located = locate(sightings, true_rig(scene, sightings))
    true_corners = np.stack([m.corners_map for m in scene.markings])[true_marking(scene, sightings)]
    whole = np.ones((len(sightings), 4), dtype=bool)
    true_shift = align(true_corners, whole, located.corners_map, located.valid).shift
    judged = (tracks.group >= 0) & (located.valid.sum(axis=1) >= 3)
    turn = (tracks.shift - true_shift) % 4
    votes = np.zeros((tracks.count, 4), dtype=int)
    np.add.at(votes, (tracks.group[judged], turn[judged]), 1)
    # A grossly misplaced corner can make one sighting look turned.
    assert votes.max(axis=1).sum() >= 0.99 * votes.sum()


def test_merging_leaves_one_group_per_marking(scene, sightings):
    rig = true_rig(scene, sightings)
    tracks, located = tracks_under(rig, sightings, 0.002)
    merged = merge_groups(tracks, sightings, fuse_groups(tracks, located, 0.0017), **MERGING)
    marking = true_marking(scene, sightings)
    # A sighting with a grossly misplaced corner may stay alone; it never makes a marking.
    size = np.bincount(merged.group[merged.group >= 0])
    supported = (merged.group >= 0) & (size[merged.group] >= 3)
    pairs = np.unique(np.stack([merged.group[supported], marking[supported]]), axis=1)
    assert pairs.shape[1] == len(np.unique(pairs[0])) == len(np.unique(pairs[1]))
    assert len(np.unique(pairs[1])) >= len(np.unique(marking[merged.group >= 0])) - 1
    assert merged.count < tracks.count


def test_two_markings_of_one_image_are_never_merged(sightings):
    together = sightings.subset(np.flatnonzero(sightings.image == sightings.image[0])[:2])
    association, corners = Association(np.array([0, 1]), np.zeros(2, int), 2), np.tile(SQUARE, (2, 1, 1))
    fused = fuse_groups(association, located_at(corners, corners + 5), 0.001)
    assert merge_groups(association, together, fused, **MERGING).count == 2


def test_groups_are_renumbered_when_rows_are_dropped_and_are_the_same_under_other_numbers():
    association = Association(np.array([0, 1, 2, 1, -1]), np.arange(5) % 4, 3)
    remaining = keep_rows(association, np.array([False, True, True, True, True]))
    assert (remaining.group.tolist(), remaining.count) == ([-1, 0, 1, 0, -1], 2)
    first, renumbered, other, with_a_sighting_more = (
        Association(np.array(group), np.zeros(5, int), 6)
        for group in ([0, 0, 1, 2, -1], [5, 5, 0, 1, -1], [5, 0, 0, 1, -1], [0, 0, 1, 2, 2])
    )
    assert same_groups(first, renumbered)
    assert not same_groups(first, other)
    assert not same_groups(first, with_a_sighting_more)


def test_a_far_sighting_cannot_ruin_the_mean_of_near_ones():
    corners, ray = np.tile(SQUARE, (4, 1, 1)), np.full((4, 4, 2), 4.0)
    corners[3] += 0.8
    ray[3] = 14.0
    fused = fuse_groups(Association(np.zeros(4, int), np.zeros(4, int), 1), located_at(corners, ray), 0.002)
    assert np.abs(fused.corners_map[0] - corners[0]).max() < 0.02


def test_merging_no_groups_gives_none(scene, sightings):
    none = keep_rows(
        tracks_under(true_rig(scene, sightings), sightings, 0.001)[0], np.zeros(len(sightings), dtype=bool)
    )
    fused = FusedGroups(np.empty((0, 4, 2)), np.empty((0, 4, 2, 2)), np.empty((0, 4), dtype=np.int64))
    merged = merge_groups(
        none, sightings, fused, floor_m=0.3, gate_sigmas=3.0, max_distance_m=0.3, shape_tolerance=0.1
    )
    assert merged.count == 0
    assert (merged.group == -1).all()
