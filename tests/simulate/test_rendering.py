from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.simulate.conftest import tiny_port
from v2hdm.errors import DriveError
from v2hdm.io.drive import read_drive
from v2hdm.io.drive.truth import read_truth
from v2hdm.simulate import render_drive, rendered_drive


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def ignore(done: int, total: int) -> None:
    pass


class Stopped(Exception):
    pass


def test_two_workers_write_the_same_bytes_as_one(tiny_drive: Path, tmp_path: Path) -> None:
    render_drive(tiny_port(), tmp_path / "tiny", 2, ignore)
    assert contents(tmp_path / "tiny") == contents(tiny_drive)


def test_another_seed_gives_other_pictures(tiny_drive: Path, tmp_path: Path) -> None:
    render_drive(tiny_port(seed=5), tmp_path / "tiny", 1, ignore)
    image = "front/images/000002.jpg"
    assert (tmp_path / "tiny" / image).read_bytes() != (tiny_drive / image).read_bytes()


def test_a_stopped_render_is_no_drive_and_goes_on_where_it_was(tiny_drive: Path, tmp_path: Path) -> None:
    folder = tmp_path / "tiny"

    def stop(done: int, total: int) -> None:
        if done == 7:
            raise Stopped

    with pytest.raises(Stopped):
        render_drive(tiny_port(), folder, 1, stop)
    with pytest.raises(DriveError):
        read_drive(folder)
    kept = {path: path.stat().st_mtime_ns for path in folder.rglob("*.jpg")}
    assert len(kept) == 7
    seen: list[int] = []
    render_drive(tiny_port(), folder, 1, lambda done, total: seen.append(done))
    assert seen[0] == 7
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in kept.items())
    assert contents(folder) == contents(tiny_drive)


def test_a_rendered_drive_is_found_again_in_the_cache(tmp_path: Path) -> None:
    config = tiny_port()
    calls: list[int] = []
    first = rendered_drive(config, tmp_path, 1, lambda done, total: calls.append(done))
    rendered = len(calls)
    assert rendered_drive(config, tmp_path, 1, lambda done, total: calls.append(done)) == first
    assert len(calls) == rendered
    config.paint.wear = 0.3
    assert rendered_drive(config, tmp_path, 1, ignore) != first


def test_the_mapper_reads_it_like_any_other_drive(tiny_drive: Path) -> None:
    drive = read_drive(tiny_drive)
    assert set(drive.cameras) == {"front", "rear"}
    assert drive.cameras["front"].initial_ipm == "calibrated"
    image = cv2.imread(str(drive.images[0].path))
    assert image.shape == (64, 96, 3)
    assert 40 < image[32:].mean() < 220
    poses = np.array([i.map_from_vehicle for i in drive.images])
    assert np.allclose(poses[:, 2, 3], 0.0)


def test_recorded_poses_err_by_what_is_configured_and_images_lie_between_them(tiny_drive: Path) -> None:
    drive = read_drive(tiny_drive)
    truth = read_truth(drive)
    recorded = np.array([i.map_from_vehicle for i in drive.images])
    error = np.linalg.norm(recorded[:, :2, 3] - truth.map_from_vehicle[:, :2, 3], axis=1)
    assert 0.001 < np.sqrt((error**2).mean()) < 0.05
    assert truth.disturbances["roll_pitch_deg"] >= 0.1


def test_truth_says_which_markings_an_image_shows(tiny_drive: Path) -> None:
    """A marking straight ahead of the first front image is seen whole, one behind it not at all."""
    drive = read_drive(tiny_drive)
    truth = read_truth(drive)
    first = next(k for k, image in enumerate(drive.images) if image.camera == "front")
    vehicle_from_map = np.linalg.inv(truth.map_from_vehicle[first])
    centres = np.array([m.corners_map.mean(axis=0) for m in truth.map.markings])
    ahead = (np.column_stack([centres, np.zeros(len(centres)), np.ones(len(centres))]) @ vehicle_from_map.T)[
        :, :2
    ]
    in_lane = (ahead[:, 0] > 9) & (ahead[:, 0] < 14) & (np.abs(ahead[:, 1]) < 1)
    assert truth.visibility[first][in_lane].max() == 1.0
    assert truth.visibility[first][ahead[:, 0] < 3].max(initial=0.0) == 0.0
    assert any(flags.any() for flags in truth.lane_visible)
