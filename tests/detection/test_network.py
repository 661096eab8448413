"""Model files, what the network says of an image, and the fitted files that belong to it."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import onnx
import onnxruntime
import pytest

from tests.detection.pictures import (
    STRIDES,
    bar,
    brightness_model,
    diamond,
    extrinsic,
    make_camera,
    picture,
    save_model,
)
from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.detection import network as network_module
from v2hdm.detection import weights
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.detector import Detector
from v2hdm.detection.network import Network, RawOutput, run_on_road
from v2hdm.detection.options import DetectorOptions
from v2hdm.errors import ConfigError, DetectorError
from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.records import LANE_DASH, STOP_LINE, Camera, CameraInfo

KINDS = np.zeros(len(PAINT_CLASSES))


def test_the_outputs_cover_images_of_any_size(tmp_path):
    network = Network(brightness_model(tmp_path))
    for height, width in ((32, 48), (33, 47), (5, 16)):
        output = network.run(np.zeros((height, width, 3), dtype=np.uint8))
        assert output.paint.shape == (-(-height // 2), -(-width // 2))
        assert output.kinds.shape == (len(PAINT_CLASSES), -(-height // 4), -(-width // 4))
        assert output.lanes.shape == (2, -(-height // 8), -(-width // 8))


def test_a_gpu_that_this_onnxruntime_was_built_without_is_told(monkeypatch):
    monkeypatch.setattr("onnxruntime.get_available_providers", lambda: ["CPUExecutionProvider"])
    with pytest.raises(DetectorError, match=r"detector\.device is cuda, .* install onnxruntime-gpu instead"):
        Detector.load(options=DetectorOptions(device="cuda"))
    with pytest.raises(ConfigError, match="choose cpu or cuda"):
        DetectorOptions(device="tpu")


def test_a_gpu_that_does_not_start_is_told_and_not_left_out_in_silence(monkeypatch):
    available = ["CUDAExecutionProvider", "CPUExecutionProvider"]
    original = onnxruntime.InferenceSession

    def without(path, options, providers):
        assert [provider if isinstance(provider, str) else provider[0] for provider in providers] == available
        return original(path, options, providers=["CPUExecutionProvider"])

    monkeypatch.setattr("onnxruntime.get_available_providers", lambda: available)
    monkeypatch.setattr("onnxruntime.InferenceSession", without)
    with pytest.raises(DetectorError, match="could not start CUDAExecutionProvider: check the driver"):
        Detector.load(options=DetectorOptions(device="cuda"))


@pytest.mark.parametrize(
    ("metadata", "words"),
    [
        ({"other": 1}, "no usable 'v2hdm' metadata"),
        ({"classes": ["zebra"], "multiple": 16, "strides": STRIDES}, "unknown classes"),
        ({"classes": list(PAINT_CLASSES), "multiple": 15, "strides": STRIDES}, "do not divide"),
        (
            {"classes": list(PAINT_CLASSES), "multiple": 16, "strides": STRIDES | {"kinds": 1}},
            "not a multiple",
        ),
        ({"classes": list(PAINT_CLASSES), "multiple": "many", "strides": STRIDES}, "no usable 'v2hdm'"),
        (
            {"classes": [PAINT_CLASSES[0]] * 2, "multiple": 16, "strides": STRIDES},
            "do not match the channels",
        ),
        ({"classes": list(PAINT_CLASSES), "multiple": 10**9, "strides": STRIDES}, "multiple 1000000000"),
        ({"classes": list(PAINT_CLASSES), "multiple": 0, "strides": STRIDES}, "multiple 0"),
        ({"classes": list(PAINT_CLASSES), "multiple": 16, "strides": [2, 4]}, "no usable 'v2hdm'"),
        ({"classes": list(PAINT_CLASSES), "multiple": 16, "stride": 2}, "no usable 'v2hdm' metadata"),
    ],
)
def test_a_model_with_wrong_metadata_is_refused(tmp_path, metadata, words):
    save_model(tmp_path / "m.onnx", (0.1, 0.0), KINDS, metadata)
    with pytest.raises(DetectorError, match=words):
        Network(tmp_path / "m.onnx")


def test_metadata_nested_deeper_than_any_is_refused_in_one_line(tmp_path):
    model = onnx.load(brightness_model(tmp_path))
    (entry,) = [metadata for metadata in model.metadata_props if metadata.key == "v2hdm"]
    entry.value = "[" * 3000 + "]" * 3000
    onnx.save(model, tmp_path / "deep.onnx")
    with pytest.raises(DetectorError, match="nested deeper"):
        Network(tmp_path / "deep.onnx")


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


def large_camera(width=1280, height=720):
    """A camera with much near ground in it."""
    intrinsic = np.array([[900.0, 0.0, width / 2], [0.0, 900.0, height / 2], [0.0, 0.0, 1.0]])
    info = CameraInfo("front", width, height, intrinsic)
    roi = np.array([[3.0, -2.0], [9.0, -2.0], [9.0, 2.0], [3.0, 2.0]])
    return Camera(info, {"calibrated": ipm_from_extrinsic(info, extrinsic(pitch_deg=18))}, "calibrated", roi)


class LineNetwork(Network):
    """Finds, on every row anchor, the columns where an image's red channel turns from 0 to 255."""

    def run(self, image_bgr):
        output = super().run(image_bgr)
        stride = self.info.lane_stride
        lanes = output.lanes.copy()
        red = image_bgr[..., 2].astype(float)
        for row in range(lanes.shape[1]):
            above, below = stride * row + stride // 2 - 1, stride * row + stride // 2
            edge = 0.5 * sum(float((255 - red[line]).sum() / 255) for line in (above, below))
            cell = edge / stride
            if 0 < cell < lanes.shape[2]:
                lanes[:, row, int(cell)] = 5.0, cell - int(cell) - 0.5
        return RawOutput(output.paint, output.kinds, lanes)


def test_both_resolutions_say_the_same_of_the_same_place(tmp_path):
    camera = large_camera()
    view = RoadCamera(camera)
    network = Network(brightness_model(tmp_path))
    image = picture(camera, [diamond(5.0, 0.0)])
    twice = run_on_road(network, image, view)
    assert network_module.seam_row(network, view, view.far_row) is not None
    view.fine_row = None
    assert network_module.seam_row(network, view, view.far_row) is None
    once = run_on_road(network, image, view)
    assert twice.paint.shape == once.paint.shape
    assert twice.kinds.shape == once.kinds.shape
    overlap, either = (
        ((once.paint > 0) & (twice.paint > 0)).sum(),
        ((once.paint > 0) | (twice.paint > 0)).sum(),
    )
    assert overlap / either > 0.97
    centres = [np.argwhere(sight.paint > 0).mean(axis=0) for sight in (once, twice)]
    np.testing.assert_allclose(*centres, atol=0.1)


def test_row_anchors_of_the_two_resolutions_lie_on_one_line(tmp_path):
    camera = large_camera()
    image = np.zeros((camera.info.height, camera.info.width, 3), dtype=np.uint8)
    for v in range(camera.info.height):
        image[v, int(200 + 0.5 * v) :, 2] = 255
    rows = run_on_road(LineNetwork(brightness_model(tmp_path)), image, RoadCamera(camera)).anchors
    v = np.array([row.v_px for row in rows])
    u = np.array([row.u_px[0] for row in rows])
    assert (np.diff(v) < 0).all()
    assert set(np.round(-np.diff(v))) >= {8, 16}, "both resolutions took part"
    assert np.abs(u - (199.5 + 0.5 * v)).max() < 1.2


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (1242, 375), (1288, 722), (640, 480)])
def test_the_parts_cover_the_band_whatever_the_image_size(tmp_path, width, height):
    camera = large_camera(width, height)
    view = RoadCamera(camera)
    sight = run_on_road(
        Network(brightness_model(tmp_path)), np.zeros((height, width, 3), dtype=np.uint8), view
    )
    rows = height - view.far_row
    assert sight.paint.shape == (-(-rows // 2), -(-width // 2))
    assert sight.kinds.shape[1:] == (-(-rows // 4), -(-width // 4))


def looked_at(image, mirrored):
    """The shipped network's output for an image, looked at whole."""
    view = RoadCamera(large_camera(image.shape[1], image.shape[0]))
    view.fine_row = None
    return run_on_road(Network(), image, view, mirrored)


def test_with_its_mirror_image_the_network_says_the_same_of_both_sides():
    """A law that no network has by itself: the answer to a mirror image is the mirrored answer."""
    image = picture(large_camera(), [diamond(6.0, 1.0), diamond(8.0, -1.5)])
    direct, mirrored = looked_at(image, True), looked_at(image[:, ::-1].copy(), True)
    np.testing.assert_allclose(mirrored.paint[:, ::-1], direct.paint, atol=1e-4)
    np.testing.assert_allclose(mirrored.kinds[..., ::-1], direct.kinds, atol=1e-4)
    columns = [[np.sort(row.u_px) for row in sight.anchors] for sight in (direct, mirrored)]
    for column, here in zip(*columns, strict=True):
        np.testing.assert_allclose(np.sort(image.shape[1] - 1 - here), column, atol=1e-3)
    once = looked_at(image, False)
    assert np.abs(looked_at(image[:, ::-1].copy(), False).paint[:, ::-1] - once.paint).max() > 0.1


@pytest.mark.parametrize("width", [1280, 1271])
def test_the_mirror_image_moves_nothing_whatever_the_width(width):
    image = picture(large_camera(width, 720), [diamond(6.0, 1.0), diamond(8.0, -1.5)])
    once, twice = looked_at(image, False), looked_at(image, True)
    assert (twice.paint.shape, twice.kinds.shape) == (once.paint.shape, once.kinds.shape)
    overlap, either = (
        ((once.paint > 0) & (twice.paint > 0)).sum(),
        ((once.paint > 0) | (twice.paint > 0)).sum(),
    )
    assert overlap / either > 0.93
    # Each marking's own centre: that of both together would also move with how large each comes out.
    centres = [
        cv2.connectedComponentsWithStats((sight.paint > 0).astype(np.uint8))[3][1:] for sight in (once, twice)
    ]
    assert len(centres[0]) == 2
    np.testing.assert_allclose(*centres, atol=0.25)


def turned(camera, yaw_deg):
    """The same camera on a vehicle that drives in another direction."""
    c, s = np.cos(np.deg2rad(yaw_deg)), np.sin(np.deg2rad(yaw_deg))
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    ipm = {name: turn @ homography for name, homography in camera.ipm.items()}
    return replace(camera, ipm=ipm, roi_vehicle=camera.roi_vehicle @ turn[:2, :2].T)


@pytest.mark.parametrize(
    ("yaw_deg", "kind"),
    [(0.0, STOP_LINE), (180.0, STOP_LINE), (50.0, STOP_LINE), (90.0, LANE_DASH), (-80.0, LANE_DASH)],
)
def test_a_stripe_across_the_view_of_a_camera_that_looks_to_the_side_is_a_dash(tmp_path, yaw_deg, kind):
    camera = make_camera("pinhole")
    image = picture(camera, [bar(6.0, 0.0, 0.3, 2.4)], ground=0.2, paint=0.6)
    detector = Detector.load(brightness_model(tmp_path, STOP_LINE), DetectorOptions(min_confidence=0.0))
    (detection,) = detector.detect(image, turned(camera, yaw_deg))[0]
    assert detection.kind == kind
    assert detection.score > DetectorOptions().min_confidence


@pytest.fixture
def folder(tmp_path):
    copy = tmp_path / "weights"
    shutil.copytree(weights.FOLDER, copy, ignore=shutil.ignore_patterns("__pycache__", "*.py"))
    return copy


def refusal(folder):
    with pytest.raises(DetectorError) as caught:
        weights.check_weights(folder)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_the_shipped_files_belong_together(folder):
    weights.check_weights()
    weights.check_weights(folder)
    manifest = weights.read_manifest()
    assert set(manifest["files"]) == set(weights.COMMANDS)
    assert len(manifest["commit"]) >= 40
    commands = [entry["command"] for entry in manifest["files"].values()]
    assert not any(word.startswith("/") for command in commands for word in command.split())


@pytest.mark.parametrize("name", list(weights.COMMANDS))
def test_a_file_that_is_not_the_manifests_is_refused_with_the_command_that_makes_it(folder, name):
    with (folder / name).open("ab") as file:
        file.write(b" ")
    message = refusal(folder)
    assert name in message
    assert weights.COMMANDS[name] in message


@pytest.mark.parametrize("name", list(weights.COMMANDS))
def test_a_missing_file_is_refused(folder, name):
    (folder / name).unlink()
    assert f"{folder / name}: no such file" in refusal(folder)


def test_a_judge_of_another_network_is_refused(folder):
    manifest = weights.read_manifest(folder)
    manifest["files"]["judge.onnx"]["network"] = "0" * 64
    (folder / "manifest.json").write_text(json.dumps(manifest))
    message = refusal(folder)
    assert "fitted to a network other" in message
    assert "python -m train.ship v2hdm/detection/weights/default.onnx" in message


@pytest.mark.parametrize("content", [None, "{", "[]", '{"files": {}}'])
def test_a_missing_or_damaged_manifest_is_refused(folder, content):
    path = folder / "manifest.json"
    path.unlink()
    if content is not None:
        path.write_text(content)
    assert "missing or damaged" in refusal(folder)


def test_a_detector_is_not_loaded_from_files_that_do_not_belong_together(monkeypatch):
    monkeypatch.setattr(weights, "_problem", lambda folder: "judge.onnx: was fitted to a network other")
    with pytest.raises(DetectorError, match="a network other"):
        Detector.load()
    Detector(Network(), DetectorOptions())  # as the fits to a new network do, which they come before


def test_the_user_of_an_own_network_is_told_whose_judge_scores_it(tmp_path):
    network = tmp_path / "own.onnx"
    network.write_bytes(weights.NETWORK_FILE.read_bytes())
    assert weights.unknown_network(network) is None
    network.write_bytes(b"another network")
    message = weights.unknown_network(network)
    assert message is not None
    assert "judge of the shipped network" in message
    assert "\n" not in message
    with pytest.raises(DetectorError, match="no such detector model"):
        weights.unknown_network(tmp_path / "none.onnx")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            lambda model: setattr(model, "ir_version", 99),
            r"its IR version is 99, and this onnxruntime [\d.]+ reads up to \d+",
        ),
        (
            lambda model: setattr(model.opset_import[0], "version", 99),
            r"its opset of ai.onnx is 99, and this onnxruntime [\d.]+ knows up to \d+",
        ),
        (
            lambda model: setattr(model.graph.node[0], "op_type", "Frobnicate"),
            "No Op registered for Frobnicate",
        ),
    ],
    ids=["IR", "opset", "operator"],
)
def test_a_model_newer_than_the_runtime_is_one_line_with_both_versions(change, says, tmp_path):
    model = onnx.load(str(weights.NETWORK_FILE))
    change(model)
    (tmp_path / "a.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(DetectorError, match=says) as refused:
        Network(tmp_path / "a.onnx")
    assert "onnxruntime_src" not in str(refused.value)
    assert "\n" not in str(refused.value)


def test_the_hint_of_a_users_network_is_to_fit_with_that_network(tmp_path):
    mine = tmp_path / "my network.onnx"
    mine.write_bytes(b"another")
    hint = weights.unknown_network(mine)
    assert hint is not None
    assert f"fit it with `python -m train.ship '{mine}'`" in hint
