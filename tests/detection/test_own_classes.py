"""Classes of a user's own network: found by what its file alone says of them."""

from pathlib import Path

import numpy as np
import pytest

from tests.detection.pictures import STRIDES, bar, make_camera, picture, save_model, to_image
from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.geometry.quadrilateral import order_corners

SIZES = {"length_m": [0.8, 1.4], "width_m": [0.4, 1.2]}
ENTRIES = {
    "parking_t": {"family": "symbol", **SIZES},
    "pad": {"family": "quadrilateral", **SIZES},
    "fleck": {"family": "other", **SIZES},
}
CLASSES = (*PAINT_CLASSES, *ENTRIES)


def detector_of(folder: Path, kind: str) -> Detector:
    """A detector whose network calls everything bright paint of an own class."""
    kinds = np.full(len(CLASSES), -40.0)
    kinds[CLASSES.index(kind)] = 0.0
    metadata = {"classes": list(CLASSES), "multiple": 16, "strides": STRIDES, "own_classes": ENTRIES}
    path = folder / f"{kind}.onnx"
    save_model(path, (0.1, -13.5), kinds, metadata)
    return Detector.load(path, DetectorOptions(min_confidence=0.0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("models")


def test_an_own_quadrilateral_is_found_with_its_corners(folder: Path) -> None:
    camera, shape = make_camera(), bar(6.0, 0.4, 1.2, 0.6)
    markings, lanes = detector_of(folder, "pad").detect(picture(camera, [shape]), camera)
    assert [marking.kind for marking in markings] == ["pad"]
    assert not [lane for lane in lanes if lane.kind == "pad"]
    true_px = order_corners(to_image(camera, shape))
    apart = np.linalg.norm(markings[0].corners_px[:, None] - true_px, axis=2)
    assert apart.min(axis=1).max() < 0.5
    assert not len(markings[0].outline_px)


def test_paint_that_is_too_large_is_none_of_its_class(folder: Path) -> None:
    camera = make_camera()
    whole, _ = detector_of(folder, "pad").detect(picture(camera, [bar(7.0, 0.4, 4.0, 2.0)]), camera)
    assert "pad" not in [marking.kind for marking in whole]


def test_an_own_symbol_is_found_with_its_outline(folder: Path) -> None:
    camera, shape = make_camera(), bar(6.0, 0.4, 1.1, 0.9)
    markings, _ = detector_of(folder, "parking_t").detect(picture(camera, [shape]), camera)
    assert [marking.kind for marking in markings] == ["parking_t"]
    low, high = (getattr(to_image(camera, shape), which)(axis=0) for which in ("min", "max"))
    np.testing.assert_allclose(markings[0].outline_px.min(axis=0), low, atol=1.5)
    np.testing.assert_allclose(markings[0].outline_px.max(axis=0), high, atol=1.5)


def test_other_own_paint_is_seen_and_not_reported(folder: Path) -> None:
    camera = make_camera()
    image = picture(camera, [bar(6.0, 0.4, 1.2, 0.6)])
    assert detector_of(folder, "fleck").detect(image, camera)[0] == ()
