"""Results of sections as the result of their drive."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import accumulate

import numpy as np

from v2hdm.association.sightings import frames_of
from v2hdm.faults import Contradiction
from v2hdm.faults.odds import is_doubtful, log_odds
from v2hdm.io.maps.evidence import Residuals
from v2hdm.mapping.results import AdjustedPoses, CameraFit, MethodResult, SolveEvidence
from v2hdm.records import Drive, IntArray


def merged(results: Sequence[MethodResult], drive: Drive, own_images: Sequence[IntArray]) -> MethodResult:
    """The results of all sections as one; ``own_images`` are each one's, by their indices in the drive.

    Calibrations are the same in all. Of evidence that each section has, the most doubtful counts, or the
    mean, weighted by observations.
    """
    weight = [result.diagnostics["observations"] for result in results]
    most = int(np.argmax(weight))
    best = results[most]
    begins = [0, *accumulate(len(result.hd_map.markings) for result in results)]
    hd_map = replace(
        best.hd_map,
        markings=tuple(marking for result in results for marking in result.hd_map.markings),
        lanes=tuple(lane for result in results for lane in result.hd_map.lanes),
        symbols=tuple(symbol for result in results for symbol in result.hd_map.symbols),
    )
    suspicions = [
        replace(suspicion, marking=suspicion.marking + begin)
        for result, begin in zip(results, begins, strict=False)
        for suspicion in result.suspicions
    ]
    diagnostics = {key: sum(result.diagnostics[key] for result in results) for key in best.diagnostics}
    for key in ("gap", "chi2_per_dof", "evaluations"):
        diagnostics[key] = best.diagnostics[key]

    def mean(value: Callable[[MethodResult], float | None]) -> float | None:
        values = [value(result) for result in results]
        stated = [(number, w) for number, w in zip(values, weight, strict=True) if number is not None]
        return float(np.sqrt(np.average([v**2 for v, _ in stated], weights=[w for _, w in stated])))

    return replace(
        best,
        hd_map=hd_map,
        excluded=tuple(exclusion for result in results for exclusion in result.excluded),
        reprojection_rmse_px=mean(lambda result: result.reprojection_rmse_px),
        initial_reprojection_rmse_px=mean(lambda result: result.initial_reprojection_rmse_px),
        diagnostics=diagnostics,
        evidence=_evidence([result.evidence for result in results if result.evidence is not None], weight),
        poses=_poses(results, drive, own_images),
        joint_covariance=None,
        residuals=_residuals([result.residuals for result in results if result.residuals], begins),
        suspicions=sorted(suspicions, key=lambda suspicion: suspicion.p),
        heard=tuple(heard for result in results for heard in result.heard),
    )


def _poses(results: Sequence[MethodResult], drive: Drive, own_images: Sequence[IntArray]) -> AdjustedPoses:
    frames = frames_of(drive)
    count = len(frames.stamp_s)
    map_from_vehicle = frames.map_from_vehicle.copy()
    sigma = np.zeros((count, 6))
    has_marking = np.zeros(count, dtype=np.bool_)
    for result, images in zip(results, own_images, strict=True):
        poses = result.poses
        assert poses is not None
        at = frames.frame_of_image[images]
        local = np.array([poses.frame[drive.images[image].path] for image in images.tolist()])
        map_from_vehicle[at] = poses.map_from_vehicle[local]
        sigma[at] = poses.sigma[local]
        has_marking[at] = poses.has_marking[local]
    return AdjustedPoses(
        stamp_s=frames.stamp_s,
        before=frames.map_from_vehicle,
        map_from_vehicle=map_from_vehicle,
        sigma=sigma,
        has_marking=has_marking,
        frame={
            image.path: frame
            for image, frame in zip(drive.images, frames.frame_of_image.tolist(), strict=True)
        },
        session=frames.session,
    )


def _residuals(parts: Sequence[Residuals], begins: Sequence[int]) -> Residuals:
    """The residuals of all sections, markings numbered on.

    Observations of candidates that are left out are in those of every section that saw them.
    """
    images = np.cumsum([0, *(len(part.image) for part in parts)])

    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(part, name) for part in parts])

    return Residuals(
        image=tuple(name for part in parts for name in part.image),
        camera=tuple(name for part in parts for name in part.camera),
        taken_s=joined("taken_s"),
        row_image=np.concatenate(
            [part.row_image + first for part, first in zip(parts, images, strict=False)]
        ),
        marking=np.concatenate(
            [
                np.where(part.marking > 0, part.marking + begin, 0)
                for part, begin in zip(parts, begins, strict=False)
            ]
        ),
        corner=joined("corner"),
        is_point=joined("is_point"),
        observed_px=joined("observed_px"),
        residual_px=joined("residual_px"),
        distance_sigma=joined("distance_sigma"),
    )


def _evidence(parts: Sequence[SolveEvidence], weight: Sequence[float]) -> SolveEvidence:
    def mean(value: Callable[[SolveEvidence], float]) -> float:
        return float(np.average([value(part) for part in parts], weights=weight))

    worst = max(parts, key=lambda part: part.worst_innovation)
    names = [name for name in parts[0].held_out if all(name in part.held_out for part in parts)]
    return replace(
        parts[int(np.argmax(weight))],
        score_tests=_most_telling([test for part in parts for test in part.score_tests]),
        held_out={
            name: float(np.average([part.held_out[name] for part in parts], weights=weight)) for name in names
        },
        fits=_fits([part.fits for part in parts]),
        variance_factor=mean(lambda part: part.variance_factor),
        pose_noise={kind: max(part.pose_noise[kind] for part in parts) for kind in parts[0].pose_noise},
        worst_innovation=worst.worst_innovation,
        worst_innovation_s=worst.worst_innovation_s,
        jitter_s=max(part.jitter_s for part in parts),
        along_over_across=mean(lambda part: part.along_over_across),
        clock_m=max((part.clock_m for part in parts if part.clock_m is not None), default=None),
        foreign=max((part.foreign for part in parts), key=lambda segment: segment.gain),
    )


def _most_telling(tests: Sequence[Contradiction]) -> tuple[Contradiction, ...]:
    """The most doubtful test of each input or, where none is, the one that would show the least error.

    The most doubtful come first.
    """
    most_telling: dict[object, Contradiction] = {}
    for test in sorted(tests, key=lambda test: (-log_odds(test) if is_doubtful(test) else 0.0, test.sigma)):
        most_telling.setdefault((test.fault.name, test.axis, test.cameras, test.about), test)
    return tuple(sorted(most_telling.values(), key=log_odds, reverse=True))


def _fits(parts: Sequence[Mapping[str, CameraFit]]) -> dict[str, CameraFit]:
    """The fit of each camera over all sections, weighted by observations."""
    fits = {}
    for name in {name: None for part in parts for name in part}:
        fits_of_camera = [part[name] for part in parts if name in part]
        weights = [fit.observations for fit in fits_of_camera]
        fits[name] = CameraFit(
            observations=sum(weights),
            variance_factor=float(
                np.average([fit.variance_factor for fit in fits_of_camera], weights=weights)
            ),
            rejected_share=float(np.average([fit.rejected_share for fit in fits_of_camera], weights=weights)),
            sightings=sum(fit.sightings for fit in fits_of_camera),
            by_candidate=np.concatenate([fit.by_candidate for fit in fits_of_camera]),
        )
    return fits
