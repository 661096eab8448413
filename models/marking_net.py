"""A small U-Net that labels road paint, made for one CPU core.

Most of the time of a segmentation network goes into its finest layers, so there are none at full
resolution: a space-to-depth stem starts at a quarter of it, keeping every pixel as a channel, and a
depth-to-space head ends at half of it (Shi et al., CVPR 2016), which places edges nearly as well as full
resolution. Skips are added rather than concatenated (LinkNet, Chaurasia and Culurciello, 2017), and
dilated convolutions at the coarsest level see far enough to tell a dash from a solid line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate
from torch.nn.utils.fusion import fuse_conv_bn_eval

from v2hdm.records import PAINT_CLASSES

MULTIPLE = 16
"""Image height and width must be multiples of this many pixels."""

STRIDE = 2
"""One logit per this many image pixels in each direction."""

_STEM_STRIDE = 4
_GREY_MEAN = 112.0
_GREY_SCALE = 64.0


@dataclass(kw_only=True)
class NetConfig:
    """Channel counts of :class:`MarkingNet` at 1/4, 1/8 and 1/16 of the image and at the bottom."""

    widths: list[int] = field(default_factory=lambda: [32, 48, 64, 96])
    dilations: list[int] = field(default_factory=lambda: [1, 2, 4])
    head_width: int = 16


class ConvNormRelu(nn.Sequential):
    """Convolution, batch normalisation, ReLU; the normalisation folds into the convolution for export."""

    def __init__(
        self, inputs: int, outputs: int, kernel: int = 3, stride: int = 1, dilation: int = 1
    ) -> None:
        padding = dilation * (kernel // 2)
        super().__init__(
            nn.Conv2d(inputs, outputs, kernel, stride, padding, dilation, bias=False),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True),
        )

    def fold(self) -> None:
        """Merge the running statistics into the convolution; only for a network in eval mode."""
        convolution, norm = self[0], self[1]
        if isinstance(convolution, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
            self[0] = fuse_conv_bn_eval(convolution, norm)
            self[1] = nn.Identity()


class MarkingNet(nn.Module):
    """Images to logits of ``1 + len(PAINT_CLASSES)`` classes, channel 0 being everything but paint."""

    def __init__(self, config: NetConfig | None = None) -> None:
        super().__init__()
        config = config or NetConfig()
        quarter, eighth, sixteenth, bottom = config.widths
        self.classes = 1 + len(PAINT_CLASSES)
        self.stem = ConvNormRelu(3 * _STEM_STRIDE**2, quarter)
        self.encode4 = ConvNormRelu(quarter, quarter)
        self.encode8 = _blocks([eighth, eighth], quarter, stride=2)
        self.encode16 = _blocks([sixteenth], eighth, stride=2)
        self.context = _blocks([bottom] * len(config.dilations), sixteenth, dilations=config.dilations)
        self.lateral16 = nn.Conv2d(bottom, eighth, 1)
        self.decode8 = ConvNormRelu(eighth, eighth)
        self.lateral8 = nn.Conv2d(eighth, quarter, 1)
        self.decode4 = ConvNormRelu(quarter, quarter)
        self.expand = ConvNormRelu(quarter, config.head_width * STRIDE**2, kernel=1)
        self.classify = nn.Conv2d(config.head_width, self.classes, 3, padding=1)

    def forward(self, image: Tensor) -> Tensor:
        """Label images.

        Args:
            image: (B, H, W, 3) uint8, blue green red as OpenCV decodes it; H and W multiples of 16.

        Returns:
            Logits (B, C, H/2, W/2) float32; the one at (row i, column j) is centred on the image
            pixel (u, v) = (2j + 0.5, 2i + 0.5).
        """
        x4 = self.encode4(self.stem(_space_to_depth(image)))
        x8 = self.encode8(x4)
        x = self.lateral16(self.context(self.encode16(x8)))
        x = self.lateral8(self.decode8(_double(x) + x8))
        x = self.decode4(_double(x) + x4)
        logits: Tensor = self.classify(_depth_to_space(self.expand(x)))
        return logits

    def fold(self) -> MarkingNet:
        """Merge every batch normalisation into its convolution, in place; for inference only."""
        self.eval()
        for module in list(self.modules()):
            if isinstance(module, ConvNormRelu):
                module.fold()
        return self


def _blocks(
    widths: Sequence[int], inputs: int, stride: int = 1, dilations: Sequence[int] | None = None
) -> nn.Sequential:
    """Convolutions one after another; the first one takes ``inputs`` channels and has the stride."""
    dilations = dilations or [1] * len(widths)
    layers = []
    for index, (width, dilation) in enumerate(zip(widths, dilations, strict=True)):
        layers.append(ConvNormRelu(inputs, width, stride=stride if index == 0 else 1, dilation=dilation))
        inputs = width
    return nn.Sequential(*layers)


def _double(x: Tensor) -> Tensor:
    return interpolate(x, scale_factor=2.0, mode="nearest")


def _space_to_depth(image: Tensor) -> Tensor:
    """Fold 4 x 4 pixels of (B, H, W, 3) uint8 into 48 channels (row, column, colour), grey values scaled.

    Two plain transposes of bytes: onnxruntime takes 1 ms for them on 1280 x 448 px, 8 for a general permute.
    """
    batch, height, width, _ = image.shape
    s = _STEM_STRIDE
    rows, columns = height // s, width // s
    tiles = image.reshape(batch, rows, s, columns * s * 3).permute(0, 2, 1, 3)
    channels = tiles.reshape(batch * s, rows * columns, s * 3).permute(0, 2, 1)
    return (channels.reshape(batch, 3 * s * s, rows, columns).to(torch.float32) - _GREY_MEAN) * (
        1.0 / _GREY_SCALE
    )


def _depth_to_space(x: Tensor) -> Tensor:
    """``pixel_shuffle`` by 2, (B, 4C, H, W) to (B, C, 2H, 2W), as two plain transposes too."""
    batch, channels, height, width = x.shape
    columns = x.reshape(batch * channels // 2, 2, height * width).permute(0, 2, 1)
    rows = columns.reshape(batch * channels // 4, 2, height, 2 * width).permute(0, 2, 1, 3)
    return rows.reshape(batch, channels // 4, 2 * height, 2 * width)
