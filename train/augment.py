"""Cheap changes to a render that make it another training image, with OpenCV (0.3 ms, not kornia's 22)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from train.losses import IGNORE
from v2hdm.records import PAINT_CLASSES

Bytes = NDArray[np.uint8]


def random_crop(
    rng: np.random.Generator, image: Bytes, labels: Bytes, width: int, height: int
) -> tuple[Bytes, Bytes]:
    """A crop of image and labels, mirrored half the time."""
    row = int(rng.integers(image.shape[0] - height + 1))
    column = int(rng.integers(image.shape[1] - width + 1))
    window = slice(row, row + height), slice(column, column + width)
    image, labels = image[window], labels[window]
    if rng.random() < 0.5:
        image, labels = image[:, ::-1], labels[:, ::-1]
    return np.ascontiguousarray(image), np.ascontiguousarray(labels)


def random_photometry(rng: np.random.Generator, image: Bytes) -> Bytes:
    """Another contrast, brightness, gamma and tint, now and then grey, compressed or sharpened."""
    levels = np.linspace(0.0, 1.0, 256)
    gain, lift, gamma = np.exp(rng.normal(0, 0.15)), rng.normal(0, 0.03), np.exp(rng.normal(0, 0.15))
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


def half_resolution(labels: Bytes) -> Bytes:
    """Labels (H/2, W/2) of 2 x 2 pixel blocks: the class of three or more of the pixels, ignored at a tie.

    Where paint and background halve a block neither answer is right; ignoring those keeps the learnt
    edge at the true one instead of half a pixel outside or inside it.
    """
    height, width = labels.shape
    blocks = (
        labels.reshape(height // 2, 2, width // 2, 2)
        .transpose(0, 2, 1, 3)
        .reshape(height // 2, width // 2, 4)
    )
    counts = np.stack([(blocks == c).sum(axis=2) for c in range(1 + len(PAINT_CLASSES))], axis=2)
    return np.where(counts.max(axis=2) > 2, counts.argmax(axis=2), IGNORE).astype(np.uint8)


def _bytes(image: object) -> Bytes:
    """OpenCV's return types are too wide for a strict reader."""
    return np.asarray(image, dtype=np.uint8)
