"""Labels of a map lie on the paint of every image, and say where something else stands before it."""

import json
import shutil

import cv2
import numpy as np
import pytest

from train.config import DataConfig
from train.labels_coco import UNKNOWN, read_coco
from v2hdm.cli.main import run
from v2hdm.errors import ConfigError
from v2hdm.geometry.ipm import project_ground
from v2hdm.geometry.lens import distort_points
from v2hdm.io.drive import read_drive
from v2hdm.io.drive.truth import read_truth
from v2hdm.io.maps.reading import read_geojson
from v2hdm.labels import FILE, write_labels
from v2hdm.report.metrics import match_markings


@pytest.fixture(scope="module")
def labelled(small_mapped, small_drive, tmp_path_factory):
    folder = tmp_path_factory.mktemp("labels")
    counted = write_labels(small_mapped[0], read_drive(small_drive), folder)
    return counted, json.loads((folder / FILE).read_text()), folder / FILE


def of_markings(content):
    return [annotation for annotation in content["annotations"] if "marking" in annotation]


def ring(annotation):
    return np.array(annotation["segmentation"][0]).reshape(-1, 2) - 0.5


def test_corners_lie_within_three_tenths_of_a_pixel_of_true_ones(labelled, small_mapped, small_drive):
    _, content, _ = labelled
    drive = read_drive(small_drive)
    truth, mapped = read_truth(drive), read_geojson(small_mapped[0] / "map.geojson").markings
    true_of = {mapped[a].id: b for a, b in zip(*match_markings(mapped, truth.map.markings), strict=True)}
    assert len(true_of) > 15
    number = {drive.name_of(image.path): i for i, image in enumerate(drive.images)}
    image_of = {image["id"]: number[image["file_name"]] for image in content["images"]}
    off_px = []
    for annotation in of_markings(content):
        if annotation["whole"] and not annotation["iscrowd"] and annotation["marking"] in true_of:
            i, corners = image_of[annotation["image_id"]], ring(annotation)
            camera = drive.images[i].camera
            cam_from_map = truth.cam_from_vehicle[camera] @ np.linalg.inv(truth.map_from_vehicle[i])
            info = drive.cameras[camera].info
            true = truth.map.markings[true_of[annotation["marking"]]].corners_map
            px = distort_points(info, project_ground(info.intrinsic, cam_from_map, true)[0])
            corners = corners[:: len(corners) // 4]
            turned = [np.linalg.norm(np.roll(corners, k, axis=0) - px, axis=1) for k in range(4)]
            off_px += min(turned, key=np.sum).tolist()
    assert len(off_px) > 300
    assert np.median(off_px) < 0.3


def test_most_labels_are_of_images_that_detect_nothing_there_or_far_off(labelled):
    counted, content, _ = labelled
    shown = [annotation for annotation in of_markings(content) if not annotation["iscrowd"]]
    assert counted == {"images": 22, "shown": len(shown), "hidden": counted["hidden"],
                       "unsure": len(of_markings(content)) - len(shown)}  # fmt: skip
    assert len(shown) > 5 * counted["unsure"]


def test_a_marking_that_something_hides_in_one_image_is_no_label_there(
    labelled, small_mapped, small_drive, tmp_path
):
    _, content, _ = labelled
    annotation = max(
        (annotation for annotation in of_markings(content) if not annotation["iscrowd"]),
        key=lambda annotation: annotation["area"],
    )
    drive = read_drive(shutil.copytree(small_drive, tmp_path / "drive"))
    (name,) = [image["file_name"] for image in content["images"] if image["id"] == annotation["image_id"]]
    path = drive.root / name
    pixels = cv2.imread(str(path))
    low, high = (
        np.clip(edge, 0, None).astype(int)
        for edge in (ring(annotation).min(0) - 30, ring(annotation).max(0) + 30)
    )
    pixels[low[1] : high[1], low[0] : high[0]] = (70, 80, 90)
    cv2.imwrite(str(path), pixels)
    write_labels(small_mapped[0], drive, tmp_path / "labels")
    again = json.loads((tmp_path / "labels" / FILE).read_text())
    key = (annotation["image_id"], annotation["marking"])
    crowd_of = {
        (annotation["image_id"], annotation["marking"]): annotation["iscrowd"]
        for annotation in of_markings(again)
    }
    before = {
        (annotation["image_id"], annotation["marking"]): annotation["iscrowd"]
        for annotation in of_markings(content)
    }
    assert crowd_of.get(key, 1) == 1
    others = [pair for pair in before if pair[0] != key[0]]
    changed = {
        pair: (before[pair], crowd_of.get(pair)) for pair in others if crowd_of.get(pair) != before[pair]
    }
    # The usual contrast of the marking itself is another without that image.
    of_others = [states for (_, marking), states in changed.items() if marking != key[1]]
    assert set(of_others) <= {(0, 1)}, "one that is hidden makes others less sure, and none surer"
    assert len(of_others) < 0.03 * len(others)


def test_the_training_reads_them_and_takes_nothing_unsure_for_a_marking(labelled, small_drive):
    _, content, path = labelled
    images = read_coco(path, small_drive, DataConfig())
    assert len(images) == 22
    assert all(image.path.is_file() for image in images)
    kinds = [shape.kinds for image in images for shape in image.shapes]
    assert kinds.count((UNKNOWN,)) == sum(annotation["iscrowd"] for annotation in content["annotations"])
    assert ("diamond",) in kinds


def test_a_failed_map_is_refused_and_the_command_says_what_to_do_next(small_mapped, tmp_path, capsys):
    output = str(tmp_path / "labels")
    assert run(["labels", str(small_mapped[0]), "--output", output]) == 0
    assert "python -m train labels=map data.coco=" in capsys.readouterr().out
    failed = shutil.copytree(small_mapped[0], tmp_path / "failed")
    metrics = json.loads((failed / "metrics.json").read_text())
    metrics["verdict"]["status"] = "FAIL"
    (failed / "metrics.json").write_text(json.dumps(metrics))
    assert run(["labels", str(failed), "--output", str(tmp_path / "none")]) == 2
    assert "its verdict is FAIL: labels of a map that may be wrong" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("range_m", [0.0, -3.0, float("nan"), float("inf")])
def test_a_range_that_holds_no_label_is_refused(small_mapped, small_drive, tmp_path, range_m):
    with pytest.raises(ConfigError, match="holds no labels"):
        write_labels(small_mapped[0], read_drive(small_drive), tmp_path, range_m)
