"""Model files: what is refused, and that any image size is taken."""

import numpy as np
import onnxruntime
import pytest

from tests.detection.pictures import STRIDES, brightness_model, make_camera, save_model
from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.detection.detector import Detector
from v2hdm.detection.network import Network
from v2hdm.detection.options import DetectorOptions
from v2hdm.errors import ConfigError, DetectorError

KINDS = np.zeros(len(PAINT_CLASSES))


def test_the_outputs_cover_images_of_any_size(tmp_path):
    network = Network(brightness_model(tmp_path))
    for height, width in ((32, 48), (33, 47), (5, 16)):
        output = network.run(np.zeros((height, width, 3), dtype=np.uint8))
        assert output.paint.shape == (-(-height // 2), -(-width // 2))
        assert output.kinds.shape == (len(PAINT_CLASSES), -(-height // 4), -(-width // 4))
        assert output.lanes.shape == (2, -(-height // 8), -(-width // 8))


def test_a_missing_model_is_named(tmp_path):
    with pytest.raises(DetectorError, match=r"gone\.onnx: no such detector model"):
        Network(tmp_path / "gone.onnx")


def test_a_gpu_that_this_onnxruntime_was_built_without_is_told(monkeypatch):
    monkeypatch.setattr("onnxruntime.get_available_providers", lambda: ["CPUExecutionProvider"])
    with pytest.raises(
        DetectorError, match=r"detector\.device is cuda, .* install onnxruntime-gpu in its place"
    ):
        Detector.load(options=DetectorOptions(device="cuda"))
    with pytest.raises(ConfigError, match="choose cpu or cuda"):
        DetectorOptions(device="tpu")


def test_a_gpu_that_does_not_start_is_told_and_not_left_out_in_silence(monkeypatch):
    there = ["CUDAExecutionProvider", "CPUExecutionProvider"]
    original = onnxruntime.InferenceSession

    def without(path, options, providers):
        assert [one if isinstance(one, str) else one[0] for one in providers] == there
        return original(path, options, providers=["CPUExecutionProvider"])

    monkeypatch.setattr("onnxruntime.get_available_providers", lambda: there)
    monkeypatch.setattr("onnxruntime.InferenceSession", without)
    with pytest.raises(DetectorError, match="could not start CUDAExecutionProvider: check the driver"):
        Detector.load(options=DetectorOptions(device="cuda"))


def test_a_damaged_model_is_refused(tmp_path):
    path = tmp_path / "damaged.onnx"
    path.write_bytes(brightness_model(tmp_path).read_bytes()[:200])
    with pytest.raises(DetectorError, match="not a usable ONNX model"):
        Network(path)


@pytest.mark.parametrize(
    ("metadata", "words"),
    [
        ({"other": 1}, "no usable 'v2hdm' metadata"),
        ({"classes": ["zebra"], "multiple": 16, "strides": STRIDES}, "unknown classes"),
        ({"classes": list(PAINT_CLASSES), "multiple": 15, "strides": STRIDES}, "do not divide"),
        ({"classes": list(PAINT_CLASSES), "multiple": 16, "strides": STRIDES | {"kinds": 1}}, "no multiple"),
        ({"classes": list(PAINT_CLASSES), "multiple": "many", "strides": STRIDES}, "no usable 'v2hdm'"),
        ({"classes": list(PAINT_CLASSES), "multiple": 16, "stride": 2}, "no usable 'v2hdm' metadata"),
    ],
)
def test_a_model_with_wrong_metadata_is_refused(tmp_path, metadata, words):
    save_model(tmp_path / "m.onnx", (0.1, 0.0), KINDS, metadata)
    with pytest.raises(DetectorError, match=words):
        Network(tmp_path / "m.onnx")


def test_a_model_whose_outputs_disagree_with_its_metadata_is_refused(tmp_path):
    save_model(
        tmp_path / "m.onnx", (0.1, 0.0), KINDS, {"classes": ["diamond"], "multiple": 16, "strides": STRIDES}
    )
    with pytest.raises(DetectorError, match="export it again"):
        Network(tmp_path / "m.onnx").run(np.zeros((32, 32, 3), dtype=np.uint8))


@pytest.mark.parametrize(("slope", "kinds"), [(np.nan, KINDS), (0.1, KINDS * np.nan)])
def test_weights_that_are_no_numbers_are_noticed(tmp_path, slope, kinds):
    save_model(tmp_path / "m.onnx", (slope, 0.0), kinds)
    with pytest.raises(DetectorError, match="not finite"):
        Network(tmp_path / "m.onnx").run(np.zeros((32, 32, 3), dtype=np.uint8))


@pytest.mark.parametrize(
    "image", [np.zeros((10, 10, 3), dtype=np.uint8), np.zeros((360, 640)), np.zeros((360, 640, 3))]
)
def test_an_image_that_is_not_the_cameras_is_refused(tmp_path, image):
    with pytest.raises(DetectorError, match="camera 'front'"):
        Detector.load(brightness_model(tmp_path)).detect(image, make_camera())
