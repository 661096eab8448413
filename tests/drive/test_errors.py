"""Drives that cannot be read as wished, damaged truth, and regions beside the image; more in tests/faults."""

import numpy as np
import pytest
import yaml

from tests.drive.example import make_drive
from tests.faults.making import edit, front, write
from v2hdm.errors import DriveError, MapFileError
from v2hdm.io.drive import ReadOptions, read_drive, truth
from v2hdm.io.drive.truth import read_truth
from v2hdm.store.files import read_csv


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (ReadOptions(format="foldr"), "unknown drive format 'foldr'; choose from: auto, folder, kitti"),
        (ReadOptions(max_gap_s=0.0), "max_gap_s is 0"),
    ],
)
def test_impossible_wishes_are_refused(tmp_path, options, message):
    make_drive(tmp_path)
    with pytest.raises(DriveError, match=message):
        read_drive(tmp_path, options)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (write("truth/sightings.csv", "a,b\n"), "line 1: expected the header"),
        (edit("truth/sightings.csv", r",0,1\.0000$", ",7,1.0"), "marking must be below 2"),
        (edit("truth/lane_visible.csv", r"^0,2", "0,9"), "line 3: no vertex 9"),
        (edit("truth/poses.tum", r"^100\.05.*\n", ""), "no true pose at the time 100.05"),
        (edit("truth/cameras.yaml", "rear", "back"), "camera 'rear': missing"),
    ],
)
def test_damaged_truth_is_refused(tmp_path, damage, message):
    make_drive(tmp_path)
    damage(tmp_path)
    with pytest.raises(DriveError, match=message):
        read_truth(read_drive(tmp_path))


@pytest.mark.parametrize(
    ("roi", "cause"),
    [
        ([[-9.0, -3.0], [-3.0, -3.0], [-3.0, 3.0], [-9.0, 3.0]], "lies behind the camera"),
        ([[3.0, 20.0], [9.0, 20.0], [9.0, 26.0], [3.0, 26.0]], "lies outside the image"),
        ([[0.5, -1.0], [1.5, -1.0], [1.5, 1.0], [0.5, 1.0]], "lies outside the image"),
    ],
)
def test_a_region_that_the_camera_does_not_see_is_named_for_that(tmp_path, roi, cause):
    make_drive(tmp_path)
    front(roi_vehicle=roi)(tmp_path)
    with pytest.raises(DriveError, match=f"camera 'front', roi_vehicle: {cause}"):
        read_drive(tmp_path)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_region_of_which_the_image_shows_a_part_is_taken_whatever_the_sign_of_the_ipm(tmp_path, sign):
    make_drive(tmp_path)
    content = yaml.safe_load((tmp_path / "drive.yaml").read_text())
    ipm = {name: (sign * np.array(m)).tolist() for name, m in content["cameras"]["front"]["ipm"].items()}
    front(ipm=ipm, roi_vehicle=[[-1.0, -9.0], [30.0, -9.0], [30.0, 9.0], [-1.0, 9.0]])(tmp_path)
    assert read_drive(tmp_path).images


@pytest.mark.parametrize(
    ("read", "error"),
    [
        (lambda path: list(truth._rows(path, ["a", "b"])), DriveError),
        (lambda path: read_csv(path, MapFileError), MapFileError),
    ],
    ids=["truth", "result"],
)
def test_a_cell_that_is_longer_than_csv_takes_is_one_line(read, error, tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("a,b\n1," + "x" * 140_000 + "\n")
    with pytest.raises(error, match=r"a\.csv: .*larger than field limit"):
        read(path)
