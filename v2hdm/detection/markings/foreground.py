"""What the network says of each part of an image, as the corner fits ask for it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from v2hdm.records import BoolArray, FloatArray

_MOST_ODDS = 6.0
"""Log odds beyond this differ by chance only."""


@dataclass(frozen=True)
class Foreground:
    """Log odds of paint, ``odds`` (h, w), and which blob owns each: ``owner`` (h, w) 1 + index or 0.

    They are ``stride`` px apart, from image row ``top`` on; element (0, 0) covers stride x stride px. Of what
    is paint, ``kinds`` (K, h', w') are the logits of the ``classes``, over the same part of the image.
    """

    odds: np.ndarray
    owner: np.ndarray
    stride: int
    top: int
    kinds: np.ndarray
    classes: tuple[str, ...]

    def others_at(self, u: np.ndarray, v: np.ndarray, first: np.ndarray, last: np.ndarray) -> BoolArray:
        """Where pixels (N,) at ``u``, ``v`` are paint of other blobs than ``first`` to ``last`` (N,)."""
        row = np.clip((v - self.top) // self.stride, 0, self.owner.shape[0] - 1)
        owner = self.owner[row, np.clip(u // self.stride, 0, self.owner.shape[1] - 1)]
        return np.asarray((owner > 0) & ((owner < first + 1) | (owner > last + 1)))

    def odds_at(self, points_px: FloatArray) -> FloatArray:
        """Log odds of paint, at most 6 either way, at recorded px (..., 2); outside, those of the border."""
        found = self._sample(self.odds, self.stride, points_px)
        return np.asarray(np.clip(found, -_MOST_ODDS, _MOST_ODDS), np.float64).reshape(points_px.shape[:-1])

    def shares_at(self, points_px: FloatArray) -> FloatArray:
        """Probability of each of the classes, were it paint, at recorded px (M, ..., 2): (M, K, ...)."""
        stride = self.stride * self.odds.shape[1] / self.kinds.shape[2]
        logits = np.stack([self._sample(plane, stride, points_px) for plane in self.kinds])
        odds = np.exp(logits - logits.max(axis=0))
        shares = (odds / odds.sum(axis=0)).reshape(len(odds), *points_px.shape[:-1])
        return np.asarray(np.moveaxis(shares, 0, 1), dtype=np.float64)

    def _sample(self, plane: np.ndarray, stride: float, points_px: FloatArray) -> np.ndarray:
        """Values (M, N) of a plane (h, w), elements ``stride`` px apart, at recorded px (M, ..., 2)."""
        middle, rows = (stride - 1) / 2, len(points_px)
        u = ((points_px[..., 0] - middle) / stride).astype(np.float32).reshape(rows, -1)
        v = ((points_px[..., 1] - self.top - middle) / stride).astype(np.float32).reshape(rows, -1)
        return np.asarray(cv2.remap(plane, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
