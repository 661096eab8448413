"""A rounded file that learns further classes: all else stays as it is."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch

from export.class_rows import add_classes
from export.source import Source
from models import MarkingNet
from train.exported import read_exported
from train.growth import grow, recorded_net, with_classes
from v2hdm.detection.network import Network
from v2hdm.detection.weights import NETWORK_FILE
from v2hdm.errors import ConfigError, DetectorError

FLOAT_FILE = Path(__file__).resolve().parents[2] / "models" / "marking_net.onnx"
OWN = {"manhole": {"family": "other", "length_m": [0.5, 1.0], "width_m": [0.5, 1.0]}}


def grown_source(**changed):
    """The shipped network of float32, which also knows a class of its own; ``changed`` weights differ."""
    exported = read_exported(FLOAT_FILE)
    catalogue = exported.catalogue.with_own(OWN, "test")
    weights = with_classes(exported.weights, exported.classes, catalogue, "test")
    net = MarkingNet(recorded_net(exported.config["net"]), len(catalogue.names)).fold()
    net.load_state_dict({name: weights[name] for name in net.state_dict()} | changed)
    label = exported.label | {"classes": list(catalogue.names), "own_classes": OWN}
    return Source(net, label)


def source_with_channels(added):
    """The same with ``added`` channels for the last class alone, which reads nothing else."""
    source = grown_source()
    label = source.label
    then = recorded_net(label["training"]["net"])
    now = replace(then, added_kinds=then.added_kinds + added)
    torch.manual_seed(5)
    net = MarkingNet(now, len(label["classes"])).fold()
    net.load_state_dict(grow(source.net.state_dict(), then, now))
    with torch.no_grad():
        net.wide_kinds[1].weight[-1] = 0.0
        net.wide_kinds[1].weight[-1, -added:] = torch.linspace(-1.0, 1.0, added)[:, None, None]
        net.wide_kinds[0][0].bias[-added:] = 0.1
        net.kinds.weight[-1] = 0.0
    return Source(net, label)


def images():
    rng = np.random.default_rng(4)
    smooth = rng.integers(60, 200, (1, 24, 32, 3)).astype(np.uint8)
    return smooth.repeat(8, axis=1).repeat(8, axis=2)


def outputs_of(path):
    """Paint, kinds and lanes of the images."""
    return onnxruntime.InferenceSession(path).run(["paint", "kinds", "lanes"], {"image": images()})


def test_only_the_channels_of_changed_classes_are_others(tmp_path):
    source = grown_source()
    stop_line = source.label["classes"].index("stop_line")
    with torch.no_grad():
        source.net.kinds.weight[stop_line] += 0.2
    add_classes(NETWORK_FILE, FLOAT_FILE, source, tmp_path / "net.onnx")
    shipped = outputs_of(NETWORK_FILE)
    written = outputs_of(tmp_path / "net.onnx")
    np.testing.assert_array_equal(written[0], shipped[0])
    np.testing.assert_array_equal(written[2], shipped[2])
    count = shipped[1].shape[1]
    is_same = [np.array_equal(written[1][:, k], shipped[1][:, k]) for k in range(count)]
    assert is_same == [k != stop_line for k in range(count)]
    with torch.inference_mode():
        kinds = source.net(torch.from_numpy(images())).kinds.numpy()
    # Rounding moves the new channels by no more than the old ones.
    moved = np.abs(written[1] - kinds).mean(axis=(0, 2, 3))
    assert moved[[stop_line, count]].max() < 2 * moved[:count].max()


def test_channels_that_new_classes_read_are_rounded_behind_the_others(tmp_path):
    source = source_with_channels(16)
    add_classes(NETWORK_FILE, FLOAT_FILE, source, tmp_path / "net.onnx")
    shipped = outputs_of(NETWORK_FILE)
    written = outputs_of(tmp_path / "net.onnx")
    np.testing.assert_array_equal(written[0], shipped[0])
    np.testing.assert_array_equal(written[2], shipped[2])
    count = shipped[1].shape[1]
    # A product of matrices with more rows is added up in another order.
    np.testing.assert_allclose(written[1][:, :count], shipped[1], atol=1e-4)
    with torch.inference_mode():
        kinds = source.net(torch.from_numpy(images())).kinds.numpy()
    # Rounding moves the new class by no more of its range than others.
    moved = np.abs(written[1] - kinds).mean(axis=(0, 2, 3)) / kinds.std(axis=(0, 2, 3))
    assert moved[count] < 1.5 * moved[:count].max()


def test_channels_beside_others_that_changed_are_refused(tmp_path):
    source = source_with_channels(16)
    with torch.no_grad():
        source.net.wide_kinds[0][0].weight[3] += 0.1
    with pytest.raises(DetectorError, match=r"wide_kinds\.0\.0\.weight of the network is another one"):
        add_classes(NETWORK_FILE, FLOAT_FILE, source, tmp_path / "net.onnx")


def test_the_detector_reads_the_file_with_its_classes(tmp_path):
    add_classes(NETWORK_FILE, FLOAT_FILE, grown_source(), tmp_path / "net.onnx")
    network = Network(tmp_path / "net.onnx")
    assert network.info.classes[-1] == "manhole"
    assert network.run(images()[0]).kinds.shape[0] == len(network.info.classes)
    label = read_exported(tmp_path / "net.onnx").label
    assert label["precision"] == "int8"
    assert label["parity"] == read_exported(NETWORK_FILE).label["parity"]


def test_a_network_that_differs_in_more_is_refused_by_the_name_of_a_weight(tmp_path):
    bias = read_exported(FLOAT_FILE).weights["paint.bias"]
    other = grown_source(**{"paint.bias": bias + 0.5})
    with pytest.raises(DetectorError, match=r"paint\.bias of the network is another one"):
        add_classes(NETWORK_FILE, FLOAT_FILE, other, tmp_path / "net.onnx")
    assert not (tmp_path / "net.onnx").exists()


def test_a_file_that_is_no_export_is_refused(tmp_path):
    (tmp_path / "net.onnx").write_bytes(b"none")
    with pytest.raises(ConfigError, match="was not written by"):
        add_classes(tmp_path / "net.onnx", FLOAT_FILE, grown_source(), tmp_path / "out.onnx")
