"""How near a file is to the network that it was made of, in torch."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass

import numpy as np
import onnxruntime
import torch
from numpy.typing import NDArray

from export.graph import open_session
from models import MarkingNet, Prediction
from models.marking_net import KIND_STRIDE, LANE_STRIDE, PAINT_STRIDE

PARITY_SIZES = ((16, 16), (48, 112), (256, 448), (192, 1248), (544, 960))
"""Image heights and widths at which a float32 file and its network are compared, on noise."""

_AT_LEAST = ("kinds_agree", "lanes_agree")

Pair = tuple[list[NDArray[np.float32]], list[NDArray[np.float32]]]
"""The outputs of the network and those of the file, in the order of :class:`models.Prediction`."""


@dataclass(frozen=True)
class Parity:
    """The effect of int8 arithmetic on the detector's results, over some images.

    Attributes:
        paint_changed: elements that only one of network and file calls paint, per element of the network's.
        outline_px: how far the outline of paint, where its log odds cross 0 between neighbours, is moved
            along rows and columns of the image: the median over all of it.
        outline_bias_px: the mean of the same, outwards positive: by how much paint grows on all sides.
        kinds_agree: share of the painted elements of ``kinds`` that are given the same class.
        lanes_agree: Dice's coefficient of the cells that a lane's line crosses.
        lane_offset_px: by how much the crossing within such a cell moves, the median.
    """

    paint_changed: float
    outline_px: float
    outline_bias_px: float
    kinds_agree: float
    lanes_agree: float
    lane_offset_px: float

    def beyond(self, bounds: dict[str, float]) -> list[str]:
        """The figures that exceed their bounds, with both values; nan exceeds any."""
        out = []
        for name, value in asdict(self).items():
            bound = bounds[name]
            is_within = value >= bound if name in _AT_LEAST else abs(value) <= bound
            if not is_within:
                out.append(f"{name} {value:.3g} (int8.bounds.{name}={bound:g})")
        return out


def largest_difference(net: MarkingNet, content: bytes) -> float:
    """Largest difference of any output between a network and the float32 file made of it."""
    generator = np.random.default_rng(0)
    images = (generator.integers(0, 256, (*size, 3), dtype=np.uint8) for size in PARITY_SIZES)
    worst = 0.0
    for expected, outputs in _pairs(net, content, images):
        for array, array_of_file in zip(expected, outputs, strict=True):
            if array.shape != array_of_file.shape:
                return float("inf")
            worst = max(worst, float(np.abs(array - array_of_file).max()))
    return worst


def int8_parity(net: MarkingNet, content: bytes, images: Iterable[NDArray[np.uint8]]) -> Parity:
    """Hold an int8 file against its network on images (H, W, 3), which should show paint and lanes.

    What there is nothing of in any image counts as the same.
    """
    pairs = [
        ([array[0] for array in outputs], [array[0] for array in outputs_of_file])
        for outputs, outputs_of_file in _pairs(net, content, images)
    ]
    paint = [(outputs[0][0], outputs_of_file[0][0]) for outputs, outputs_of_file in pairs]
    changed = sum(int(((a > 0) != (b > 0)).sum()) for a, b in paint)
    painted = sum(int((a > 0).sum()) for a, _ in paint)
    moved = np.concatenate([_outline_shift_px(a, b) for a, b in paint])
    same_kind = np.concatenate([_same_kinds(outputs, of_file) for outputs, of_file in pairs])
    crossed = [(outputs[2][0] > 0, of_file[2][0] > 0) for outputs, of_file in pairs]
    cross_in_both = sum(int((a & b).sum()) for a, b in crossed)
    crossings = sum(int(a.sum()) + int(b.sum()) for a, b in crossed)
    offsets = np.concatenate(
        [
            LANE_STRIDE * (of_file[2][1] - outputs[2][1])[a & b]
            for (a, b), (outputs, of_file) in zip(crossed, pairs, strict=True)
        ]
    )
    return Parity(
        paint_changed=changed / max(painted, 1),
        outline_px=float(np.median(np.abs(moved))) if len(moved) else 0.0,
        outline_bias_px=float(moved.mean()) if len(moved) else 0.0,
        kinds_agree=float(same_kind.mean()) if len(same_kind) else 1.0,
        lanes_agree=2 * cross_in_both / crossings if crossings else 1.0,
        lane_offset_px=float(np.median(np.abs(offsets))) if len(offsets) else 0.0,
    )


def _pairs(net: MarkingNet, content: bytes, images: Iterable[NDArray[np.uint8]]) -> Iterator[Pair]:
    session: onnxruntime.InferenceSession = open_session(content)
    for image in images:
        with torch.inference_mode():
            prediction = net(torch.from_numpy(image[None]))
        outputs = session.run(list(Prediction._fields), {"image": image[None]})
        yield [output.numpy() for output in prediction], outputs


def _same_kinds(
    outputs: list[NDArray[np.float32]], outputs_of_file: list[NDArray[np.float32]]
) -> NDArray[np.bool_]:
    """Whether the likeliest class is the same, for every element of kinds that is half paint or more."""
    paint = outputs[0][0]
    _, height, width = outputs[1].shape
    side = KIND_STRIDE // PAINT_STRIDE
    share = (paint > 0).reshape(height, side, width, side).mean(axis=(1, 3))
    return np.asarray((outputs[1].argmax(axis=0) == outputs_of_file[1].argmax(axis=0))[share >= 0.5])


def _outline_shift_px(paint: NDArray[np.float32], paint_of_file: NDArray[np.float32]) -> NDArray[np.float32]:
    """How far zero crossings (N,) between the same neighbours are moved, from paint to ground, image px."""
    out = []
    for axis in (0, 1):
        a = np.moveaxis(paint, axis, 0)
        b = np.moveaxis(paint_of_file, axis, 0)
        crossing = (
            ((a[:-1] > 0) != (a[1:] > 0)) & ((b[:-1] > 0) == (a[:-1] > 0)) & ((b[1:] > 0) == (a[1:] > 0))
        )
        at = [(x[:-1] / (x[:-1] - x[1:] + 1e-30))[crossing] for x in (a, b)]
        outwards = np.where(a[:-1][crossing] > 0, 1, -1)
        out.append(PAINT_STRIDE * outwards * (at[1] - at[0]))
    return np.concatenate(out)
