"""How right the adjustment is, and how right it is about itself, over simulated drives.

``python -m tests.benchmarks.adjust_accuracy [section ...] [--drives N]`` prints asked and measured figures of

- ``honesty``: normalised estimation error squared (NEES) and coverage of the 95 % regions,
- ``efficiency``: RMSE against the Cramer-Rao bound, disturbances marginalised,
- ``disturbances``: corner RMSE beside that of undisturbed poses and of the paper's model,
- ``remedies``: what would lower the bound where RTK errors drift: other routes, more passes, a survey.

tests/adjust/test_accuracy.py runs the same functions on few drives. Convergence from far away is measured by
:mod:`tests.benchmarks.adjust_convergence`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch

from tests.adjust.scene import Scene, make_scene
from v2hdm.adjust import ControlPoints, Drift, Observations, PoseSigma, SolveOptions, solve
from v2hdm.adjust.covariance import Covariance
from v2hdm.adjust.descent import Descent
from v2hdm.adjust.engines import make_engine
from v2hdm.adjust.layout import make_arrays
from v2hdm.adjust.model import Estimate, Loss
from v2hdm.adjust.problem import POSE_STATES
from v2hdm.adjust.whitening import factorise

PAPER = SolveOptions(pose_states=(), loss="none")
PLAIN = SolveOptions(loss="none")
ROBUST = SolveOptions(loss="cauchy")

WHITE = PoseSigma(
    position_m=0.02, heading_rad=np.deg2rad(0.1), roll_pitch_rad=np.deg2rad(0.3), height_m=0.005
)
DRIFTING = replace(WHITE, position_drift=Drift(0.018, 30.0))
"""RTK errors correlated over 30 m, little of them white."""

ALL_DRIFTING = replace(
    DRIFTING,
    heading_drift=Drift(0.7 * WHITE.heading_rad, 5.0),
    roll_pitch_drift=Drift(0.7 * WHITE.roll_pitch_rad, 1.2),
)
ALL_OVER_30_M = replace(
    DRIFTING,
    heading_drift=Drift(0.95 * WHITE.heading_rad, 30.0),
    roll_pitch_drift=Drift(0.95 * WHITE.roll_pitch_rad, 30.0),
)
"""Every error but the height correlated over 30 m."""

# What a chi-square variable with two degrees of freedom exceeds once in twenty times.
_CHI2_95 = 5.991


@dataclass(frozen=True)
class Honesty:
    """Mean NEES per degree of freedom of one drive, and share within the 95 % region, by kind of unknown."""

    corner_nees: float
    corner_coverage: float
    rotation_nees: float
    centre_nees: float
    chi2_per_dof: float


def honesty(scene: Scene) -> Honesty:
    """Compare the errors of one solve with the covariances that it states."""
    solution = solve(scene.problem, replace(PLAIN, coarse=False))
    error = solution.corners_map - scene.corners_map
    covariance = solution.corner_covariance(np.arange(scene.problem.corner_count)[:, None])
    corner = np.einsum("na,nab,nb->n", error, np.linalg.inv(covariance), error)
    off = solution.cam_from_vehicle @ np.linalg.inv(scene.cam_from_vehicle)
    turn = np.stack([off[:, 2, 1], off[:, 0, 2], off[:, 1, 0]], axis=1)
    # The left tangent's translation is the motion of the vehicle's origin; with the turn taken out.
    shift = off[:, :3, 3]
    by_camera = solution.extrinsic_covariance
    rotation = np.einsum("ca,cab,cb->c", turn, np.linalg.inv(by_camera[:, 3:, 3:]), turn) / 3
    centre = np.einsum("ca,cab,cb->c", shift, np.linalg.inv(by_camera[:, :3, :3]), shift) / 3
    return Honesty(
        corner_nees=float(corner.mean() / 2),
        corner_coverage=float(np.mean(corner <= _CHI2_95)),
        rotation_nees=float(rotation.mean()),
        centre_nees=float(centre.mean()),
        chi2_per_dof=solution.chi2_per_dof,
    )


def squared_bound_m2(scene: Scene, pose_states: tuple[str, ...] = POSE_STATES) -> float:
    """Mean trace of the corners' covariances that no unbiased estimator can beat: the Cramer-Rao bound.

    The inverse of the information at the truth, frame states and extrinsics marginalised out; with a
    prior it is the bound of van Trees (Detection, Estimation and Modulation Theory, section 2.4).
    """
    arrays = make_arrays(scene.problem, pose_states, "cpu")
    truth = Estimate(
        torch.as_tensor(scene.cam_from_vehicle),
        torch.zeros_like(arrays.state_information_root),
        torch.as_tensor(scene.corners_map)[arrays.corner_order],
        arrays.no_clock(),
    )
    engine = make_engine("auto", arrays)
    whitening = factorise(engine, engine.plan(), truth, Loss("none", 1.0))
    at_truth = Descent(
        engine=engine,
        plan=whitening.plan,
        estimate=truth,
        robust=whitening.robust,
        terms=whitening.terms,
        gap=0.0,
        evaluations=0,
        progressing=False,
        is_singular=whitening.is_singular,
        last_whitening=whitening,
    )
    groups = np.arange(scene.problem.corner_count)[:, None]
    return float(np.trace(Covariance(at_truth).corners(groups), axis1=1, axis2=2).mean())


def squared_error_m2(scene: Scene, options: SolveOptions) -> float:
    """Mean squared distance of the adjusted corners from the truth."""
    return scene.corner_rmse_m(solve(scene.problem, options).corners_map) ** 2


def root_ratio(numerators: Iterable[float], denominators: Iterable[float]) -> float:
    """Root of the ratio of two means."""
    return float(np.sqrt(np.mean(list(numerators)) / np.mean(list(denominators))))


def root_mean_cm(squares_m2: Iterable[float]) -> float:
    """Root mean square in cm."""
    return 100 * float(np.sqrt(np.mean(list(squares_m2))))


def street(seed: int, jitter: PoseSigma | None = None, outliers: float = 0.0, **changes: float) -> Scene:
    """A drive of 60 m with turns, two cameras, some 130 corners, 6000 observations; one seed, one street.

    Corners are seen at least five times: of two observations, one of them wrong, nobody can tell which.
    """
    options = {
        "frames": 80,
        "step_m": 0.75,
        "every_m": 2.0,
        "start_error_deg": 1.0,
        "min_views": 5,
        **changes,
    }
    return make_scene(
        seed, jitter=jitter, outliers=outliers, noise_seed=10_000 + seed, max_range_m=30.0, **options
    )


def print_honesty(drives: int) -> None:
    """The table of :func:`honesty`."""
    for name, jitter in (("white", WHITE), ("drifting", ALL_DRIFTING)):
        results = [honesty(street(seed, jitter)) for seed in range(drives)]
        for figure, goal in (
            ("corner_nees", 1.0),
            ("corner_coverage", 0.95),
            ("rotation_nees", 1.0),
            ("centre_nees", 1.0),
            ("chi2_per_dof", 1.0),
        ):
            values = np.array([getattr(result, figure) for result in results])
            error = values.std(ddof=1) / np.sqrt(drives)
            print(
                f"  {name:9s} {figure:16s} asked {goal:4.2f}  measured {values.mean():5.3f} +- {error:5.3f}"
            )


def print_efficiency(drives: int) -> None:
    """RMSE over Cramer-Rao bound; the paper's model beside it."""
    for name, jitter in (("white", WHITE), ("drifting", ALL_DRIFTING)):
        scenes = [street(seed, jitter) for seed in range(drives)]
        bound = [squared_bound_m2(scene) for scene in scenes]
        ours = root_ratio((squared_error_m2(scene, PLAIN) for scene in scenes), bound)
        paper = root_ratio((squared_error_m2(scene, PAPER) for scene in scenes), bound)
        print(f"  {name:9s} RMSE / bound  asked <= 1.10  measured {ours:5.3f}  (paper's model {paper:5.2f})")


def print_disturbances(drives: int) -> None:
    """Corner RMSE under disturbances as a multiple of what undisturbed poses allow, on two kinds of route.

    Where a route turns, exact poses tell to millimetres where the cameras are and disturbed ones cannot;
    where it does not, neither can, and the survey of the cameras is what is left. Disturbed and undisturbed
    drives share streets, pixel noise and survey. ``bounds`` is the ratio of the two problems' Cramer-Rao
    bounds: what a model that knows all disturbances but their values must lose.
    """
    for route, changes in (("with turns", {}), ("straight", {"turn_deg_per_m": 0.0})):
        undisturbed = [street(seed, **changes) for seed in range(drives)]
        calm = [squared_error_m2(scene, PAPER) for scene in undisturbed]
        calm_bound = [squared_bound_m2(scene, ()) for scene in undisturbed]
        unaware = [replace(scene, problem=replace(scene.problem, pose_sigma=WHITE)) for scene in undisturbed]
        wary = [squared_error_m2(scene, PLAIN) for scene in unaware]
        print(
            f"  {route}: undisturbed poses, paper's model {root_mean_cm(calm):.2f} cm (bound "
            f"{root_mean_cm(calm_bound):.2f}); by who takes them for disturbed {root_mean_cm(wary):.2f} cm"
        )
        for name, jitter, outliers, options, goal in (
            ("white", WHITE, 0.0, PLAIN, "<= 1.2"),
            ("white, robust", WHITE, 0.0, ROBUST, "<= 1.2"),
            ("3 % wrong", WHITE, 0.03, ROBUST, "<= 1.3"),
            ("RTK over 30 m", DRIFTING, 0.0, ROBUST, "<= 0.25 x paper's"),
            ("all over 30 m", ALL_OVER_30_M, 0.0, ROBUST, "<= 0.25 x paper's"),
        ):
            scenes = [street(seed, jitter, outliers, **changes) for seed in range(drives)]
            ours = [squared_error_m2(scene, options) for scene in scenes]
            paper = [squared_error_m2(scene, PAPER) for scene in scenes]
            bound = [squared_bound_m2(scene) for scene in scenes]
            print(
                f"    {name:14s} {root_mean_cm(ours):5.2f} cm (bound {root_mean_cm(bound):5.2f}) = "
                f"{root_ratio(ours, calm):5.2f} x undisturbed (bounds {root_ratio(bound, calm_bound):5.2f}), "
                f"{root_ratio(ours, paper):5.2f} x paper's model ({root_mean_cm(paper):5.2f} cm, "
                f"bound {root_ratio(bound, paper):5.2f}); asked {goal}",
                flush=True,
            )


def driven_again(scene: Scene, passes: int) -> Scene:
    """The same route driven so often, each time with errors of its own; what was seen is the same.

    In between the vehicle is far away, so that a drift has faded when it comes back.
    """
    problem, frames = scene.problem, len(scene.problem.map_from_vehicle) + 1
    observations, count = problem.observations, len(scene.problem.observations.corner)
    again = Observations(
        np.tile(observations.camera, passes),
        np.tile(observations.frame, passes) + frames * np.repeat(np.arange(passes), count),
        np.tile(observations.corner, passes),
        np.tile(observations.pinhole_px, (passes, 1)),
        np.tile(observations.covariance_px, (passes, 1, 1)),
    )
    away = np.eye(4)
    away[0, 3] = 10_000.0
    poses = np.tile(np.concatenate([problem.map_from_vehicle, away[None]]), (passes, 1, 1))
    return replace(scene, problem=replace(problem, observations=again, map_from_vehicle=poses))


def surveyed(scene: Scene, count: int) -> Scene:
    """So many corners, evenly along the route, surveyed to 5 mm."""
    corner = np.linspace(0, scene.problem.corner_count - 1, count).round().astype(np.int64)
    control = ControlPoints(corner, scene.corners_map[corner], np.full((count, 2), 0.005))
    return replace(scene, problem=replace(scene.problem, control=control))


def print_remedies(drives: int) -> None:
    """The bound where positions drift over 30 m, and what lowers it, beside the paper's model.

    A drift moves the vehicle and all that it maps alike: no camera sees it. ``drift alone`` is the error of
    corners that inherit the drift of the frame that saw them, cameras and all else perfect.
    """
    scenes = [street(seed, DRIFTING) for seed in range(drives)]
    paper = [squared_error_m2(scene, PAPER) for scene in scenes]
    alone = 100 * np.sqrt(2) * DRIFTING.position_drift.sigma
    print(
        f"  paper's model {root_mean_cm(paper):.2f} cm; drift alone {alone:.2f} cm; asked <= 0.25 x paper's"
    )
    calm = replace(WHITE, position_m=0.001, heading_rad=1e-5, roll_pitch_rad=1e-5, height_m=0.0001)
    exact = replace(calm, position_m=0.0181, position_drift=DRIFTING.position_drift)
    cases = {
        "as it is": scenes,
        "no error but the drift": [street(seed, exact) for seed in range(drives)],
        "straight": [street(seed, DRIFTING, turn_deg_per_m=0.0) for seed in range(drives)],
        "turning twice as hard": [street(seed, DRIFTING, turn_deg_per_m=8.0) for seed in range(drives)],
        **{f"{n} passes": [driven_again(scene, n) for scene in scenes] for n in (2, 4, 8)},
        **{f"{n} surveyed corners": [surveyed(scene, n) for scene in scenes] for n in (1, 2, 4, 8, 16)},
    }
    for name, changed in cases.items():
        bound = [squared_bound_m2(scene) for scene in changed]
        ratio = root_ratio(bound, paper)
        print(
            f"    {name:24s} bound {root_mean_cm(bound):5.2f} cm = {ratio:4.2f} x paper's model", flush=True
        )


SECTIONS = {
    "honesty": (print_honesty, 100),
    "efficiency": (print_efficiency, 50),
    "disturbances": (print_disturbances, 20),
    "remedies": (print_remedies, 20),
}


def main() -> None:
    """Print the sections asked for, or all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("section", nargs="*", choices=[*SECTIONS, []], default=[])
    parser.add_argument("--drives", type=int, help="drives per figure; the default is what the figure asks")
    arguments = parser.parse_args()
    for name in arguments.section or SECTIONS:
        run, usual = SECTIONS[name]
        drives = arguments.drives or usual
        began = time.process_time()
        print(f"{name}, {drives} drives:", flush=True)
        run(drives)
        print(f"  {time.process_time() - began:.0f} s of one core", flush=True)


if __name__ == "__main__":
    main()
