"""The network's shapes and the exact rearrangements inside it."""

import pytest
import torch
from torch import nn

from models import MarkingNet, NetConfig
from v2hdm.catalogue import PAINT_CLASSES


@pytest.fixture(scope="module")
def net():
    """A network whose normalisations have seen something."""
    torch.manual_seed(0)
    net = MarkingNet(NetConfig(widths=[16, 16, 16, 16]))
    for module in net.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.running_mean.normal_()
            module.running_var.uniform_(0.5, 2.0)
    return net.eval()


def random_images(*shape):
    return torch.randint(0, 256, (*shape, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize(("batch", "height", "width"), [(1, 16, 16), (2, 48, 80), (1, 208, 1232)])
def test_every_output_covers_the_image_at_its_stride(net, batch, height, width):
    with torch.inference_mode():
        paint, kinds, lanes = net(random_images(batch, height, width))
    assert paint.shape == (batch, 1, height // 2, width // 2)
    assert kinds.shape == (batch, len(PAINT_CLASSES), height // 4, width // 4)
    assert lanes.shape == (batch, 2, height // 8, width // 8)
    assert paint.dtype == torch.float32


@pytest.mark.parametrize("config", [NetConfig(separable=True), NetConfig(lanes=False)])
def test_the_switches_leave_the_outputs_as_they_are_shaped(config):
    with torch.inference_mode():
        prediction = MarkingNet(config).eval()(random_images(1, 32, 48))
    assert prediction.lanes.shape == (1, 2, 4, 6)
    if not config.lanes:
        assert (prediction.lanes < 0).all(), "a network without lanes finds none"


def test_folding_the_normalisations_leaves_the_function_as_it_is():
    torch.manual_seed(3)
    net = MarkingNet()
    net.train()
    net(random_images(2, 64, 64))
    net.eval()
    images = random_images(2, 48, 96)
    with torch.inference_mode():
        before = net(images)
        after = net.fold()(images)
    assert not any(isinstance(module, nn.BatchNorm2d) for module in net.modules())
    for folded, other in zip(after, before, strict=True):
        torch.testing.assert_close(folded, other, atol=1e-4, rtol=1e-4)


def test_a_pixel_of_another_image_of_the_batch_changes_nothing(net):
    images = random_images(2, 32, 32)
    changed = images.clone()
    changed[1] = 255 - changed[1]
    with torch.inference_mode():
        for changed_output, other in zip(net(changed), net(images), strict=True):
            torch.testing.assert_close(changed_output[0], other[0])
