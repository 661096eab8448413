"""The yard mapped marking by marking, as on the vehicle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.mapping.scene import MATCH_M, SceneOptions, make_scene, match, rotation_error_deg
from v2hdm.errors import ConfigError
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.options import MappingOptions

INCREMENTAL = MappingOptions(mode="incremental")


def test_marking_by_marking_the_map_is_nearly_that_of_all_at_once() -> None:
    scene = make_scene(SceneOptions(length_m=80.0, seed=21, hidden_corner_rate=0.0))
    result = run_methods(scene.drive, scene.detections, ("front", "rear"), INCREMENTAL)["Opt"]
    pairs, rmse_m = match(result.hd_map, scene.markings, MATCH_M)
    assert len(pairs) == len(result.hd_map.markings)
    assert len({b for _, b in pairs}) == len(pairs)
    assert len(pairs) >= 0.9 * len(scene.markings)
    assert rmse_m < 0.05
    for name, truth in scene.cam_from_vehicle.items():
        assert rotation_error_deg(result.calibrations[name].cam_from_vehicle, truth) < 0.1
    assert all(np.all(np.isfinite(marking.covariance_m2)) for marking in result.hd_map.markings)


def test_both_modes_say_the_same_of_themselves() -> None:
    scene = make_scene(SceneOptions(length_m=50.0, seed=5))
    batch, grown = (
        run_methods(scene.drive, scene.detections, ("front", "rear"), options)["Opt"]
        for options in (MappingOptions(), INCREMENTAL)
    )
    assert batch.reprojection_rmse_px is not None
    assert grown.reprojection_rmse_px is not None
    assert grown.reprojection_rmse_px == pytest.approx(batch.reprojection_rmse_px, rel=0.2)
    assert grown.initial_reprojection_rmse_px == pytest.approx(batch.initial_reprojection_rmse_px, rel=0.2)
    assert batch.diagnostics.keys() == grown.diagnostics.keys()
    assert grown.diagnostics["observations"] == pytest.approx(batch.diagnostics["observations"], rel=0.1)
    assert grown.diagnostics["chi2_per_dof"] == pytest.approx(1.0, abs=0.3)
    assert grown.certainty.keys() == batch.certainty.keys() == {"front", "rear"}
    for name, calibration in batch.calibrations.items():
        assert calibration.covariance is not None
        sigma, other = (
            np.sqrt(np.diag(c)) for c in (calibration.covariance, grown.calibrations[name].covariance)
        )
        assert np.all(other < 1.6 * sigma)
        assert np.all(other > 0.7 * sigma)
    ours, theirs = (
        np.median([marking.relative_sigma_m for marking in result.hd_map.markings])
        for result in (grown, batch)
    )
    assert ours == pytest.approx(theirs, rel=0.3)
    assert batch.evidence is not None
    assert grown.evidence is not None
    assert grown.evidence.held_out_loss is not None
    assert grown.evidence.held_out_loss < 3.0
    assert len(grown.evidence.score_tests) == len(batch.evidence.score_tests)
    assert grown.poses is not None
    assert grown.clocks[0].keys() == batch.clocks[0].keys()
    assert not batch.growth
    sizes = [len(markings) for markings in grown.growth]
    assert len(sizes) >= 4
    assert sizes[0] <= 2
    assert sizes[:-1] == sorted(sizes[:-1])
    assert grown.growth[-1] == grown.hd_map.markings


def test_an_unknown_mode_is_refused() -> None:
    scene = make_scene(SceneOptions(length_m=20.0, seed=1))
    with pytest.raises(ConfigError, match=r"mapping.mode is 'online'; choose batch or incremental"):
        run_methods(scene.drive, scene.detections, ("front",), replace(INCREMENTAL, mode="online"))


def test_how_large_the_map_is_is_told_as_it_grows() -> None:
    scene = make_scene(SceneOptions(length_m=80.0, seed=2))
    told: list[str] = []
    run_methods(scene.drive, scene.detections, ("front",), INCREMENTAL, told.append)
    growing = [int(text.split()[3]) for text in told if text.startswith("linking anew with")]
    assert len(growing) >= 2
    assert growing == sorted(growing)
    assert growing[0] >= 12
