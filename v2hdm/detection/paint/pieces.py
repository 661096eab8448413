"""Connected pieces of paint: joined and completed, or parted, where that makes quadrilaterals of them.

The border of a shadow parts a marking in two, blur and bad light leave only its middle. What the network
says of the rest is doubtful on its own, but where it makes a quadrilateral of the sure part it is right.
Markings that nearly touch run into one piece, and come apart where only what is quite sure is taken.
"""

from __future__ import annotations

import cv2
import numpy as np

_DOUBTFUL = -2.0
_QUITE_SURE = 2.0
"""Log odds of paint below which there is none, and above which there is no doubt."""

_LEAST_CELLS = 20
_LEAST_SURE_SHARE = 0.2
_MOST_SURE_SHARE = 0.6
"""A single sure piece is completed where it holds such a share; with less the doubtful rest decides all."""

_LEAST_PARTED_CELLS = 30
_LEAST_FILL = 0.72
_LEAST_HULL_FILL = 0.84
"""What a contour fills of its hull, and the hull of four straight sides; narrow pieces have steps."""

_SLIM = 5.0
_LEAST_SLIM_FILL = 0.55
"""What is so many times as long as wide need only fill its rectangle by this: it is one or two cells wide."""

_AROUND = np.ones((3, 3), np.uint8)


def settle_pieces(level: np.ndarray, contours: list[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Put quadrilaterals in the place of pieces that are parts of them or run into them.

    Args:
        level: log odds (h, w) of paint, in a frame of one element that is none.
        contours: those (N, 1, 2) of its positive pieces, (column, row).

    Returns:
        The level, shifted in and around the pieces that were put in, so that their outlines are its zero
        crossings too, and the contours.
    """
    if not contours:
        return level, contours
    contours, whole = _completed(level, contours)
    contours, parts = _parted(level, contours)
    for found, log_odds in ((whole, _DOUBTFUL), (parts, _QUITE_SURE)):
        if found:
            around = _with_border(level, found) > 0
            level = np.subtract(level, np.float32(log_odds), out=level.copy(), where=around)
    return level, contours + whole + parts


def _completed(level: np.ndarray, contours: list[np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The contours that stay, and those of doubtful paint that take the place of the others."""
    doubtful = _framed((level > _DOUBTFUL).astype(np.uint8))
    # Labels of 16 bits take a third of the time.
    _, labels, stats, _ = cv2.connectedComponentsWithStats(doubtful, ltype=cv2.CV_16U)
    at = np.array([contour[0, 0] for contour in contours])
    whole = labels[at[:, 1], at[:, 0]]
    parts = np.bincount(whole, minlength=len(stats))
    cells = stats[:, cv2.CC_STAT_AREA]
    sure = np.bincount(whole, [_cells(contour) for contour in contours], len(stats))
    share = sure / np.maximum(cells, 1)
    asked = (parts >= 2) | ((parts == 1) & (share < _MOST_SURE_SHARE))
    asked &= (cells >= _LEAST_CELLS) & (share > _LEAST_SURE_SHARE)
    asked[0] = False
    taken: dict[int, np.ndarray] = {}
    for label in np.flatnonzero(asked).tolist():
        x, y, w, h = stats[label, : cv2.CC_STAT_AREA].tolist()
        contour = _outermost(labels[y : y + h, x : x + w] == label, x, y)
        if fills_a_quadrilateral(contour):
            taken[label] = contour
    kept = [c for c, label in zip(contours, whole.tolist(), strict=True) if label not in taken]
    return kept, list(taken.values())


def _parted(level: np.ndarray, contours: list[np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The contours, less the quadrilaterals of quite sure paint that run into others, and those."""
    kept: list[np.ndarray] = []
    parts: list[np.ndarray] = []
    for contour in contours:
        if _cells(contour) < 2 * _LEAST_PARTED_CELLS or fills_a_quadrilateral(contour):
            kept.append(contour)
            continue
        x, y, w, h = cv2.boundingRect(contour)
        own = np.zeros((h, w), dtype=np.uint8)
        cv2.drawContours(own, [contour - (x, y)], -1, 1, cv2.FILLED)
        sure = own & (level[y : y + h, x : x + w] > _QUITE_SURE)
        found = [c for c in _outer(sure) if _cells(c) >= _LEAST_PARTED_CELLS]
        whole = [c for c in found if fills_a_quadrilateral(c)] if len(found) > 1 else []
        if not whole:
            kept.append(contour)
            continue
        parts += [c + np.array([x, y], dtype=np.int32) for c in whole]
        cv2.drawContours(sure, whole, -1, 2, cv2.FILLED)
        own[cv2.dilate((sure == 2).astype(np.uint8), _AROUND) > 0] = 0
        kept += [c + np.array([x, y], dtype=np.int32) for c in _outer(own) if len(c) >= 4]
    return kept, parts


def _with_border(level: np.ndarray, contours: list[np.ndarray]) -> np.ndarray:
    """Mask (h, w) of what is inside the contours and of the elements next to them, but for the frame."""
    mask = np.zeros(level.shape, dtype=np.uint8)
    cv2.drawContours(mask, contours, -1, 1, cv2.FILLED)
    return _framed(cv2.dilate(mask, _AROUND))


def _framed(mask: np.ndarray) -> np.ndarray:
    """The mask with its first and last rows and columns emptied, in place."""
    mask[[0, -1]] = 0
    mask[:, [0, -1]] = 0
    return mask


def _outer(mask: np.ndarray) -> list[np.ndarray]:
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return list(contours)


def _outermost(mask: np.ndarray, x: int, y: int) -> np.ndarray:
    """The contour of a connected mask whose first element is at (x, y)."""
    return max(_outer(mask.astype(np.uint8)), key=len) + np.array([x, y], dtype=np.int32)


def _cells(contour: np.ndarray) -> float:
    """How many elements a contour of every border element encloses, itself included (Pick's theorem)."""
    return float(cv2.contourArea(contour) + len(contour) / 2 + 1)


def fills_a_quadrilateral(contour: np.ndarray) -> bool:
    """Whether a contour (N, 1, 2) of every border element has four straight sides, as one marking has."""
    hull = cv2.convexHull(contour)
    area = cv2.contourArea(hull)
    _, size, _ = cv2.minAreaRect(hull)
    long, narrow = max(size) + 1, min(size) + 1
    if long > _SLIM * narrow:
        return _cells(contour) > _LEAST_SLIM_FILL * long * narrow
    if len(hull) < 4 or cv2.contourArea(contour) < _LEAST_FILL * area:
        return False
    quad = cv2.approxPolyN(hull, 4).reshape(-1, 2)
    return len(quad) == 4 and area >= _LEAST_HULL_FILL * cv2.contourArea(quad)
