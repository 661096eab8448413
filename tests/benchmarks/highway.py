"""A highway of solid lines and few dashes: the camera's rotation and height with and without lanes.

``python -m tests.benchmarks.highway [--length 2000] [--seeds 1 2 3]``: errors and sigmas of roll, pitch, yaw
(thousandths of a degree) and height (cm) of one camera, by lanes after the adjustment and in it.
"""

import argparse
import time

import numpy as np

from tests.mapping.scene import Scene, SceneOptions, make_scene
from v2hdm.lanes.knots import draw_lanes
from v2hdm.mapping.conclusion import Optimised
from v2hdm.mapping.inputs import Inputs
from v2hdm.mapping.options import MappingOptions
from v2hdm.records import FloatArray, Marking
from v2hdm.site.options import JOINT, LaneOptions

LINES = -1.8, 5.4


def few_dashes(markings: list[Marking]) -> list[Marking]:
    """Every third dash of the left side: one in 18 m."""
    return [marking for marking in markings if marking.kind == "lane_dash"][: len(markings) // 2 : 3]


def mounting_of(optimised: Optimised, scene: Scene) -> tuple[FloatArray, FloatArray]:
    """Errors and sigmas (4,) of roll, pitch, yaw, rad, and height, m, in the vehicle frame."""
    front, true = optimised.calibrations["front"], scene.cam_from_vehicle["front"]
    rotation = true[:3, :3]
    turn = rotation.T @ front.cam_from_vehicle[:3, :3]
    covariance = front.covariance
    assert covariance is not None
    height = front.centre_vehicle[2] + (rotation.T @ true[:3, 3])[2]
    turns = rotation.T @ covariance[3:, 3:] @ rotation
    up = rotation.T @ covariance[:3, :3] @ rotation
    error = np.array([turn[2, 1], turn[0, 2], turn[1, 0], height])
    return error, np.sqrt(np.append(np.diag(turns), up[2, 2]))


def main() -> None:
    """Print a line for each drive and way of treating lanes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--length", type=float, default=2000.0)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parsed = parser.parse_args()
    options = MappingOptions(lanes=LaneOptions(model=JOINT))
    unit = np.append(np.full(3, 1e3 * 180 / np.pi), 100.0)
    for seed in parsed.seeds:
        scene_options = SceneOptions(
            seed=seed, length_m=parsed.length, turns=False, dashes_only=True, lines=LINES
        )
        scene_options.cameras = ("front",)
        scene = make_scene(scene_options, few_dashes)
        inputs = Inputs(scene.drive, scene.detections, scene_options.cameras, options)
        settled = inputs.optimiser.settle(inputs.tracks)
        for name in ("after", "joint"):
            began = time.process_time()
            find = inputs.find_knots if name == JOINT else lambda rig, section: None
            optimised = inputs.optimiser.finish(settled, find_knots=find)
            error, sigma = mounting_of(optimised, scene)
            spent, said = time.process_time() - began, f"errors {np.round(unit * error, 2)}"
            print(f"seed {seed} {name}: {said}, sigmas {np.round(unit * sigma, 2)}, {spent:.1f} s")
            if optimised.bundle.knots is not None:
                _print_lanes(optimised, scene_options)


def _print_lanes(optimised: Optimised, scene_options: SceneOptions) -> None:
    """How far solid lines are off, and how often within 1.96 sigmas."""
    assert optimised.bundle.knots is not None
    lanes = draw_lanes(optimised.bundle.knots, optimised.bundle.solution, 0.5)
    off, sigma = [], []
    for lane in lanes:
        lateral = lane.points_map @ [-np.sin(0.3), np.cos(0.3)]
        if lane.kind == "lane_line" and lane.sigma_m is not None:
            off.append(lateral - min(scene_options.lines, key=lambda line: abs(line - np.median(lateral))))
            sigma.append(lane.sigma_m)
    off_m, sigma_m = np.concatenate(off), np.concatenate(sigma)
    inside = float((np.abs(off_m) < 1.96 * sigma_m).mean())
    rms_cm, median_cm = 100 * float(np.sqrt((off_m**2).mean())), 100 * float(np.median(sigma_m))
    print(f"  solid lines: {rms_cm:.2f} cm, sigma {median_cm:.2f} cm, inside 95 %: {inside:.3f}")


if __name__ == "__main__":
    main()
