"""The int8 file: nearly what its network says, on every CPU; a start for training; or not written at all."""

import json
from copy import deepcopy
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from onnx import numpy_helper

from export import int8, onnx_file
from export.arrange import arrange
from export.calibration import looks
from export.config import BoundsConfig, ExportConfig, Int8Config, Precision
from export.equalise import equalise
from export.graph import Graph, open_session
from export.int8 import HIGHEST_WEIGHT, to_int8
from export.onnx_file import export_float, export_int8, to_onnx
from export.parity import Parity, int8_parity
from export.rounding import input_moments, round_weights
from export.source import of_checkpoint, read_source
from models import MarkingNet, NetConfig, Prediction
from tests.export.graphs import graphs_made_once as graphs_made_once
from train.checkpoint import Checkpoint
from train.config import TrainConfig
from train.exported import read_exported
from v2hdm.cli.compose import explain, register
from v2hdm.detection.network import METADATA_KEY, Network
from v2hdm.errors import ConfigError, DetectorError

CONF = str(Path(__file__).resolve().parents[2] / "conf")
SMALL = NetConfig(widths=[16, 16, 16, 16], dilations=[1, 2], separable=True)
ANY = BoundsConfig(
    **dict.fromkeys(("paint_changed", "outline_px", "outline_bias_px", "lane_offset_px"), 9.0),
    kinds_agree=0.0,
    lanes_agree=0.0,
)

Images = list[np.ndarray]


def some_images():
    """Blurred noise: neighbouring pixels are alike, as in images of the world."""
    generator = np.random.default_rng(3)
    out = []
    for height, width in ((96, 160), (64, 192)):
        coarse = generator.integers(0, 256, (height // 8, width // 8, 3))
        fine = np.kron(coarse, np.ones((8, 8, 1))) + generator.normal(0, 12, (height, width, 3))
        out.append(np.clip(fine, 0, 255).astype(np.uint8))
    return out


def network(config, images):
    """Whose normalisations have seen the images, and whose channels differ much in range."""
    torch.manual_seed(0)
    net = MarkingNet(config).train()
    for name, parameter in net.named_parameters():
        if ".1." in name and parameter.ndim == 1 and name.endswith("weight"):
            torch.nn.init.uniform_(parameter, 0.1, 2.0)
    with torch.no_grad():
        for _ in range(20):
            for image in images:
                net(torch.from_numpy(image[None]))
    return net.eval()


@pytest.fixture(scope="module")
def images():
    return some_images()


@pytest.fixture(scope="module")
def source(images):
    net = network(SMALL, images)
    config = TrainConfig(net=SMALL)
    return of_checkpoint(Checkpoint(config=asdict(config), step=5, renders=7, averaged=net.state_dict()))


@pytest.fixture(scope="module")
def plain(source):
    return to_onnx(deepcopy(source.net).fold(), 18)


@pytest.fixture(scope="module")
def model(plain, images):
    return to_int8(plain, images)


@pytest.fixture(scope="module")
def quick(images, plain):
    """Nothing is rendered, and the float graph is not made again: that takes seconds each time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(onnx_file, "looks", lambda seed, frames: iter([images]))
        patch.setattr(onnx_file, "to_onnx", lambda net, opset: deepcopy(plain))
        yield


@pytest.fixture(scope="module")
def file(source, quick, tmp_path_factory):
    path = tmp_path_factory.mktemp("int8") / "int8.onnx"
    export_int8(source, path, 18, Int8Config(bounds=ANY), lambda share, doing: None)
    return path


def errors(net, model, images):
    """Root of the mean squared error of every output, as a share of its own spread."""
    session = open_session(model.SerializeToString())
    out = {}
    for name in Prediction._fields:
        pairs = [(session.run([name], {"image": i[None]})[0], _torch(net, i)[name]) for i in images]
        error = np.concatenate([(a - b).ravel() for a, b in pairs])
        spread = np.concatenate([b.ravel() for _, b in pairs]).std()
        out[name] = float(error.std() / max(spread, 1e-6))
    return out


def _torch(net, image):
    with torch.inference_mode():
        return {name: value.numpy() for name, value in net(torch.from_numpy(image[None]))._asdict().items()}


def test_it_says_nearly_what_the_network_says(source, model, images):
    assert {o: e for o, e in errors(source.net, model, images).items() if not e < 0.1} == {}


def test_so_does_a_network_of_another_make(images):
    net = network(replace(SMALL, separable=False, lanes=False, wide_kinds=False), images)
    rounded = to_int8(to_onnx(deepcopy(net).fold(), 18), images)
    assert {o: e for o, e in errors(net, rounded, images).items() if not e < 0.1} == {}


def test_rounding_in_turn_keeps_what_the_first_layer_computes(plain, images):
    """Its inputs are 16 neighbouring pixels, alike: the errors of their weights are made to cancel."""
    graph = Graph(plain)
    stem = graph.convolutions[0]
    moments = sum(input_moments(stem, inputs[stem.input]) for inputs in graph.run([stem.input], images))
    weight, bias = graph.weights[stem.weight], graph.weights[stem.bias]
    whole, scale, new_bias = round_weights(weight, bias, moments, HIGHEST_WEIGHT)
    steps = scale[:, None, None, None]
    in_turn = np.column_stack([(whole * steps - weight).reshape(len(bias), -1), new_bias - bias])
    rounding_errors = np.column_stack(
        [(np.round(weight / steps) * steps - weight).reshape(len(bias), -1), 0 * bias]
    )
    ours, plain = (np.einsum("ni,ij,nj->", error, moments[0], error) for error in (in_turn, rounding_errors))
    assert ours < 0.5 * plain


def test_equalised_channels_leave_the_function_as_it_was(source, plain, images):
    graph = Graph(plain)
    before = {name: weight.copy() for name, weight in graph.weights.items()}
    equalise(graph, images)
    assert max(errors(source.net, graph.stored(), images).values()) < 1e-5
    changed = [
        name for name, weight in graph.weights.items() if np.abs(weight / before[name] - 1).max() > 0.5
    ]
    assert "encode4.0.0.weight" in changed


def test_products_cannot_saturate_where_a_cpu_adds_two_in_16_bits(model):
    weights = [
        numpy_helper.to_array(tensor)
        for tensor in model.graph.initializer
        if tensor.data_type == onnx.TensorProto.INT8
    ]
    assert len(weights) > 10
    assert max(np.abs(w.astype(int)).max() for w in weights) == HIGHEST_WEIGHT
    assert 2 * 255 * HIGHEST_WEIGHT < 2**15


def test_the_first_layer_reads_the_bytes_of_the_image_and_outputs_are_not_rounded(model, images):
    assert not [node for node in model.graph.node if node.op_type == "Cast"]
    for output in open_session(model.SerializeToString()).run(None, {"image": images[0][None]}):
        assert len(np.unique(output)) > 256


def test_the_detectors_network_runs_the_file_on_any_size(source, file):
    network = Network(file)
    for height, width in ((16, 16), (50, 130), (544, 960)):
        output = network.run(np.full((height, width, 3), 90, dtype=np.uint8))
        assert output.paint.shape == (-(-height // 2), -(-width // 2))


def test_its_label_has_all_that_the_float_files_has_and_its_parity(source, file):
    assert [path.name for path in file.parent.iterdir()] == ["int8.onnx"]
    label = json.loads({p.key: p.value for p in onnx.load(file).metadata_props}[METADATA_KEY])
    assert label["precision"] == "int8"
    assert set(label["parity"]) == set(asdict(ANY))
    assert {key: label[key] for key in source.label} == source.label


def test_a_file_beyond_a_bound_is_not_written(source, quick, tmp_path):
    bounds = replace(ANY, lane_offset_px=0.0)
    with pytest.raises(DetectorError, match=r"lane_offset_px 0\.\S+ \(int8\.bounds\.lane_offset_px=0\)"):
        export_int8(source, tmp_path / "int8.onnx", 18, Int8Config(bounds=bounds), lambda share, doing: None)
    assert list(tmp_path.iterdir()) == []


def test_parity_sees_what_was_done_to_an_output(source, plain, images):
    """Log odds that are all larger by a bit make paint grow; another bias of the lanes' offset moves them."""
    same = int8_parity(source.net, plain.SerializeToString(), images)
    assert asdict(same) == pytest.approx(asdict(Parity(0.0, 0.0, 0.0, 1.0, 1.0, 0.0)), abs=1e-4)
    graph = Graph(plain)
    graph.weights["paint.bias"] += 0.05
    graph.weights["lanes.1.bias"] += np.array([0.0, 0.25], dtype=np.float32)
    graph.weights["kinds.bias"][0] += 100
    moved = int8_parity(source.net, graph.stored().SerializeToString(), images)
    assert moved.outline_bias_px > 0.01
    assert moved.paint_changed > 0.001
    assert moved.kinds_agree < 0.9
    assert moved.lane_offset_px == pytest.approx(0.25 * 8, abs=1e-3)


def test_what_is_not_a_number_is_beyond_every_bound():
    nothing = Parity(*[float("nan")] * 6)
    assert len(nothing.beyond(asdict(ANY))) == 6


def test_a_float_file_becomes_int8_as_its_checkpoint_does(source, quick, tmp_path):
    export_float(source, tmp_path / "float.onnx", 18, 1e-3)
    again = read_source(tmp_path / "float.onnx")
    from_float, other = (
        export_int8(s, tmp_path / "int8.onnx", 18, Int8Config(bounds=ANY), lambda share, doing: None)
        for s in (source, again)
    )
    assert asdict(from_float) == pytest.approx(asdict(other), abs=0.02)
    assert again.label["commit"] == source.label["commit"]


def test_the_weights_of_an_int8_file_can_be_learnt_on_from(source, file, images):
    exported = read_exported(file)
    assert exported.renders == 7
    net = MarkingNet(SMALL).fold()
    net.load_state_dict({name: exported.weights[name] for name in net.state_dict()})
    for name, value in _torch(net, images[0]).items():
        expected = _torch(source.net, images[0])[name]
        assert (value - expected).std() < 0.1 * expected.std()


def test_an_int8_file_is_not_rounded_again(file):
    with pytest.raises(ConfigError, match="rounded to int8 already"):
        read_source(file)


def test_images_are_what_the_detector_looks_at():
    pictures = list(looks(11, 2, ((640, 352),)))
    again = list(looks(11, 2, ((640, 352),)))
    assert all(
        image.shape[0] % 16 == 0 and image.shape[1] in (640, 320) for part in pictures for image in part
    )
    assert all(
        np.array_equal(a, b) for x, y in zip(pictures, again, strict=True) for a, b in zip(x, y, strict=True)
    )
    assert not np.array_equal(pictures[0][0], pictures[1][0])


def test_int8_without_renders_says_what_to_set(source, quick, tmp_path):
    with pytest.raises(DetectorError, match=r"int8\.frames"):
        export_int8(source, tmp_path / "x.onnx", 18, Int8Config(frames=0), lambda share, doing: None)


def test_the_door_knows_its_precisions():
    register("export", ExportConfig)
    with initialize_config_dir(CONF, version_base="1.3"):
        composed = compose("export", overrides=["checkpoint=a", "output=b", "precision=int8"])
        assert composed.precision is Precision.int8
        with pytest.raises(HydraException) as caught:
            compose("export", overrides=["precision=int4"])
    assert "[float32, int8]" in str(explain(caught.value, ExportConfig, []))


CONFIG = NetConfig(widths=[16, 32, 16, 16], dilations=[1, 2])
SIZES = ((16, 16), (48, 112), (96, 32))


def noise(height, width):
    return np.random.default_rng(height).integers(0, 256, (height, width, 3), dtype=np.uint8)


def before(config):
    """The graph with bytes inside, as it was thought out."""
    torch.manual_seed(1)
    net = MarkingNet(config).train()
    with torch.no_grad():
        for _ in range(20):  # normalisations that have seen nothing have no biases
            net(torch.from_numpy(noise(64, 96)[None]))
    plain = to_onnx(net.eval().fold(), 18)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(int8, "arrange", lambda graph: None)
        return int8.to_int8(plain, [noise(64, 96)])


def after(model):
    graph = Graph(model)
    arrange(graph)
    arranged = graph.stored()
    onnx.checker.check_model(arranged, full_check=True)
    return arranged


@pytest.fixture(scope="module")
def thought_out():
    return before(CONFIG)


def check_same(model, other):
    sessions = [open_session(model.SerializeToString()) for model in (model, other)]
    for size in SIZES:
        said = [session.run(list(Prediction._fields), {"image": noise(*size)[None]}) for session in sessions]
        for name, a, b in zip(Prediction._fields, *said, strict=True):
            np.testing.assert_allclose(a, b, atol=2e-5, err_msg=f"{name} of {size}")


def test_it_says_the_same(thought_out):
    check_same(thought_out, after(thought_out))


@pytest.mark.parametrize("without", ["lanes", "wide_kinds"])
def test_a_network_without_a_head_says_the_same(without):
    model = before(replace(CONFIG, separable=True, **{without: False}))
    check_same(model, after(model))


def test_nothing_slow_is_left_nor_anything_unused(thought_out):
    graph = after(thought_out).graph
    assert "Resize" not in {node.op_type for node in graph.node}
    read = {name for node in graph.node for name in node.input} | {value.name for value in graph.output}
    assert {name for node in graph.node for name in node.output} <= read
    assert {tensor.name for tensor in graph.initializer} <= read


def test_weights_keep_their_names_and_values(thought_out):
    weights = {t.name: numpy_helper.to_array(t) for t in after(thought_out).graph.initializer}
    for tensor in thought_out.graph.initializer:
        if tensor.name.endswith((".weight", ".weight.bytes", ".bias", ".bias.bytes")):
            np.testing.assert_array_equal(weights[tensor.name], numpy_helper.to_array(tensor))
