"""Cheap changes to a render that make it another training image, with OpenCV (0.3 ms, not kornia's 22)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from train.scenes.scenes import TrainingSample

Bytes = NDArray[np.uint8]


def random_crop(rng: np.random.Generator, sample: TrainingSample, width: int, height: int) -> TrainingSample:
    """A crop of a sample, mirrored half the time."""
    row = int(rng.integers(sample.image.shape[0] - height + 1))
    column = int(rng.integers(sample.image.shape[1] - width + 1))
    flip = -1 if rng.random() < 0.5 else 1
    window = slice(row, row + height), slice(column, column + width)
    image = np.ascontiguousarray(sample.image[window][:, ::flip])
    labels = np.ascontiguousarray(sample.labels[window][:, ::flip])
    hidden = np.ascontiguousarray(sample.hidden[window][:, ::flip])
    lanes = [lane - (column, row) for lane in sample.lanes_px]
    if flip < 0:
        lanes = [lane * (-1, 1) + (width - 1, 0) for lane in lanes]
    unknown = None
    if sample.unknown is not None:
        unknown = np.ascontiguousarray(sample.unknown[window][:, ::flip])
    return TrainingSample(image, labels, hidden, tuple(lanes), unknown)


def random_photometry(rng: np.random.Generator, image: Bytes) -> Bytes:
    """Another contrast, brightness, gamma and tint, now and then grey, compressed or sharpened."""
    levels = np.linspace(0.0, 1.0, 256)
    gain = np.exp(rng.normal(0, 0.15))
    lift = rng.normal(0, 0.03)
    gamma = np.exp(rng.normal(0, 0.15))
    tint = np.exp(rng.normal(0, 0.05, 3))
    curve = np.clip(((levels**gamma - 0.4) * gain + 0.4 + lift)[:, None] * tint, 0, 1)
    out = _bytes(cv2.LUT(image, np.round(curve * 255).astype(np.uint8)[None]))
    if rng.random() < 0.12:
        out[:] = cv2.cvtColor(out, cv2.COLOR_BGR2GRAY)[..., None]
    if rng.random() < 0.15:
        soft = cv2.GaussianBlur(out, (0, 0), 1.0)
        amount = rng.uniform(0.3, 1.2)
        out = _bytes(cv2.addWeighted(out, 1 + amount, soft, -amount, 0))
    if rng.random() < 0.3:
        quality = int(rng.integers(40, 96))
        _, packed = cv2.imencode(".jpg", out, [cv2.IMWRITE_JPEG_QUALITY, quality])
        out = _bytes(cv2.imdecode(packed, cv2.IMREAD_COLOR))
    return out


def _bytes(image: object) -> Bytes:
    """OpenCV's return types are too wide for a strict reader."""
    return np.asarray(image, dtype=np.uint8)
