"""The paint and lane network: an ONNX file, run on the rows of an image that show road.

A metre of ground near the vehicle fills so many pixels that half of them, in each direction, show all that
the network needs; corners are refined on the image itself afterwards. So far ground is looked at in full
resolution and near ground in half of it, which halves the time.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime

from v2hdm.catalogue import AREA, SHIPPED, Catalogue
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.steps import Steps, last
from v2hdm.detection.weights import NETWORK_FILE
from v2hdm.errors import ConfigError, DetectorError, one_line
from v2hdm.records import SEEN_ACROSS, FloatArray
from v2hdm.safe.placeholders import placeholder_words
from v2hdm.safe.texts import parse_json

METADATA_KEY = "v2hdm"  # key of the file's ``metadata_props`` that holds its label, as JSON

_OUTPUTS = ["paint", "kinds", "lanes"]

_PROVIDERS: dict[str, tuple[str, dict[str, str]]] = {
    "cpu": ("CPUExecutionProvider", {}),
    # float32 as on the CPU, and one algorithm each time: detections do not depend on the process.
    "cuda": ("CUDAExecutionProvider", {"use_tf32": "0", "cudnn_conv_algo_search": "HEURISTIC"}),
}

OVERLAP_PX = 32  # overlap of the two resolutions, so that either has its surroundings where they are joined
_MOST_MULTIPLE = 1024  # largest multiple of px that images are padded to: an encoder halves them ten times
GRID_PX = 16  # least grid, px, of the rows that the seam may be at: it is that of all outputs
_MIRRORED = np.array([1.0, -1.0], dtype=np.float32)[:, None, None]
"""Factors of a lane output (2, h, w), log odds and offset, in the mirror."""

_LEAST_LOG_ODDS = -3.0
"""Crossings of lanes' lines less likely than this are left out; unlikely ones help to follow a known line."""

_MOST_ODDS = 6.0  # log odds of paint beyond which they differ by chance only
_MOST_CERTAIN = 0.999  # probability from which more is chance
_MOST_EXPONENT = 30.0  # log odds beyond which a probability is the same: 1e-13 of 0 or 1


def as_probability(odds: np.ndarray) -> np.ndarray:
    """Probabilities, in the shape and precision of the log odds."""
    return np.asarray(1 / (1 + np.exp(-np.clip(odds, -_MOST_EXPONENT, _MOST_EXPONENT))))


def as_log_odds(probability: np.ndarray) -> np.ndarray:
    """Log odds of probabilities, clipped so that those near 0 or 1 do not dominate."""
    share = np.clip(probability, 1.0 - _MOST_CERTAIN, _MOST_CERTAIN)
    return np.asarray(np.log(share / (1.0 - share)))


@dataclass(frozen=True)
class NetworkInfo:
    """The label of a model file; strides are px per element of each output."""

    classes: tuple[str, ...]  # of the channels of ``kinds``
    multiple: int  # px that inputs are padded to
    paint_stride: int
    kind_stride: int
    lane_stride: int
    catalogue: Catalogue = SHIPPED

    @property
    def strides(self) -> tuple[int, ...]:
        """Pixels per element of the three outputs: paint, kinds and lanes."""
        return self.paint_stride, self.kind_stride, self.lane_stride


@dataclass(frozen=True)
class RawOutput:
    """The network's output on an image; element (i, j) of stride s is at s * j + (s - 1) / 2, likewise i."""

    paint: np.ndarray  # (h, w) float32: log odds of paint
    kinds: np.ndarray  # (K, h', w') float32: logits of its class
    # (2, h", w") float32: log odds that a line crosses the row anchor in the cell; offset, cells
    lanes: np.ndarray


@dataclass(frozen=True)
class AnchorRow:
    """The crossings of lanes' lines on one image row ``v_px``: columns (N,) px and log odds (N,)."""

    v_px: float
    u_px: FloatArray
    odds: FloatArray


@dataclass(frozen=True)
class NetworkOutput:
    """The network's output, as :class:`RawOutput`, on the rows of an image that show road.

    Areas are asked for apart: the other classes share what is paint among themselves, as if there were none.
    A stroke of a letter may be a dash as well, and a network that learns areas later says of all else what it
    said before.
    """

    paint: np.ndarray
    kinds: np.ndarray  # (K, h', w') logits of the classes that are no areas
    anchors: list[AnchorRow]  # from near to far
    classes: tuple[str, ...]  # of ``kinds``
    stride: int  # px per element of paint
    top: int  # the first image row
    areas: np.ndarray  # (A, h', w') logits of the areas' classes
    area_classes: tuple[str, ...]

    @classmethod
    def of(
        cls,
        paint: np.ndarray,
        logits: np.ndarray,
        anchors: list[AnchorRow],
        classes: Sequence[str],
        stride: int,
        top: int,
        catalogue: Catalogue = SHIPPED,
    ) -> NetworkOutput:
        """The output whose ``logits`` (K + A, h', w') are of ``classes`` in any order."""
        of_areas = catalogue.of_family(AREA)
        is_area = np.isin(classes, of_areas)
        # A view of the others where the areas come last, as in the shipped catalogue.
        count = int(np.count_nonzero(~is_area))
        kinds = logits[~is_area] if is_area[:count].any() else logits[:count]
        return cls(
            paint=paint,
            kinds=kinds,
            anchors=anchors,
            classes=tuple(name for name in classes if name not in of_areas),
            stride=stride,
            top=top,
            areas=logits[is_area],
            area_classes=tuple(name for name in classes if name in of_areas),
        )

    @cached_property
    def kind_scale(self) -> float:
        """Elements of ``paint`` per element of ``kinds``, in each direction."""
        return float(self.paint.shape[1] / self.kinds.shape[2])

    def from_row(self, row: int) -> NetworkOutput:
        """The output from an image row on that is some network's multiples below ``top``, or all of it."""
        first = max(row - self.top, 0) // self.stride
        return replace(
            self,
            paint=self.paint[first:],
            kinds=self.kinds[:, round(first / self.kind_scale) :],
            areas=self.areas[:, round(first / self.kind_scale) :],
            anchors=[anchor for anchor in self.anchors if anchor.v_px >= row],
            top=self.top + first * self.stride,
        )

    def odds_at(self, points_px: FloatArray) -> np.ndarray:
        """Log odds of paint, at most 6 either way, at recorded px (..., 2); outside, those of the border."""
        (odds,) = self._sample(self.paint[None], self.stride, points_px)
        return np.asarray(np.clip(odds, -_MOST_ODDS, _MOST_ODDS)).reshape(points_px.shape[:-1])

    def shares_at(self, points_px: FloatArray) -> np.ndarray:
        """Probability of each of ``classes``, were it paint, at recorded px (M, ..., 2): (K, M, ...)."""
        odds = self._sample(self.kinds, self.stride * self.kind_scale, points_px)
        odds -= odds.max(axis=0)
        odds = np.asarray(cv2.exp(odds.reshape(len(odds), -1)))
        return np.asarray(odds / odds.sum(axis=0)).reshape((len(odds), *points_px.shape[:-1]))

    def class_probability(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Probability (K, N) of each of ``classes`` at elements of ``paint``."""
        return as_shares(self._logits_at(self.kinds, rows, columns))

    def area_odds(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Logits (A + K, N) of areas and, after them, of other classes at elements of ``paint``."""
        planes = (self.areas, self.kinds)
        return np.concatenate([self._logits_at(logits, rows, columns) for logits in planes])

    def _logits_at(self, logits: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Logits (C, N) of planes like ``kinds`` at elements of ``paint``."""
        scale = self.kind_scale
        place = (rows / scale).astype(np.intp) * logits.shape[2] + (columns / scale).astype(np.intp)
        return np.asarray(logits.reshape(len(logits), -1).take(place, axis=1))

    def _sample(self, planes: np.ndarray, stride: float, points_px: FloatArray) -> np.ndarray:
        """Values (K, M, N) of planes (K, h, w), elements ``stride`` px apart, at recorded px (M, ..., 2)."""
        middle = (stride - 1) / 2
        rows = len(points_px)
        u = ((points_px[..., 0] - middle) / stride).astype(np.float32).reshape(rows, -1)
        v = ((points_px[..., 1] - self.top - middle) / stride).astype(np.float32).reshape(rows, -1)
        values = np.empty((len(planes), *u.shape), dtype=np.float32)
        for plane, values_of_plane in zip(planes, values, strict=True):
            cv2.remap(plane, u, v, cv2.INTER_LINEAR, dst=values_of_plane, borderMode=cv2.BORDER_REPLICATE)
        return values


class Network:
    """The paint and lane network: uint8 BGR images in, :class:`RawOutput` out."""

    def __init__(self, path: Path | None = None, threads: int = 1, device: str = "cpu"):
        """Load a model file, to be run on ``cpu`` or ``cuda``; raises DetectorError where it cannot be."""
        self.path = NETWORK_FILE if path is None else Path(path)
        self._session = open_session(self.path, threads, device)
        self.info = _read_info(self._session, self.path)

    def run(self, image_bgr: np.ndarray) -> RawOutput:
        """Look at an image (H, W, 3) uint8 of any size; DetectorError where the output is not as labelled."""
        height, width = image_bgr.shape[:2]
        below = -height % self.info.multiple
        right = -width % self.info.multiple
        padded = image_bgr
        if below or right:
            padded = cv2.copyMakeBorder(image_bgr, 0, below, 0, right, cv2.BORDER_REPLICATE)
        try:
            outputs = self._session.run(_OUTPUTS, {"image": np.ascontiguousarray(padded)[None]})
        except Exception as error:  # onnxruntime raises classes of its own that are not exported
            raise DetectorError(
                f"{self.path}: the network failed on a {width}x{height} image ({_cause(error)}); "
                "export it again with dynamic sizes"
            ) from error
        planes = []
        channels = (1, len(self.info.classes), 2)
        for name, output, count, stride in zip(_OUTPUTS, outputs, channels, self.info.strides, strict=True):
            expected = (1, count, padded.shape[0] // stride, padded.shape[1] // stride)
            if output.shape != expected:
                raise DetectorError(
                    f"{self.path}: {name} is {output.shape} instead of {expected}; export it again"
                )
            planes.append(np.asarray(output[0, :, : -(-height // stride), : -(-width // stride)]))
        # A sum meets every value: not-a-number among the weights of an output spreads over all of it.
        if not all(np.isfinite(output[0].sum()) for output in planes):
            raise DetectorError(
                f"{self.path}: the network's outputs are not finite; export an earlier checkpoint"
            )
        paint, kinds, lanes = planes
        return RawOutput(paint[0], kinds, lanes)


def run_on_road(
    network: Network,
    image_bgr: np.ndarray,
    camera: RoadCamera,
    mirrored: bool = False,
    top: int | None = None,
) -> NetworkOutput:
    """Run the network on the rows that show ground in reach, and take the mean with the mirror image's.

    ``top`` is the first row, else the camera's ``far_row``, whole multiples of the network's away.
    """
    return last(steps_on_road(network, image_bgr, camera, mirrored, top))


def steps_on_road(
    network: Network,
    image_bgr: np.ndarray,
    camera: RoadCamera,
    mirrored: bool = False,
    top: int | None = None,
) -> Steps[NetworkOutput]:
    """As :func:`run_on_road`, in two steps: far ground, and near ground with half the resolution."""
    info = network.info
    top = camera.far_row if top is None else top
    band = image_bgr[top:]
    run = partial(run_twice, network) if mirrored else network.run
    seam = seam_row(network, camera, top)
    if seam is None:
        output = run(band)
        paint = output.paint
        kinds = output.kinds
        anchors = anchor_rows(output.lanes, network, top, 1)
    else:
        fine = run(band[: seam + OVERLAP_PX])
        yield
        coarse_top = seam - OVERLAP_PX
        coarse = run(cv2.resize(band[coarse_top:], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
        coarse_rows = anchor_rows(coarse.lanes, network, top + coarse_top, 2)
        fine_rows = anchor_rows(fine.lanes, network, top, 1)
        anchors = [row for row in coarse_rows if row.v_px >= top + seam]
        anchors += [row for row in fine_rows if row.v_px < top + seam]
        paint = _joined(fine.paint[None], coarse.paint[None], seam, coarse_top, info.paint_stride)[0]
        kinds = _joined(fine.kinds, coarse.kinds, seam, coarse_top, info.kind_stride)
    kinds = as_seen_from(camera, kinds, info.classes)
    return NetworkOutput.of(paint, kinds, anchors, info.classes, info.paint_stride, top, info.catalogue)


def as_seen_from(camera: RoadCamera, kinds: np.ndarray, classes: Sequence[str]) -> np.ndarray:
    """Logits (K, h, w) of classes, renamed where a camera looks aside.

    Seen from the side a dash lies across the view, as a stop line does seen from the front, and the other way
    round: the network knows of the view alone.
    """
    if not camera.aside or not set(SEEN_ACROSS) <= set(classes):
        return kinds
    return np.asarray(kinds[[classes.index(SEEN_ACROSS.get(name, name)) for name in classes]])


def as_shares(logits: np.ndarray) -> np.ndarray:
    """Probabilities (C, N) of logits, in their place."""
    logits -= logits.max(axis=0)
    np.exp(logits, out=logits)
    logits /= logits.sum(axis=0)
    return logits


def run_twice(network: Network, image_bgr: np.ndarray) -> RawOutput:
    """The mean of the outputs on an image (H, W, 3) and on its mirror image."""
    width = image_bgr.shape[1]
    info = network.info
    # Only whole elements have mirror images on the same grid.
    padded = cv2.copyMakeBorder(image_bgr, 0, 0, 0, -width % info.multiple, cv2.BORDER_REPLICATE)
    output = network.run(padded)
    mirrored = network.run(cv2.flip(padded, 1))
    odds, offset = output.lanes
    mirrored_odds, mirrored_offset = mirrored.lanes[..., ::-1] * _MIRRORED
    # Where a line crosses a cell only that output knows that sees it cross.
    weight = as_probability(odds - mirrored_odds)
    mean_odds = (odds + mirrored_odds) / 2
    lanes = np.stack([mean_odds, weight * offset + (1 - weight) * mirrored_offset])
    paint_columns, kind_columns, lane_columns = (-(-width // stride) for stride in info.strides)
    return RawOutput(
        paint=((output.paint + mirrored.paint[:, ::-1]) / 2)[..., :paint_columns],
        kinds=((output.kinds + mirrored.kinds[..., ::-1]) / 2)[..., :kind_columns],
        lanes=lanes[..., :lane_columns],
    )


def seam_row(network: Network, camera: RoadCamera, top: int) -> int | None:
    """Row of the band from ``top`` from which half the resolution will do; None if that saves nothing."""
    grid = max(GRID_PX, network.info.multiple)
    height = camera.info.height - top
    if camera.fine_row is None or camera.info.width % (2 * grid) or height % grid:
        return None
    seam = -(-max(camera.fine_row - top, 0) // grid) * grid
    seam += (height - seam) % (2 * grid)
    is_worth_it = height - seam >= 3 * OVERLAP_PX
    return seam if is_worth_it and seam >= OVERLAP_PX else None


def _joined(fine: np.ndarray, coarse: np.ndarray, seam: int, coarse_top: int, stride: int) -> np.ndarray:
    """Planes (K, h, w), ``stride`` px per element: fine ones above the seam, doubled coarse ones below it."""
    first = seam // stride
    overlap = (seam - coarse_top) // stride
    height = first - overlap + 2 * coarse.shape[1]
    width = 2 * coarse.shape[2]
    joined = np.empty((len(fine), height, width), dtype=np.float32)
    for whole, plane in zip(joined, coarse, strict=True):
        doubled = whole[first - overlap :]
        cv2.resize(plane, (width, len(doubled)), dst=doubled, interpolation=cv2.INTER_LINEAR)
    joined[:, :first] = fine[:, :first]
    return joined


def anchor_rows(lanes: np.ndarray, network: Network, top_px: int, scale: int) -> list[AnchorRow]:
    """Peaks along each row of ``lanes`` (2, h, w), near to far, of an image reduced by ``scale``."""
    odds, offset = lanes
    peak = odds > _LEAST_LOG_ODDS
    peak[:, 1:] &= odds[:, 1:] >= odds[:, :-1]
    peak[:, :-1] &= odds[:, :-1] > odds[:, 1:]
    i, j = np.nonzero(peak)
    stride = network.info.lane_stride
    u = stride * (j + np.clip(offset[i, j], -0.5, 0.5) + 0.5) - 0.5
    v = stride * np.arange(len(odds)) + (stride - 1) / 2
    # Pixel p of the reduced image is centred on scale * p + (scale - 1) / 2 of the image.
    u = scale * u + (scale - 1) / 2
    v = scale * v + (scale - 1) / 2 + top_px
    peak_odds = odds[i, j].astype(np.float64)
    bounds = np.searchsorted(i, np.arange(len(odds) + 1))
    return [
        AnchorRow(float(v[row]), u[part], peak_odds[part])
        for row in range(len(odds) - 1, -1, -1)
        if (part := slice(bounds[row], bounds[row + 1])).stop > part.start
    ]


def crossings(rows: Sequence[AnchorRow]) -> tuple[FloatArray, FloatArray]:
    """Crossings (N, 2), px, of all ``rows`` in order, and their log odds (N,)."""
    none = np.empty(0)
    u_px = np.concatenate([none, *(row.u_px for row in rows)])
    v_px = np.concatenate([none, *(np.full(len(row.u_px), row.v_px) for row in rows)])
    return np.column_stack([u_px, v_px]), np.concatenate([none, *(row.odds for row in rows)])


def check_device(device: str) -> None:
    """Raise DetectorError, with what to install, for a device that this onnxruntime was built without."""
    provider = _PROVIDERS[device][0]
    if provider not in onnxruntime.get_available_providers():
        raise DetectorError(
            f"detector.device is {device}, but this onnxruntime has no {provider}: install onnxruntime-gpu "
            "instead, or set detector.device=cpu"
        )


def open_session(path: Path, threads: int, device: str = "cpu") -> Any:
    """A model file ready to run on ``cpu`` or ``cuda``; raises DetectorError where it cannot be."""
    check_device(device)
    if not path.is_file():
        raise DetectorError(
            f"{path}: no such detector model; give the path of an ONNX file written by `python -m export`"
        )
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        # The CPU does the few operations that a device does not have.
        providers = [_PROVIDERS[name] for name in dict.fromkeys((device, "cpu"))]
        session = onnxruntime.InferenceSession(str(path), options, providers)
    except Exception as error:
        words = placeholder_words(path) or f"not a usable ONNX model ({_cause(error)}); export it again"
        raise DetectorError(f"{path}: {words}") from error
    # Where the driver or cuDNN fails, onnxruntime goes on without a word on the CPU.
    provider = _PROVIDERS[device][0]
    if provider not in session.get_providers():
        raise DetectorError(
            f"detector.device is {device}, but onnxruntime could not start {provider}: check the driver, "
            "CUDA and cuDNN, or set detector.device=cpu"
        )
    return session


def read_catalogue(metadata: Mapping[str, Any]) -> Catalogue:
    """The classes of a model file, the shipped ones first; raises ConfigError where one is wrong."""
    return SHIPPED.with_own(metadata.get("own_classes", {}), "its classes")


def _read_info(session: Any, path: Path) -> NetworkInfo:
    try:
        text = session.get_modelmeta().custom_metadata_map[METADATA_KEY]
        metadata = parse_json(text, f"'{METADATA_KEY}' metadata", ConfigError)
        paint, kinds, lanes = (int(metadata["strides"][name]) for name in _OUTPUTS)
        classes = tuple(str(name) for name in metadata["classes"])
        info = NetworkInfo(classes, int(metadata["multiple"]), paint, kinds, lanes, read_catalogue(metadata))
    except ConfigError as error:
        raise DetectorError(f"{path}: {error}") from error
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise DetectorError(
            f"{path}: no usable '{METADATA_KEY}' metadata ({_cause(error)}); "
            "this is not a model written by `python -m export`"
        ) from error
    problem = None
    unknown = [name for name in info.classes if name not in info.catalogue.classes]
    names = ([node.name for node in session.get_inputs()], [node.name for node in session.get_outputs()])
    channels = session.get_outputs()[1].shape[1:2] if len(session.get_outputs()) > 1 else []
    if unknown or not info.classes:
        names_known = ", ".join(info.catalogue.names)
        problem = f"unknown classes {unknown}, known are {names_known}; use another model"
    elif len(set(info.classes)) < len(info.classes) or any(
        isinstance(count, int) and count != len(info.classes) for count in channels
    ):
        problem = f"its {len(info.classes)} classes do not match the channels of kinds; export it again"
    elif not 0 < info.multiple <= _MOST_MULTIPLE or min(info.strides) < 1:
        problem = f"multiple {info.multiple} and strides {info.strides} are invalid; export it again"
    elif any(info.multiple % stride for stride in info.strides):
        problem = f"strides {info.strides} do not divide multiple {info.multiple}; export it again"
    elif info.kind_stride % info.paint_stride:
        problem = f"the stride of kinds, {info.kind_stride}, is not a multiple of that of paint, "
        problem += f"{info.paint_stride}; export it again"
    elif names != (["image"], _OUTPUTS):
        problem = f"inputs and outputs are {names}, not ['image'] and {_OUTPUTS}; export it again"
    if problem:
        raise DetectorError(f"{path}: {problem}")
    return info


_FRAME = re.compile(r"/\S+:\d+ [^()]*\([^()]*(?:\([^()]*\)[^()]*)*\) ")  # where in onnxruntime's C++ it arose
_IR_VERSIONS = re.compile(r"model IR version: (\d+), max supported IR version: (\d+)")
_OPSETS = re.compile(r"Opset (\d+) is under development.* support for domain (\S+) is till opset (\d+)")


def _cause(error: Exception) -> str:
    """The complaint of onnxruntime, without the places of its own code."""
    text = one_line(_FRAME.sub("", str(error)))
    version = f"this onnxruntime {onnxruntime.__version__}"
    if match := _IR_VERSIONS.search(text):
        return f"its IR version is {match[1]}, and {version} reads up to {match[2]}: update onnxruntime"
    if match := _OPSETS.search(text):
        where, opset, most = match[2], match[1], match[3]
        return f"its opset of {where} is {opset}, and {version} knows up to {most}: update onnxruntime"
    return text.rpartition(" failed:")[2] or type(error).__name__
