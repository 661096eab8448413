"""Sizes that the user knows: distances between the right corners, in a map that keeps them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.mapping.scene import SceneOptions, make_scene
from v2hdm.association.ground import views_of
from v2hdm.association.sightings import collect_sightings
from v2hdm.catalogue import CORNERED_CLASSES
from v2hdm.errors import ConfigError
from v2hdm.mapping.bundle import full_model, pose_sigma_of, solve_bundle
from v2hdm.mapping.optimise import Optimiser
from v2hdm.mapping.options import MappingOptions, SizeOptions, check_options
from v2hdm.mapping.stated import known_lengths
from v2hdm.records import DIAMOND, LANE_DASH, FloatArray

SIZES = SizeOptions(by_class_m={DIAMOND: [1.2, 0.6], LANE_DASH: [3.0, 0.15]})
RHOMBUS = np.array([[-0.6, 0.0], [0.0, -0.3], [0.6, 0.0], [0.0, 0.3]])
STRIP = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 0.15], [0.0, 0.15]])


def lengths_of(kind: str, corners: FloatArray) -> dict[tuple[int, int], float]:
    index = np.arange(100, 104)[None]
    found = known_lengths(SIZES, [kind], corners[None], index)
    if found is None:
        return {}
    ends = np.sort(np.stack([found.first, found.second]), axis=0).T - 100
    return {(int(a), int(b)): float(m) for (a, b), m in zip(ends, found.length_m, strict=True)}


@given(turn=st.integers(0, 3), off=st.floats(-0.1, 0.1))
def test_whichever_corner_comes_first_the_distances_are_those_of_the_marking(turn: int, off: float) -> None:
    for kind, shape, pairs in ((DIAMOND, RHOMBUS, 2), (LANE_DASH, STRIP, 4)):
        corners = np.roll(shape, turn, axis=0)
        found = lengths_of(kind, (1 + off) * corners)
        assert len(found) == pairs
        for (a, b), metres in found.items():
            assert metres == pytest.approx(np.linalg.norm(corners[a] - corners[b]))


def test_nothing_is_known_of_what_has_another_size_or_an_unknown_one() -> None:
    assert not lengths_of(DIAMOND, 1.3 * RHOMBUS)
    assert not lengths_of(LANE_DASH, STRIP * (0.5, 1.0))
    assert not lengths_of(DIAMOND, np.where(np.arange(4)[:, None] == 1, np.nan, RHOMBUS))
    assert not lengths_of("stop_line", STRIP)


def test_a_joint_solve_keeps_to_the_sizes() -> None:
    scene = make_scene(SceneOptions(seed=31, length_m=60.0, pixel_sigma=0.6, hidden_corner_rate=0.0))
    (true,) = {tuple(np.round(_diagonals(m.corners_map), 6)) for m in scene.markings if m.kind == DIAMOND}
    sightings = collect_sightings(scene.drive, scene.detections, ("front", "rear"))
    views = views_of(scene.drive, ("front", "rear"))
    options = MappingOptions(pose_model="heave")
    optimiser = Optimiser(sightings, views, scene.drive.cameras, scene.drive.noises, options)
    bundle = optimiser.run(optimiser.initial_tracks()).bundle
    spread = []
    for sizes in (SizeOptions(), SizeOptions(by_class_m={DIAMOND: list(true)}, sigma_m=0.002)):
        model = full_model(
            [pose_sigma_of(scene.drive.pose_noise)], replace(options, known_sizes=sizes), "heave"
        )
        usable = sightings.valid & (bundle.association.group >= 0)[:, None]
        solved = solve_bundle(
            sightings, bundle.association, usable, bundle.rig, scene.drive.cameras, model
        ).corners_map
        long_m = np.array([_diagonals(c)[0] for c in solved if np.isfinite(c).all()])
        near = long_m[np.abs(long_m - true[0]) < 0.15 * true[0]]
        assert len(near) > 10
        spread.append(np.std(near))
    assert spread[1] < 0.004
    assert spread[1] < 0.5 * spread[0]


def test_a_map_that_grows_marking_by_marking_keeps_to_the_sizes() -> None:
    scene = make_scene(SceneOptions(seed=31, length_m=40.0, pixel_sigma=0.6, hidden_corner_rate=0.0))
    (true,) = {tuple(np.round(_diagonals(m.corners_map), 6)) for m in scene.markings if m.kind == DIAMOND}
    sightings = collect_sightings(scene.drive, scene.detections, ("front", "rear"))
    views, noise = views_of(scene.drive, ("front", "rear")), scene.drive.pose_noise
    sizes = SizeOptions(by_class_m={DIAMOND: list(true)}, sigma_m=0.002)
    options = MappingOptions(mode="incremental", pose_model="heave", known_sizes=sizes)
    solved = Optimiser(sightings, views, scene.drive.cameras, (noise,), options).grow()
    assert solved.problem.lengths is not None
    long_m = np.array([_diagonals(c)[0] for c in solved.corners_map if np.isfinite(c).all()])
    near = long_m[np.abs(long_m - true[0]) < 0.15 * true[0]]
    assert len(near) > 5
    assert np.std(near) < 0.004


def _diagonals(corners: FloatArray) -> FloatArray:
    return np.sort(np.linalg.norm(corners[2:] - corners[:2], axis=1))[::-1]


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"by_class_m": {"zebra": [1.0, 1.0]}}, r"by_class_m\.zebra"),
        ({"by_class_m": {DIAMOND: [1.0]}}, r"by_class_m\.diamond"),
        ({"by_class_m": {DIAMOND: [0.5, 1.0]}}, "the longer one first"),
        ({"by_class_m": {DIAMOND: [float("nan"), 1.0]}}, r"by_class_m\.diamond"),
        ({"by_class_m": {DIAMOND: [1.0, 0.0]}}, r"by_class_m\.diamond"),
        ({"sigma_m": 0.0}, r"known_sizes\.sigma_m"),
    ],
)
def test_sizes_that_no_marking_has_are_refused(change: dict[str, object], key: str) -> None:
    options = MappingOptions(known_sizes=SizeOptions(**change))  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=key):
        check_options(options, CORNERED_CLASSES)
