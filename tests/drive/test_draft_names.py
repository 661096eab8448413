"""``check --write``: names that folders have, and settings that name no camera."""

import cv2
import numpy as np
import pytest

from tests.faults.readers import refusal
from v2hdm.cli.main import run
from v2hdm.errors import DriveError
from v2hdm.io.calibration.reading import take_ipm
from v2hdm.io.drive.draft import draft_drive


def images(folder, *names):
    folder.mkdir(parents=True)
    for name in names:
        cv2.imwrite(str(folder / f"{name}.png"), np.zeros((48, 64, 3), np.uint8))
    return folder


@pytest.mark.parametrize(
    ("name", "camera"),
    [(".cam", "cam"), ("a.b c", "a"), ("left cam", "left_cam"), ("all", "camera"), ("...", "camera")],
)
def test_a_camera_has_a_name_that_set_can_give(name, camera, tmp_path):
    missing = draft_drive(images(tmp_path / name, "1.0"), tmp_path / "drive", [])
    assert f"cameras.{camera}.camera_info" in missing


@pytest.mark.parametrize("name", ["nan", "inf", "-inf", "NaN"])
def test_an_image_named_nan_has_no_time_in_its_name(name, tmp_path):
    missing = draft_drive(images(tmp_path / "cam", "1.0", name), tmp_path / "drive", [])
    assert "cameras.cam.images.stamps" in missing


def test_a_source_that_is_not_there_is_no_list_of_settings(tmp_path):
    with pytest.raises(DriveError, match="nothing: no such bag, video or folder of images; check the path"):
        draft_drive(tmp_path / "nothing", tmp_path / "drive", [])


def test_a_link_to_a_file_that_is_gone_is_not_replaced(tmp_path):
    (tmp_path / "drive").mkdir()
    (tmp_path / "drive" / "drive.yaml").symlink_to("/nowhere")
    with pytest.raises(DriveError, match=r"drive\.yaml: exists"):
        draft_drive(images(tmp_path / "cam", "1.0"), tmp_path / "drive", [])
    assert (tmp_path / "drive" / "drive.yaml").is_symlink()


def test_settings_of_another_camera_are_named(tmp_path):
    settings = ["cameras.fornt.camera_info=a.yaml", "poses=p.tum"]
    with pytest.raises(DriveError, match=r"--set cameras\.fornt\.camera_info: not used: .*; name front"):
        draft_drive(images(tmp_path / "front", "1.0"), tmp_path / "drive", settings)


def test_a_folder_name_moves_no_cursor(tmp_path, capsys):
    folder = images(tmp_path / "a\x1b[2J\nb", "1.0")
    assert run(["check", str(folder), "--write", str(tmp_path / "drive")]) == 2
    error = capsys.readouterr().err
    assert all(line.isprintable() for line in error.split("\n"))
    assert error.startswith(f"error: {tmp_path}/a?[2J b: nothing written; also give:\n  --set ")


@pytest.mark.parametrize("number", [1e308, -1e308, 1e200, 5e-324, 1e-160])
def test_an_ipm_of_absurd_numbers_is_read_or_refused(number):
    for place in range(9):
        ipm = np.array([0.01, -0.3, 5.0, -0.02, 0.001, 8.0, 0.0001, -0.04, 1.0])
        ipm[place] = number
        said = refusal(lambda ipm=ipm: take_ipm(ipm.reshape(3, 3).tolist(), "drive.yaml"), DriveError)
        assert said is None or said.startswith("drive.yaml: IPM matrix is not invertible")
