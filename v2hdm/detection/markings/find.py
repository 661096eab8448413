"""The markings of one image: propose, fit, judge."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from v2hdm.catalogue import Catalogue
from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.markings.evidence import gather
from v2hdm.detection.markings.fit import TYPICAL_BLUR_PX, fit_quadrilaterals
from v2hdm.detection.markings.fitted import Fit
from v2hdm.detection.markings.foreground import Foreground
from v2hdm.detection.markings.frames import Quads
from v2hdm.detection.markings.judge import judge_alone, judge_among
from v2hdm.detection.markings.lattice import Scene
from v2hdm.detection.markings.propose import Proposal, open_sides
from v2hdm.detection.markings.rectified import rectified_views
from v2hdm.detection.options import DetectorOptions
from v2hdm.records import FloatArray, MarkingDetection


@dataclass(frozen=True)
class Readings:
    """R readings of M fitted quadrilaterals, each of one as one class: what the judge is asked about.

    ``quadrilateral`` (R,) is the index of each, ``kinds`` its class; ``evidence`` (R, F) and ``views``
    (R, C, S, S) are what the judge sees, ``ground`` (R, 4, 2) the corners, m. The first side in a view is
    side ``first_side`` (R,) of the quadrilateral. ``parts`` lists, by quadrilateral around a whole piece of
    paint, those around its parts: either the one or the others are markings.
    """

    fit: Fit
    quadrilateral: np.ndarray
    kinds: list[str]
    evidence: FloatArray
    views: np.ndarray
    ground: FloatArray
    first_side: np.ndarray
    parts: Mapping[int, Sequence[int]]


def find_markings(
    readings: Readings | None, view: CameraView, options: DetectorOptions
) -> list[MarkingDetection]:
    """The quadrilaterals that are likely enough to be whole markings, each as its likeliest class."""
    if readings is None:
        return []
    odds, side_sigma_px = judge_alone(readings.evidence, readings.views, readings.kinds)
    score = judge_among(odds, readings.ground, readings.kinds)
    best = _best_of_each(readings.quadrilateral, score)
    turned = (np.arange(4) - readings.first_side[best, None]) % 4
    sigma_px = np.take_along_axis(side_sigma_px[best], turned, axis=1)
    corners_px, covariance = readings.fit.in_image(sigma_px)
    valid = largest_sigma(covariance) <= options.max_corner_sigma_px
    valid &= view.inside(corners_px, options.border_px)
    left_out: set[int] = set()
    for whole, parts in readings.parts.items():
        if whole in left_out:
            continue
        surest = max(score[best[m]] for m in parts)
        left_out.update(parts if score[best[whole]] >= surest else [whole])
    return [
        MarkingDetection(readings.kinds[row], float(score[row]), corners_px[m], covariance[m], valid[m])
        for m, row in enumerate(best.tolist())
        if score[row] >= options.min_confidence and m not in left_out
    ]


def read_markings(
    image_bgr: np.ndarray,
    view: CameraView,
    proposals: Sequence[Proposal],
    foreground: Foreground,
    catalogue: Catalogue,
    blur_px: float | None,
) -> Readings | None:
    """Fit the proposals with four corners and gather the evidence for their classes; None for none."""
    tried = [(proposal, kinds) for proposal in proposals if (kinds := proposal.kinds(catalogue))]
    if not tried:
        return None
    chosen = [proposal for proposal, _ in tried]
    start = np.stack([p.corners_pinhole_px for p in chosen if p.corners_pinhole_px is not None])
    start_px = view.distort(start.reshape(-1, 2)).reshape(start.shape)
    blobs = np.array([p.index for p in chosen])
    scene = Scene(image_bgr, foreground, blobs, blobs + np.array([p.blob.parts for p in chosen]))
    fit = fit_quadrilaterals(scene, view, start_px, open_sides(start_px, view), blur_px or TYPICAL_BLUR_PX)
    corners_px, _ = fit.in_image()
    quads = Quads.seen(view, corners_px)
    ground = view.ground(view.undistort(corners_px.reshape(-1, 2))).reshape(corners_px.shape)
    rows = [(m, kind) for m, (_, kinds) in enumerate(tried) for kind in kinds]
    evidence = gather(fit, foreground, quads, ground, chosen, rows, catalogue)
    at = np.array([m for m, _ in rows], dtype=np.intp)
    kinds = [kind for _, kind in rows]
    views, first_side = rectified_views(
        image_bgr, view, foreground, quads.take(at), ground[at], kinds, catalogue
    )
    place = {p.index: m for m, p in enumerate(chosen)}
    parts = {
        m: [place[k] for k in range(p.index + 1, p.index + 1 + p.blob.parts) if k in place]
        for m, p in enumerate(chosen)
        if p.blob.parts
    }
    return Readings(
        fit, at, kinds, evidence, views, ground[at], first_side, {m: k for m, k in parts.items() if k}
    )


def _best_of_each(quadrilateral: np.ndarray, score: FloatArray) -> np.ndarray:
    """The reading (M,) of each quadrilateral with the highest score; of equals the likelier."""
    order = np.lexsort((-np.arange(len(score)), score))
    best = np.zeros(int(quadrilateral.max()) + 1, dtype=np.intp)
    best[quadrilateral[order]] = order
    return best


def largest_sigma(covariance: FloatArray) -> FloatArray:
    """Standard deviation (M, 4) of each corner in its least certain direction, from (M, 8, 8)."""
    u = np.arange(0, 8, 2)
    first, second, both = covariance[:, u, u], covariance[:, u + 1, u + 1], covariance[:, u, u + 1]
    return np.asarray(np.sqrt((first + second) / 2 + np.hypot((first - second) / 2, both)))
