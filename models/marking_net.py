"""A small U-Net that finds road paint and lanes, made for one CPU core.

Most of the time of a segmentation network goes into its finest layers, so there are none at full
resolution: a space-to-depth stem starts at a quarter of it, keeping every pixel as a channel, and a
depth-to-space head ends at half of it (Shi et al., CVPR 2016), which places edges nearly as well as full
resolution. Only the outline needs that: the class of a piece of paint is read off at a quarter, helped by
what its whole shape says at an eighth, the lanes at an eighth. Skips are added rather than concatenated
(LinkNet, Chaurasia and Culurciello, 2017), and dilated convolutions at the coarsest level see far enough to
tell a dash from a solid line.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Annotated, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate
from torch.nn.utils.fusion import fuse_conv_bn_eval

from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.settings import Within

MULTIPLE = 16
"""Image height and width must be multiples of this many pixels."""

PAINT_STRIDE = 2  # image pixels per element of paint, in both directions
KIND_STRIDE = 4  # image pixels per element of kinds, in both directions
LANE_STRIDE = 8
"""Image pixels per element of each output, in both directions."""

_STEM_STRIDE = 4  # image pixels per element after the first convolution, in both directions
PAINT_UPSCALE = _STEM_STRIDE // PAINT_STRIDE
_GREY_MEAN = 112.0  # grey level that is subtracted from an image
_GREY_SCALE = 64.0  # grey levels that are the unit of an image


@dataclass(kw_only=True)
class NetConfig:
    """Channel counts of :class:`MarkingNet` at 1/4, 1/8 and 1/16 of the image and at the bottom.

    Three switches measure what each costs and brings.
    """

    widths: Annotated[list[int], Within(8, 4096, step=8), "channels at 1/4, 1/8, 1/16 and at the bottom."] = (
        field(default_factory=lambda: [32, 64, 96, 128])
    )
    dilations: Annotated[
        list[int], Within(1, 256), "dilations of the blocks at the bottom, one per block."
    ] = field(default_factory=lambda: [1, 2, 4, 8])
    head_width: Annotated[int, Within(1, 1024), "channels of the paint's head."] = 8
    separable: Annotated[
        bool,
        "whether convolutions at high resolution are depthwise separable (Howard et al., "
        '"MobileNets", 2017).',
    ] = False
    lanes: Annotated[bool, "whether the network has the head of row anchors, which finds lanes."] = True
    wide_kinds: Annotated[
        bool,
        "whether features at 1/8, which cover a whole marking and its surroundings, help to name its class.",
    ] = True
    added_kinds: Annotated[
        int,
        Within(0, 1024),
        "channels that wide_kinds adds for classes of a later training, so that earlier classes "
        "stay as they are.",
    ] = 0


class Prediction(NamedTuple):
    """The network's output for images (B, H, W, 3); names as in the ONNX file.

    ``paint`` (B, 1, H/2, W/2): log odds of paint against everything else; element (i, j) is centred on the
    image pixel (u, v) = (2j + 0.5, 2i + 0.5). ``kinds`` (B, classes, H/4, W/4): logits of the class
    of whatever paint is there, centred on (4j + 1.5, 4i + 1.5). ``lanes`` (B, 2, H/8, W/8): for every row
    anchor i, which is the image row 8i + 3.5, and every cell j of 8 px along it, the log odds that a lane's
    line crosses it in that cell, and where: at the pixel u = 8 (j + offset) + 3.5. After the row anchors of
    Qin et al., "Ultra Fast Structure-aware Deep Lane Detection", ECCV 2020, but with local cells, so that any
    image size and any number of lanes will do.
    """

    paint: Tensor
    kinds: Tensor
    lanes: Tensor


class ConvNormRelu(nn.Sequential):
    """Convolution, batch normalisation, ReLU; the normalisation folds into the convolution for export."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        kernel: int = 3,
        stride: int = 1,
        dilation: int = 1,
        groups: int = 1,
        relu: bool = True,
    ) -> None:
        padding = dilation * (kernel // 2)
        super().__init__(
            nn.Conv2d(inputs, outputs, kernel, stride, padding, dilation, groups, bias=False),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True) if relu else nn.Identity(),
        )

    def fold(self) -> None:
        """Merge the running statistics into the convolution; only for a network in eval mode."""
        convolution = self[0]
        norm = self[1]
        if isinstance(convolution, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
            self[0] = fuse_conv_bn_eval(convolution, norm)
            self[1] = nn.Identity()


class MarkingNet(nn.Module):
    """Finds paint, its class, and the lines of lanes in images; see :class:`Prediction`.

    Args:
        config: channel counts.
        classes: how many classes of paint it distinguishes.
    """

    def __init__(self, config: NetConfig | None = None, classes: int = len(PAINT_CLASSES)) -> None:
        super().__init__()
        config = config or NetConfig()
        quarter, eighth, sixteenth, bottom = config.widths
        refine = _separable if config.separable else ConvNormRelu
        self.stem = ConvNormRelu(3 * _STEM_STRIDE**2, quarter, kernel=1)
        self.encode4 = refine(quarter, quarter)
        self.encode8 = nn.Sequential(ConvNormRelu(quarter, eighth, stride=2), refine(eighth, eighth))
        self.encode16 = ConvNormRelu(eighth, sixteenth, stride=2)
        self.context = _blocks([bottom] * len(config.dilations), sixteenth, config.dilations)
        self.lateral16 = nn.Conv2d(bottom, eighth, 1)
        self.decode8 = refine(eighth, eighth)
        self.lateral8 = nn.Conv2d(eighth, quarter, 1)
        self.decode4 = refine(quarter, quarter)
        self.expand = ConvNormRelu(quarter, config.head_width * PAINT_UPSCALE**2, kernel=1)
        self.paint = nn.Conv2d(config.head_width, 1, 3, padding=1)
        self.kinds = nn.Conv2d(quarter, classes, 1)
        self.wide_kinds = _head(refine, eighth, classes, config.added_kinds) if config.wide_kinds else None
        self.lanes = _head(refine, eighth, 2) if config.lanes else None

    def forward(self, image: Tensor) -> Prediction:
        """Look at images (B, H, W, 3) uint8, BGR as OpenCV decodes them; H and W multiples of 16."""
        tiles = _channels_last_tiles(image) if self.training else _space_to_depth(image)
        x4 = self.encode4(self.stem(tiles))
        x8 = self.encode8(x4)
        y8 = self.decode8(_double(self.lateral16(self.context(self.encode16(x8)))) + x8)
        y4 = self.decode4(_double(self.lateral8(y8)) + x4)
        paint = self.paint(_depth_to_space(self.expand(y4)))
        kinds = self.kinds(y4)
        if self.wide_kinds is not None:
            kinds = kinds + _double(self.wide_kinds(y8))
        lanes = self.lanes(y8) if self.lanes is not None else y8.new_full((len(y8), 2, *y8.shape[2:]), -9.0)
        return Prediction(paint, kinds, lanes)

    def fold(self) -> MarkingNet:
        """Merge every batch normalisation into its convolution, in place; for inference only."""
        self.eval()
        for module in list(self.modules()):
            if isinstance(module, ConvNormRelu):
                module.fold()
        return self


def _separable(inputs: int, outputs: int) -> nn.Sequential:
    """A 3 x 3 convolution in two steps: in each channel, then across channels."""
    return nn.Sequential(
        ConvNormRelu(inputs, inputs, groups=inputs, relu=False), ConvNormRelu(inputs, outputs, kernel=1)
    )


def _head(
    refine: Callable[[int, int], nn.Module], inputs: int, outputs: int, added: int = 0
) -> nn.Sequential:
    """Features refined once more, into ``added`` channels more, then read off."""
    return nn.Sequential(refine(inputs, inputs + added), nn.Conv2d(inputs + added, outputs, 1))


def _blocks(widths: Sequence[int], inputs: int, dilations: Sequence[int]) -> nn.Sequential:
    """Convolutions one after another; the first one takes ``inputs`` channels."""
    layers = []
    for width, dilation in zip(widths, dilations, strict=True):
        layers.append(ConvNormRelu(inputs, width, dilation=dilation))
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
    rows = height // s
    columns = width // s
    tiles = image.reshape(batch, rows, s, columns * s * 3).permute(0, 2, 1, 3)
    channels = tiles.reshape(batch * s, rows * columns, s * 3).permute(0, 2, 1)
    return (channels.reshape(batch, 3 * s * s, rows, columns).to(torch.float32) - _GREY_MEAN) * (
        1.0 / _GREY_SCALE
    )


def _channels_last_tiles(image: Tensor) -> Tensor:
    """The same tiles, each one's channels side by side in memory: what training is faster with."""
    batch, height, width, _ = image.shape
    s = _STEM_STRIDE
    tiles = image.reshape(batch, height // s, s, width // s, s * 3).permute(0, 1, 3, 2, 4)
    grey = tiles.reshape(batch, height // s, width // s, 3 * s * s).to(torch.float32)
    return grey.sub_(_GREY_MEAN).mul_(1.0 / _GREY_SCALE).permute(0, 3, 1, 2)


def _depth_to_space(x: Tensor) -> Tensor:
    """``pixel_shuffle`` by 2, (B, 4C, H, W) to (B, C, 2H, 2W), as two plain transposes too."""
    batch, channels, height, width = x.shape
    columns = x.reshape(batch * channels // 2, 2, height * width).permute(0, 2, 1)
    rows = columns.reshape(batch * channels // 4, 2, height, 2 * width).permute(0, 2, 1, 3)
    return rows.reshape(batch, channels // 4, 2 * height, 2 * width)
