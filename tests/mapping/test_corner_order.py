"""Sightings whose corners were taken up in the wrong order are turned back once the map is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.mapping.scene import SceneOptions, make_scene
from v2hdm.mapping.corner_order import settle_corner_order
from v2hdm.mapping.optimise import Optimiser
from v2hdm.mapping.options import MappingOptions
from v2hdm.mapping.sightings.table import collect_sightings
from v2hdm.mapping.sightings.views import views_of


def test_turned_sightings_are_found_and_turned_back() -> None:
    scene = make_scene(SceneOptions(length_m=40.0, seed=5, false_rate=0.0, wild_rate=0.0, ipm_error_deg=0.3))
    names = ("front",)
    sightings = collect_sightings(scene.drive, scene.detections, names)
    optimiser = Optimiser(
        sightings,
        views_of(scene.drive, names),
        {"front": scene.drive.cameras["front"]},
        scene.drive.pose_noise,
        MappingOptions(rounds=1),
    )
    tracks = optimiser.initial_tracks()
    bundle = optimiser.run(tracks).bundle
    right = bundle.association
    assert settle_corner_order(bundle, sightings, sightings.valid) is right
    rng = np.random.default_rng(0)
    in_map = np.flatnonzero(np.isin(right.group, bundle.group) & (sightings.valid.sum(axis=1) == 4))
    turned = rng.choice(in_map, size=12, replace=False)
    shift = right.shift.copy()
    shift[turned] = (shift[turned] + rng.integers(1, 4, len(turned))) % 4
    wrong = replace(bundle, association=replace(right, shift=shift))
    settled = settle_corner_order(wrong, sightings, sightings.valid)
    np.testing.assert_array_equal(settled.shift, right.shift)
