"""The accuracy that poses and survey of the rendered ports allow any detector: no image is rendered.

``python -m tests.benchmarks.adjust_ports [run ...] [--drives N]`` drives each port's route with its cameras,
and with the errors of poses and survey that its configuration states, past diamonds of this benchmark,
whose corners are seen with the pixel noise of a good detector. For every set of cameras it prints, over
many drives, the Cramer-Rao bound of the corners, their RMSE, how much of it is one shift of the whole map,
how far drives differ, and how often one with a perfect model and solver misses the 2 cm that are asked.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch
from hydra import compose, initialize_config_dir

from tests.adjust.scene import Scene, make_scene
from tests.benchmarks.adjust_accuracy import PLAIN, root_mean_cm, squared_bound_m2
from v2hdm.adjust import Drift, PoseSigma, solve
from v2hdm.cli import compose as config
from v2hdm.pipeline.config import RunConfig
from v2hdm.simulate.port.build import cam_from_vehicle
from v2hdm.simulate.port.config import PortConfig
from v2hdm.simulate.port.route import pose_noise

WANTED_M = 0.02
PIXEL_SIGMA = 0.4


def port_config(run: str) -> PortConfig:
    """The port of a shipped run."""
    config.register("map", RunConfig)
    with initialize_config_dir(str(config.conf_dir()), version_base="1.3"):
        composed = compose("map", overrides=[f"+run={run}"])
    port = config.to_dataclass(composed, RunConfig, "ask for a rendered port").simulate
    assert port is not None
    return port


def route_of(port: PortConfig) -> np.ndarray:
    """``map_from_vehicle`` (J, 4, 4) at each image of the port's route."""
    poses, heading, position = [], 0.0, np.zeros(2)
    for length_m, turn_deg in port.route.pieces:
        count = round(length_m / port.route.image_spacing_m)
        for _ in range(count):
            heading += np.deg2rad(turn_deg) / count
            c, s = np.cos(heading), np.sin(heading)
            position = position + length_m / count * np.array([c, s])
            pose = np.eye(4)
            pose[:2, :2], pose[:2, 3] = [[c, -s], [s, c]], position
            poses.append(pose)
    return np.array(poses)


def sigma_of(port: PortConfig) -> PoseSigma:
    """How far the port's recorded poses are off."""
    noise = pose_noise(port.disturbance, port.route.speed_mps)
    return PoseSigma(
        position_m=noise.position_m,
        heading_rad=noise.heading_rad,
        roll_pitch_rad=noise.roll_pitch_rad,
        height_m=port.disturbance.heave_m,
        position_drift=Drift(noise.position_drift_m, noise.position_drift_over_m),
        heading_drift=Drift(noise.heading_drift_rad, noise.heading_drift_over_m),
        roll_pitch_drift=Drift(noise.roll_pitch_drift_rad, noise.roll_pitch_drift_over_m),
    )


def drive(port: PortConfig, cameras: list[str], seed: int) -> Scene:
    """One drive through the port with some of its cameras."""
    return make_scene(
        seed,
        noise_seed=1000 + seed,
        driven=route_of(port),
        mounts=np.stack([cam_from_vehicle(port.cameras[name].mount) for name in cameras]),
        step_m=port.route.image_spacing_m,
        every_m=4.0,
        jitter=sigma_of(port),
        pixel_sigma=PIXEL_SIGMA,
        prior_sigma_m=port.calibration.centre_sigma_m,
        max_range_m=16.0,
        min_views=4,
        start_error_deg=1.0,
    )


def print_set(port: PortConfig, cameras: list[str], drives: int) -> None:
    """The figures of one set of cameras."""
    bound, squared, shift = [], [], []
    for seed in range(drives):
        scene = drive(port, cameras, seed)
        error = solve(scene.problem, PLAIN).corners_map - scene.corners_map
        bound.append(squared_bound_m2(scene))
        squared.append(np.mean(np.sum(error**2, axis=1)))
        shift.append(np.sum(error.mean(axis=0) ** 2))
    by_drive, names = 100 * np.sqrt(squared), " + ".join(cameras)
    print(
        f"  {names:12s} bound {root_mean_cm(bound):4.2f} cm, RMSE {root_mean_cm(squared):4.2f} cm (of it one "
        f"shift {root_mean_cm(shift):4.2f}); by drive {by_drive.min():4.2f} to {by_drive.max():4.2f}; above "
        f"{100 * WANTED_M:.0f} cm: {np.count_nonzero(by_drive > 100 * WANTED_M)} of {drives}",
        flush=True,
    )


def main() -> None:
    """Print the ports asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", nargs="*", default=["port1", "port2"])
    parser.add_argument("--drives", type=int, default=30)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    for run in arguments.run:
        port = port_config(run)
        print(f"{run}, {arguments.drives} drives, corners with {PIXEL_SIGMA} px:", flush=True)
        names = list(port.cameras)
        for cameras in ([name] for name in names):
            print_set(port, cameras, arguments.drives)
        if len(names) > 1:
            print_set(port, names, arguments.drives)


if __name__ == "__main__":
    main()
