"""The few operations on rigid motions that the small dense fits need, numpy in and out."""

from __future__ import annotations

import numpy as np
import torch

from v2hdm.geometry import transform
from v2hdm.records import FloatArray


def hat(vectors: FloatArray) -> FloatArray:
    """Skew matrices (..., 3, 3): ``hat(a) @ b == cross(a, b)``."""
    return np.asarray(transform.hat(torch.as_tensor(vectors)).numpy())


def adjoints(dst_from_src: FloatArray) -> FloatArray:
    """Matrices (..., 6, 6) that take tangents of ``src`` to ``dst``."""
    return np.asarray(transform.adjoint(torch.as_tensor(dst_from_src)).numpy())


def exp(tangents: FloatArray) -> FloatArray:
    """Rigid motions (..., 4, 4) of tangents (..., 6)."""
    return np.asarray(transform.exp(torch.as_tensor(tangents)).numpy())


def left_jacobians(tangents: FloatArray) -> FloatArray:
    """Derivatives (..., 6, 6) of :func:`exp`."""
    return np.asarray(transform.left_jacobian(torch.as_tensor(tangents)).numpy())
