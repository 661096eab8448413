"""The ONNX network: loaded, checked, run on a band of an image."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime

from v2hdm.catalogue import SHIPPED, Catalogue
from v2hdm.detection.weights import NETWORK_FILE
from v2hdm.errors import ConfigError, DetectorError

DEFAULT_MODEL = NETWORK_FILE

METADATA_KEY = "v2hdm"
"""Under which key of the file's ``metadata_props`` its label is, as JSON."""

_OUTPUTS = ["paint", "kinds", "lanes"]

_PROVIDERS: dict[str, tuple[str, dict[str, str]]] = {
    "cpu": ("CPUExecutionProvider", {}),
    # float32 as on the CPU, and one algorithm each time: what is found does not depend on the process.
    "cuda": ("CUDAExecutionProvider", {"use_tf32": "0", "cudnn_conv_algo_search": "HEURISTIC"}),
}
_BEHIND = {"cpu": [], "cuda": ["CPUExecutionProvider"]}
"""For the few operations that a device does not have."""


@dataclass(frozen=True)
class NetworkInfo:
    """What a model file says of itself.

    ``classes`` are those of the channels of ``kinds``; inputs are padded to ``multiple`` px; the strides are
    the numbers of px per element of each output. ``catalogue`` describes the classes.
    """

    classes: tuple[str, ...]
    multiple: int
    paint_stride: int
    kind_stride: int
    lane_stride: int
    catalogue: Catalogue = SHIPPED


@dataclass(frozen=True)
class NetworkOutput:
    """What the network says of an image.

    Element (i, j) of an output of stride s belongs to the image point (s * j + (s - 1) / 2, likewise i).
    ``paint`` (h, w) float32: log odds of paint. ``kinds`` (K, h', w') float32: logits of its class.
    ``lanes`` (2, h", w") float32: log odds that a lane's line crosses the row anchor in the cell, and its
    offset from the cell's centre in cells.
    """

    paint: np.ndarray
    kinds: np.ndarray
    lanes: np.ndarray


class Network:
    """The paint and lane network: uint8 BGR images in, :class:`NetworkOutput` out."""

    def __init__(self, path: Path | None = None, threads: int = 1, device: str = "cpu"):
        """Load a model file, to be run on ``cpu`` or ``cuda``.

        Raises:
            DetectorError: there is no such file, it is not an ONNX model or not one of ours, or the device is
                not there.
        """
        self.path = DEFAULT_MODEL if path is None else Path(path)
        self._session = open_session(self.path, threads, device)
        self.info = _read_info(self._session, self.path)

    def run(self, image_bgr: np.ndarray) -> NetworkOutput:
        """Look at an image (H, W, 3) uint8 of any size.

        Raises:
            DetectorError: the network refused the image, or what it says is not what its label promises.
        """
        height, width = image_bgr.shape[:2]
        multiple = self.info.multiple
        padded = image_bgr
        if height % multiple or width % multiple:
            padded = cv2.copyMakeBorder(
                image_bgr, 0, -height % multiple, 0, -width % multiple, cv2.BORDER_REPLICATE
            )
        try:
            outputs = self._session.run(_OUTPUTS, {"image": np.ascontiguousarray(padded)[None]})
        except Exception as error:  # onnxruntime raises classes of its own that are not exported
            raise DetectorError(
                f"{self.path}: the network failed on a {width}x{height} image ({_one_line(error)}); "
                "export it again with dynamic sizes"
            ) from error
        paint, kinds, lanes = (
            self._cropped(name, output, channels, stride, padded.shape, (height, width))
            for name, output, channels, stride in zip(
                _OUTPUTS,
                outputs,
                (1, len(self.info.classes), 2),
                (self.info.paint_stride, self.info.kind_stride, self.info.lane_stride),
                strict=True,
            )
        )
        # A sum meets every value: not-a-number among the weights of an output spreads over all of it.
        if not all(np.isfinite(output[0].sum()) for output in (paint, kinds, lanes)):
            raise DetectorError(
                f"{self.path}: the network gives values that are not finite; export an earlier checkpoint"
            )
        return NetworkOutput(paint[0], kinds, lanes)

    def _cropped(
        self,
        name: str,
        output: np.ndarray,
        channels: int,
        stride: int,
        padded: tuple[int, ...],
        size: tuple[int, int],
    ) -> np.ndarray:
        """One output (C, h, w) without the padding."""
        expected = (1, channels, padded[0] // stride, padded[1] // stride)
        if output.shape != expected:
            raise DetectorError(
                f"{self.path}: {name} is {output.shape} where {expected} was promised; export it again"
            )
        return np.asarray(output[0, :, : -(-size[0] // stride), : -(-size[1] // stride)])


def check_device(device: str) -> None:
    """Refuse a device that this onnxruntime was built without.

    Raises:
        DetectorError: says what to install.
    """
    provider = _PROVIDERS[device][0]
    if provider not in onnxruntime.get_available_providers():
        raise DetectorError(
            f"detector.device is {device}, but this onnxruntime has no {provider}: install onnxruntime-gpu "
            "in its place, or set detector.device=cpu"
        )


def open_session(path: Path, threads: int, device: str = "cpu") -> Any:
    """A model file ready to run on so many threads, on ``cpu`` or ``cuda``.

    Raises:
        DetectorError: there is no such file, it is not an ONNX model, or the device is not there.
    """
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
        provider, settings = _PROVIDERS[device]
        session = onnxruntime.InferenceSession(
            str(path), options, providers=[(provider, settings), *_BEHIND[device]]
        )
    except Exception as error:
        raise DetectorError(
            f"{path}: not a usable ONNX model ({_one_line(error)}); export it again"
        ) from error
    # Where the driver or cuDNN fails, onnxruntime goes on without a word on the CPU.
    if provider not in session.get_providers():
        raise DetectorError(
            f"detector.device is {device}, but onnxruntime could not start {provider}: check the driver, "
            "CUDA and cuDNN, or set detector.device=cpu"
        )
    return session


def read_catalogue(metadata: Mapping[str, Any]) -> Catalogue:
    """The classes that a model file describes: the shipped ones, and after them those of its user.

    Raises:
        ConfigError: one of them is wrong.
    """
    return SHIPPED.with_own(metadata.get("own_classes", {}), "its classes")


def _read_info(session: Any, path: Path) -> NetworkInfo:
    try:
        metadata = json.loads(session.get_modelmeta().custom_metadata_map[METADATA_KEY])
        paint, kinds, lanes = (int(metadata["strides"][name]) for name in _OUTPUTS)
        classes = tuple(str(name) for name in metadata["classes"])
        info = NetworkInfo(classes, int(metadata["multiple"]), paint, kinds, lanes, read_catalogue(metadata))
    except ConfigError as error:
        raise DetectorError(f"{path}: {error}") from error
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise DetectorError(
            f"{path}: no usable '{METADATA_KEY}' metadata ({_one_line(error)}); "
            "this is not a model written by `python -m export`"
        ) from error
    unknown = [name for name in info.classes if name not in info.catalogue.classes]
    if unknown or not info.classes:
        raise DetectorError(
            f"{path}: unknown classes {unknown}, known are {', '.join(info.catalogue.names)}; "
            "use another model"
        )
    strides = (info.paint_stride, info.kind_stride, info.lane_stride)
    if min(strides) < 1 or any(info.multiple % stride for stride in strides):
        raise DetectorError(
            f"{path}: strides {strides} do not divide multiple {info.multiple}; export it again"
        )
    if info.kind_stride % info.paint_stride:
        raise DetectorError(
            f"{path}: the stride of kinds, {info.kind_stride}, is no multiple of that of paint, "
            f"{info.paint_stride}; export it again"
        )
    names = ([node.name for node in session.get_inputs()], [node.name for node in session.get_outputs()])
    if names != (["image"], _OUTPUTS):
        raise DetectorError(
            f"{path}: inputs and outputs are {names}, not ['image'] and {_OUTPUTS}; export it again"
        )
    return info


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
