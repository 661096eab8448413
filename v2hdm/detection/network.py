"""The ONNX network: loaded, checked, run on a band of an image."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime

from v2hdm.errors import DetectorError
from v2hdm.records import PAINT_CLASSES

DEFAULT_MODEL = Path(__file__).with_name("default.onnx")

_METADATA_KEY = "v2hdm"
_BACKGROUND = "background"


@dataclass(frozen=True)
class NetworkInfo:
    """What a model file says of itself.

    ``classes`` are those of output channels 1, 2, ...; inputs are padded to ``multiple`` px;
    ``stride`` is the number of px per logit.
    """

    classes: tuple[str, ...]
    multiple: int
    stride: int


class Network:
    """A segmentation network: uint8 BGR images in, logits of background and paint classes out.

    Logit (row i, column j) belongs to image point (stride * j + (stride - 1) / 2, likewise i).
    """

    def __init__(self, path: Path | None = None, threads: int = 1):
        """Load a model file.

        Raises:
            DetectorError: there is no such file, it is not an ONNX model or not one of ours.
        """
        self.path = DEFAULT_MODEL if path is None else Path(path)
        self._session = _open_session(self.path, threads)
        self.info = _read_info(self._session, self.path)

    def logits(self, image_bgr: np.ndarray) -> np.ndarray:
        """Logits (C, ceil(H / stride), ceil(W / stride)) float32 of an image (H, W, 3) uint8 of any size.

        Raises:
            DetectorError: the network refused the image.
        """
        height, width = image_bgr.shape[:2]
        multiple, stride = self.info.multiple, self.info.stride
        padded = image_bgr
        if height % multiple or width % multiple:
            padded = cv2.copyMakeBorder(
                image_bgr, 0, -height % multiple, 0, -width % multiple, cv2.BORDER_REPLICATE
            )
        try:
            (out,) = self._session.run(["logits"], {"image": np.ascontiguousarray(padded)[None]})
        except Exception as error:  # onnxruntime raises classes of its own that are not exported
            raise DetectorError(
                f"{self.path}: the network failed on a {width}x{height} image ({_one_line(error)}); "
                "export it again with dynamic sizes"
            ) from error
        expected = (1, len(self.info.classes) + 1, padded.shape[0] // stride, padded.shape[1] // stride)
        if out.shape != expected:
            raise DetectorError(
                f"{self.path}: logits are {out.shape} where {expected} was promised; export it again"
            )
        return np.asarray(out[0, :, : -(-height // stride), : -(-width // stride)])


def _open_session(path: Path, threads: int) -> Any:
    if not path.is_file():
        raise DetectorError(
            f"{path}: no such detector model; give the path of an ONNX file written by `python -m export`"
        )
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise DetectorError(
            f"{path}: not a usable ONNX model ({_one_line(error)}); export it again"
        ) from error


def _read_info(session: Any, path: Path) -> NetworkInfo:
    try:
        metadata = json.loads(session.get_modelmeta().custom_metadata_map[_METADATA_KEY])
        classes = tuple(str(name) for name in metadata["classes"])
        info = NetworkInfo(
            classes[1:] if classes[:1] == (_BACKGROUND,) else classes,
            int(metadata["multiple"]),
            int(metadata["stride"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise DetectorError(
            f"{path}: no usable {_METADATA_KEY!r} metadata ({_one_line(error)}); "
            "this is not a model written by `python -m export`"
        ) from error
    unknown = [name for name in info.classes if name not in PAINT_CLASSES]
    if unknown or not info.classes:
        raise DetectorError(
            f"{path}: unknown classes {unknown}, known are {', '.join(PAINT_CLASSES)}; use another model"
        )
    if info.stride < 1 or info.multiple < 1 or info.multiple % info.stride:
        raise DetectorError(
            f"{path}: stride {info.stride} does not divide multiple {info.multiple}; export it again"
        )
    names = ([node.name for node in session.get_inputs()], [node.name for node in session.get_outputs()])
    if names != (["image"], ["logits"]):
        raise DetectorError(
            f"{path}: inputs and outputs are {names}, not ['image'] and ['logits']; export it again"
        )
    return info


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
