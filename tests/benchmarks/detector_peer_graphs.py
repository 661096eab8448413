"""Graphs of the size of three well-known detectors, random weights, as ONNX: for timing only.

They follow the papers' layer tables; what may differ from one deployment to another is left out, always to
the peer's advantage:

- UFLD: ResNet-18 and the two dense layers of Qin et al., "Ultra Fast Structure-aware Deep Lane Detection",
  ECCV 2020, at its own 288 x 800. Without decoding.
- Mask R-CNN: ResNet-50-FPN of He et al., ICCV 2017, on the camera's 1280 x 720 (padded to 736), with the
  region proposal head, 100 boxes and 10 masks. Without RoIAlign, box decoding and non-maximum suppression:
  the heads are given fixed windows of one level. Detectron2's default is 1000 boxes and a larger image.
- U-Net: Ronneberger et al., MICCAI 2015, its widths of 64 to 1024, on a quarter of the camera's pixels
  (640 x 352).
"""

from __future__ import annotations

import io
import logging
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, max_pool2d


@dataclass(frozen=True)
class Peer:
    """A peer: how to build it, and the height and width of its input."""

    build: Callable[[], nn.Module]
    height: int
    width: int

    def onnx(self) -> bytes:
        """The graph as an ONNX file."""
        torch.manual_seed(0)
        net = self.build().eval()
        image = torch.zeros((1, 3, self.height, self.width))
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            program = torch.onnx.export(
                net, (image,), dynamo=True, input_names=["image"], external_data=False, verbose=False
            )
        assert program is not None
        content = io.BytesIO()
        program.save(content)
        return content.getvalue()


def _conv(inputs: int, outputs: int, kernel: int = 3, stride: int = 1, relu: bool = True) -> nn.Sequential:
    layers = [
        nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False),
        nn.BatchNorm2d(outputs),
    ]
    return nn.Sequential(*layers, nn.ReLU()) if relu else nn.Sequential(*layers)


class _Block(nn.Module):
    """A residual block: two 3 x 3 convolutions, or a bottleneck that leaves four times its width."""

    def __init__(self, inputs: int, width: int, stride: int, bottleneck: bool) -> None:
        super().__init__()
        outputs = 4 * width if bottleneck else width
        body = (
            [_conv(inputs, width, 1), _conv(width, width, 3, stride), _conv(width, outputs, 1, relu=False)]
            if bottleneck
            else [_conv(inputs, width, 3, stride), _conv(width, width, relu=False)]
        )
        self.body = nn.Sequential(*body)
        same = stride == 1 and inputs == outputs
        self.shortcut = nn.Identity() if same else _conv(inputs, outputs, 1, stride, relu=False)

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(self.body(x) + self.shortcut(x))


class _ResNet(nn.Module):
    """The stages of a residual network (He et al., CVPR 2016): outputs at 1/4, 1/8, 1/16 and 1/32."""

    def __init__(self, depths: tuple[int, ...], bottleneck: bool) -> None:
        super().__init__()
        self.stem = _conv(3, 64, 7, 2)
        inputs, stages = 64, []
        for stage, depth in enumerate(depths):
            width = 64 << stage
            blocks = []
            for block in range(depth):
                blocks.append(_Block(inputs, width, 2 if stage and not block else 1, bottleneck))
                inputs = 4 * width if bottleneck else width
            stages.append(nn.Sequential(*blocks))
        self.stages = nn.ModuleList(stages)

    def forward(self, x: Tensor) -> list[Tensor]:
        x = max_pool2d(self.stem(x), 3, 2, 1)
        levels = []
        for stage in self.stages:
            x = stage(x)
            levels.append(x)
        return levels


class UltraFastLanes(nn.Module):
    """ResNet-18 and dense layers for 100 columns and none, 56 rows, 4 lanes."""

    def __init__(self) -> None:
        super().__init__()
        self.backbone = _ResNet((2, 2, 2, 2), bottleneck=False)
        self.pool = nn.Conv2d(512, 8, 1)
        self.dense = nn.Sequential(nn.Linear(8 * 9 * 25, 2048), nn.ReLU(), nn.Linear(2048, 101 * 56 * 4))

    def forward(self, image: Tensor) -> Tensor:
        return self.dense(self.pool(self.backbone(image)[-1]).flatten(1)).view(-1, 101, 56, 4)


class MaskRcnn(nn.Module):
    """ResNet-50, feature pyramid, proposal head, box head and mask head."""

    BOXES, MASKS, CLASSES = 100, 10, 9

    def __init__(self) -> None:
        super().__init__()
        self.backbone = _ResNet((3, 4, 6, 3), bottleneck=True)
        self.lateral = nn.ModuleList(nn.Conv2d(256 << level, 256, 1) for level in range(4))
        self.smooth = nn.ModuleList(nn.Conv2d(256, 256, 3, padding=1) for _ in range(4))
        self.proposals = nn.Sequential(nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(), nn.Conv2d(256, 15, 1))
        self.boxes = nn.Sequential(
            nn.Linear(256 * 49, 1024),
            nn.ReLU(),
            nn.Linear(1024, 1024),
            nn.ReLU(),
            nn.Linear(1024, 5 * self.CLASSES),
        )
        masks = [layer for _ in range(4) for layer in (nn.Conv2d(256, 256, 3, padding=1), nn.ReLU())]
        self.masks = nn.Sequential(
            *masks, nn.ConvTranspose2d(256, 256, 2, 2), nn.ReLU(), nn.Conv2d(256, self.CLASSES, 1)
        )

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        levels = [lateral(x) for lateral, x in zip(self.lateral, self.backbone(image), strict=True)]
        for fine in (2, 1, 0):
            levels[fine] = levels[fine] + interpolate(levels[fine + 1], scale_factor=2.0, mode="nearest")
        levels = [smooth(x) for smooth, x in zip(self.smooth, levels, strict=True)]
        levels.append(max_pool2d(levels[-1], 1, 2))
        proposals = [self.proposals(x) for x in levels]
        boxes = _windows(levels[1], 7, self.BOXES // 10, 10).flatten(1)
        return *proposals, self.boxes(boxes), self.masks(_windows(levels[0], 14, 1, self.MASKS))


def _windows(x: Tensor, size: int, rows: int, columns: int) -> Tensor:
    """Windows side by side (rows * columns, C, size, size) from the corner of a level (1, C, H, W)."""
    part = x[0, :, : rows * size, : columns * size].reshape(-1, rows, size, columns, size)
    return part.permute(1, 3, 0, 2, 4).reshape(rows * columns, -1, size, size)


class UNet(nn.Module):
    """Two 3 x 3 convolutions at each of five levels down and four up, skips concatenated."""

    WIDTHS = (64, 128, 256, 512, 1024)

    def __init__(self) -> None:
        super().__init__()
        pairs = zip((3, *self.WIDTHS), self.WIDTHS, strict=False)
        self.down = nn.ModuleList(nn.Sequential(_conv(i, o), _conv(o, o)) for i, o in pairs)
        widths = self.WIDTHS[::-1]
        steps = list(pairwise(widths))
        self.up = nn.ModuleList(nn.ConvTranspose2d(i, o, 2, 2) for i, o in steps)
        self.join = nn.ModuleList(nn.Sequential(_conv(i, o), _conv(o, o)) for i, o in steps)
        self.head = nn.Conv2d(widths[-1], 9, 1)

    def forward(self, image: Tensor) -> Tensor:
        skips = [self.down[0](image)]
        for down in self.down[1:]:
            skips.append(down(max_pool2d(skips[-1], 2)))
        x = skips.pop()
        for up, join in zip(self.up, self.join, strict=True):
            x = join(torch.cat([skips.pop(), up(x)], dim=1))
        return self.head(x)


PEERS = {
    "UFLD-ResNet18": Peer(UltraFastLanes, 288, 800),
    "Mask-R-CNN-sized": Peer(MaskRcnn, 736, 1280),
    "U-Net-sized": Peer(UNet, 352, 640),
}
"""By name, fastest first."""
