"""An experiment that was stopped goes on; one that is finished draws everything from what it has kept."""

from __future__ import annotations

import gzip
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.experiment.scene import CALIBRATED, ESTIMATED, experiment, keep, record
from tests.mapping.scene import SceneOptions, make_scene
from v2hdm.errors import ConfigError, DriveError
from v2hdm.experiment.drive import _content, drive_record, recipe_file, setting_key, store, stored
from v2hdm.experiment.measures import residuals
from v2hdm.experiment.plan import ExperimentConfig, jobs
from v2hdm.experiment.run import run_experiment
from v2hdm.mapping.methods import run_methods
from v2hdm.records import HdMap, Truth
from v2hdm.store.cache import key_of
from v2hdm.store.results import growing_folder


def finished(output: Path) -> ExperimentConfig:
    """An experiment whose drives are finished, and nowhere to be read again."""
    config = experiment(str(output))
    with growing_folder(output / config.name, "output="):
        for job, start in zip(jobs(config), (CALIBRATED, ESTIMATED), strict=True):
            keep(job, record(job.port, job.seed, start))
            cv2.imwrite(str(job.folder / "front.jpg"), np.full((480, 640, 3), 90, np.uint8))
    return config


@pytest.mark.slow
def test_finished_drives_are_never_opened_again(tmp_path: Path) -> None:
    folder, measured = run_experiment(finished(tmp_path), "name: x\n", lambda *_: None)
    assert [one.title for one in measured] == ["port1", "port2"]
    captions = (folder / "figures.md").read_text()
    pictures = sorted(path.name for path in folder.glob("*.png"))
    of_ports = ("map", "eni_oni", "calibration", "reprojection")
    expected = {f"{kind}_{port}.png" for kind in of_ports for port in ("port1", "port2")}
    assert set(pictures) == expected | {"corners.png", "growth.png", "range.png", "bias_spread.png"}
    for name in pictures:
        assert f"![{name}]({name})" in captions
        image = cv2.imread(str(folder / name))
        assert len(np.unique(image.reshape(-1, 3), axis=0)) > 10
    assert "All 14 figures agree" in (folder / "experiment.md").read_text()


@pytest.mark.parametrize("name", ["config.yaml", "results.csv", "drives/port1/front.jpg"])
def test_a_folder_with_files_of_the_users_is_refused(tmp_path: Path, name: str) -> None:
    mine = tmp_path / experiment(str(tmp_path)).name / name
    mine.parent.mkdir(parents=True)
    mine.write_text("mine")
    with pytest.raises(ConfigError, match="no results of ours"):
        run_experiment(experiment(str(tmp_path)), "", lambda *_: None)
    assert mine.read_text() == "mine"


def test_another_setting_takes_nothing_from_an_earlier_run(tmp_path: Path) -> None:
    config = finished(tmp_path)
    config.mapping.max_range_m = 12.0
    with pytest.raises(DriveError, match="absent"):
        run_experiment(config, "", lambda *_: None)


def test_the_files_of_a_drive_make_up_its_record(tmp_path: Path) -> None:
    job, expected = jobs(finished(tmp_path))[0], record("port1", None, CALIBRATED)
    found = drive_record(job, 1, lambda *_: None)
    assert {key: found[key] for key in expected if key != "extrinsics"} == {
        key: expected[key] for key in expected if key != "extrinsics"
    }
    assert {recipe: one for recipe, one in found["extrinsics"].items() if one} == expected["extrinsics"]


def test_only_the_recipe_that_is_missing_is_mapped_anew(tmp_path: Path) -> None:
    config = finished(tmp_path)
    (jobs(config)[0].folder / recipe_file("incremental")).unlink()
    config.recipes = ["paper"]
    assert drive_record(jobs(config)[0], 1, lambda *_: None)["port"] == "port1"
    config.recipes = ["paper", "incremental"]
    with pytest.raises(DriveError, match="absent"):
        drive_record(jobs(config)[0], 1, lambda *_: None)


def test_a_drive_whose_files_have_changed_is_another_one(tmp_path: Path) -> None:
    job = jobs(finished(tmp_path))[0]
    job.site.simulate, job.site.drive.path = None, str(tmp_path / "drive")
    keys = []
    for text in ("1 2 3", "1 2 4", "1 2 3"):
        (tmp_path / "drive").mkdir(exist_ok=True)
        (tmp_path / "drive" / "poses.tum").write_text(text)
        _content.cache_clear()
        keys.append(setting_key(job))
    assert keys[0] != keys[1]
    assert keys[0] == keys[2]


@pytest.mark.parametrize("damage", ["cut", "text", "other"])
def test_a_damaged_file_or_one_of_another_key_counts_as_absent(damage: str, tmp_path: Path) -> None:
    path = tmp_path / "found.json.gz"
    store(path, key_of(1), {"a": 1})
    assert stored(path, key_of(1)) == {"a": 1}
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:-9])
    elif damage == "text":
        path.write_bytes(gzip.compress(b"[1]"))
    assert stored(path, key_of(2) if damage == "other" else key_of(1)) is None


def test_residuals_and_errors_fall_to_the_noise_under_the_optimised_calibration() -> None:
    """0.25 px of noise in the corners, 1.5 degrees and 0.3 m in the first IPMs."""
    scene = make_scene(SceneOptions(length_m=60.0, jitter_deg=0.02, heading_deg=0.01, rtk_m=0.002))
    methods = run_methods(scene.drive, scene.detections, ("front", "rear"))
    poses = np.array([image.map_from_vehicle for image in scene.drive.images])
    truth = Truth(HdMap(tuple(scene.markings)), scene.cam_from_vehicle, poses, np.empty((0, 0)), (), {})
    for found in residuals(scene.drive, scene.detections, methods, truth).values():
        assert found["field"]["before"]["length_px"] > 5.0
        assert found["field"]["after"]["length_px"] < 1.0
        medians_m = np.array([bin_[2] for bin_ in found["range"]["Opt"]])
        assert np.median(medians_m) < 0.03
