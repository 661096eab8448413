"""Whole drives, and the on-vehicle door."""

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.detection.pictures import brightness_model, diamond, extrinsic, make_camera, picture
from v2hdm.detect import main
from v2hdm.detection.batch import detect_all, read_image
from v2hdm.detection.options import DetectorOptions
from v2hdm.errors import DriveError
from v2hdm.hdmap import write_calibration
from v2hdm.records import Calibration, Drive, Image


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """Ten images of one camera that passes two diamonds."""
    root, camera = tmp_path_factory.mktemp("drive"), make_camera()
    images = []
    for n in range(10):
        path = root / f"{n:06d}.png"
        cv2.imwrite(
            str(path), picture(camera, [diamond(8.0 - 0.3 * n, 0.5), diamond(11.0 - 0.3 * n, -0.5)], seed=n)
        )
        images.append(Image("front", 0.1 * n, path, np.eye(4)))
    return Drive("ten", root, {"front": camera}, tuple(images))


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return brightness_model(tmp_path_factory.mktemp("model"))


def test_the_result_does_not_depend_on_the_number_of_workers(drive, model):
    seen = []
    options = DetectorOptions(model=str(model))
    alone = detect_all(drive, options, workers=1, progress=lambda done, total: seen.append((done, total)))
    together = detect_all(drive, options, workers=2)
    assert seen == [(n, 10) for n in range(1, 11)]
    assert [found.image for found in together] == list(range(10))
    for a, b in zip(alone, together, strict=True):
        assert len(a.markings) == len(b.markings) == 2
        for one, other in zip(a.markings, b.markings, strict=True):
            np.testing.assert_array_equal(one.corners_px, other.corners_px)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_a_truncated_image_is_refused_by_name(drive, tmp_path, suffix):
    path = tmp_path / f"cut{suffix}"
    noisy = np.random.default_rng(0).integers(0, 255, (360, 640, 3), dtype=np.uint8)
    data = cv2.imencode(suffix, noisy)[1].tobytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(DriveError, match=f"cut{suffix}: the image is truncated"):
        read_image(Image("front", 0.0, path, np.eye(4)), drive.cameras["front"])


def test_a_missing_image_and_one_of_another_size_are_refused_by_name(drive, tmp_path):
    camera = drive.cameras["front"]
    with pytest.raises(DriveError, match=r"gone\.png: cannot read"):
        read_image(Image("front", 0.0, tmp_path / "gone.png", np.eye(4)), camera)
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((10, 20, 3), dtype=np.uint8))
    with pytest.raises(DriveError, match="20x10 but the camera_info"):
        read_image(Image("front", 0.0, tmp_path / "small.png", np.eye(4)), camera)


def test_the_door_writes_a_line_an_image_with_corners_in_pixels_and_metres(drive, model, tmp_path, capsys):
    calibration = tmp_path / "front.yaml"
    write_calibration(Calibration(drive.cameras["front"].info, extrinsic()), calibration)
    output, drawn = tmp_path / "found.jsonl", tmp_path / "drawn"
    arguments = [str(drive.root), "--camera", str(calibration), "--model", str(model)]
    assert main([*arguments, "--output", str(output), "--draw", str(drawn)]) == 0
    lines = [json.loads(line) for line in output.read_text().splitlines()]
    assert len(lines) == len(list(drawn.glob("*.jpg"))) == 10
    near = min(lines[0]["markings"], key=lambda marking: marking["corners_vehicle"][0][0])
    np.testing.assert_allclose(np.mean(near["corners_vehicle"], axis=0), [8.0, 0.5], atol=0.02)
    assert np.shape(near["covariance_px"]) == (8, 8)
    assert "10 images; latency p50" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere"], "nowhere: no such image or folder"),
        ([__file__], "add --camera"),
        ([".", "--model", "none.onnx"], "none.onnx: no such detector model"),
    ],
)
def test_bad_input_ends_in_one_line_and_exit_code_2(arguments, words, model, capsys):
    arguments = arguments if "--model" in arguments else [*arguments, "--model", str(model)]
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_nothing_half_written_is_left_when_an_image_is_damaged(drive, model, tmp_path):
    calibration, folder = tmp_path / "front.yaml", tmp_path / "images"
    write_calibration(Calibration(drive.cameras["front"].info, extrinsic()), calibration)
    folder.mkdir()
    (folder / "a.png").write_bytes(drive.images[0].path.read_bytes())
    (folder / "b.png").write_bytes(drive.images[1].path.read_bytes()[:500])
    output = tmp_path / "found.jsonl"
    arguments = [str(folder), "--camera", str(calibration), "--model", str(model), "--output", str(output)]
    assert main(arguments) == 2
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["front.yaml"]


def test_the_vehicle_needs_no_torch_and_no_hydra():
    block = (
        "import sys; sys.modules.update(dict.fromkeys(['torch', 'kornia', 'hydra', 'omegaconf', 'scipy']))"
    )
    command = f"{block}; import v2hdm.detect, v2hdm.detection.batch"
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", command], cwd=root, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
