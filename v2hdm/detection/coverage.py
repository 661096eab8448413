"""How much of each pixel a quadrilateral covers, blurred by the point spread, and how that changes.

By Green's theorem the quadrilateral's convolution with a Gaussian g is an integral along its sides,

    C(p) = sum over sides of  dv * integral_0^1  Phi((u(s) - p_u) / b) g((v(s) - p_v) / b) / b  ds,

and moving a side by w changes it by the integral of (w x side) g g. Both are taken by two-point
Gauss-Legendre quadrature on pieces short against the blur b. Everything separates into rows and
columns, so a patch costs a few matrix products.
"""

from __future__ import annotations

import numpy as np

from v2hdm.detection.normal import normal_pdf_cdf

_PIECE_PER_BLUR = 1.6
_GAUSS_OFFSET = 0.5 / np.sqrt(3.0)


def blurred_coverage(
    corners: np.ndarray, columns: np.ndarray, rows: np.ndarray, blur_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """Coverage of pixels by quadrilaterals and its derivative by their corners.

    Args:
        corners: (M, 4, 2) px, in the order of :mod:`v2hdm.detection.quad`.
        columns: (M, W) the u of the pixel centres.
        rows: (M, H) the v of the pixel centres.
        blur_px: standard deviation of the point spread, pixel aperture included.

    Returns:
        Coverage (M, H, W) in [0, 1] and its derivative (M, 4, 2, H, W), both float32.
    """
    along = np.roll(corners, -1, axis=1) - corners
    pieces = max(1, int(np.ceil(np.linalg.norm(along, axis=-1).max() / (_PIECE_PER_BLUR * blur_px))))
    centre = (np.arange(pieces) + 0.5) / pieces
    s = np.sort(np.concatenate([centre - _GAUSS_OFFSET / pieces, centre + _GAUSS_OFFSET / pieces]))
    point = corners[:, :, None] + s[:, None] * along[:, :, None]
    inverse = np.float32(1 / blur_px)
    pdf_u, cdf_u = normal_pdf_cdf((point[..., 0, None] - columns[:, None, None]).astype(np.float32) * inverse)
    pdf_v = normal_pdf_cdf((point[..., 1, None] - rows[:, None, None]).astype(np.float32) * inverse)[0]
    pdf_v *= inverse / np.float32(2 * pieces)
    pdf_v = np.swapaxes(pdf_v, -1, -2)
    # Counter-clockwise on the screen means clockwise in (u, v): hence the minus signs.
    du, dv = (along[..., k, None, None].astype(np.float32) for k in (0, 1))
    coverage = -((dv * pdf_v) @ cdf_u).sum(axis=1)
    weight = s.astype(np.float32)
    pdf_u *= inverse
    by_end = (pdf_v * weight) @ pdf_u
    by_start = (pdf_v * (1 - weight)) @ pdf_u
    derivative = np.empty((len(corners), 4, 2, rows.shape[1], columns.shape[1]), dtype=np.float32)
    for axis, side in ((0, -dv), (1, du)):
        derivative[:, :, axis] = side * by_start + np.roll(side * by_end, 1, axis=1)
    return coverage, derivative
