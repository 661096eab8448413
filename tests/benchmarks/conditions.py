"""Whether sigmas hold on worn paint and at dusk, with both cameras and with each alone, on rendered ports.

``python -m tests.benchmarks.conditions [--ports port1] [--seeds 1 2] [--only worn dusk] [--length-m 40]``
renders a straight piece of each port in each condition, whose drive states its noise and drift as they are,
and maps it. It prints the corners' error, what of it remains after the best common motion, the sigma that is
stated of a corner, and the share of corners inside their 95 % regions. Corners of one drive share its errors,
so that often all of them or none lie inside: only many drives together mean much.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from tests.benchmarks.sigmas import corner_pairs, left_m
from tests.benchmarks.uncertainty import CACHE, INSIDE, squared_errors
from v2hdm.detection.batch import detect_all
from v2hdm.detection.options import DetectorOptions
from v2hdm.executor import Executor, open_executor
from v2hdm.io.drive import read_drive
from v2hdm.io.drive.truth import read_truth
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.results import MethodResult
from v2hdm.records import BEST, FloatArray
from v2hdm.simulate.port.config import PortConfig
from v2hdm.simulate.port.drive import rendered_drive

CONDITIONS: dict[str, dict[str, Any]] = {
    "as it is": {},
    # The wear of a marking is the share of its paint that is gone.
    "worn": {"paint": {"wear": 0.4}},
    # A low sun behind haze, a long exposure at a high gain.
    "dusk": {
        "yard": {"sun_elevation_deg": 3.0, "sun_strength": 0.15, "haze_m": 120.0},
        "exposure": {"exposure_s": 0.006, "level": 0.07, "full_well_electrons": 1500.0, "read_noise": 0.006},
    },
}
"""What each condition changes of a port."""


def port_of(run: str, seed: int, condition: str, length_m: float) -> PortConfig:
    """A straight piece of a port as configured in ``conf/run``, in one of the :data:`CONDITIONS`."""
    stated = OmegaConf.load(Path(__file__).parents[2] / "conf/run" / f"{run}.yaml").simulate
    changes = {"seed": seed, "route": {"pieces": [[length_m, 0.0]]}, **CONDITIONS[condition]}
    merged = OmegaConf.merge(OmegaConf.structured(PortConfig), stated, changes)
    port = OmegaConf.to_object(merged)
    assert isinstance(port, PortConfig)
    return port


def mapped(
    port: PortConfig, executor: Executor
) -> Iterator[tuple[str, MethodResult, FloatArray, FloatArray, FloatArray]]:
    """By set of cameras: the map, mapped and true corners (N, 2), and squared errors (N,) of corners."""
    drive = read_drive(rendered_drive(port, CACHE, executor, lambda _, __: None))
    detections = detect_all(drive, DetectorOptions.for_mapping(), executor)
    truth = read_truth(drive)
    for cameras in (list(drive.cameras), *([name] for name in drive.cameras)):
        result = run_methods(drive, detections, cameras, naive=False)[BEST]
        corners, true = corner_pairs(result, truth)
        name = cameras[0] if len(cameras) == 1 else "all"
        yield name, result, corners, true, squared_errors(result, truth)["corners"]


def line(name: str, result: MethodResult, corners: FloatArray, true: FloatArray, squared: FloatArray) -> str:
    """The figures of one map."""
    rmse_m = float(np.sqrt(np.mean(np.sum((corners - true) ** 2, axis=1))))
    stated = [np.trace(marking.covariance_m2) / 4 for marking in result.hd_map.markings]
    return (
        f"{name:32s} {100 * rmse_m:5.2f} cm, left {100 * left_m(corners, true):.2f}, "
        f"stated {100 * float(np.sqrt(np.median(stated))):.2f}, {len(corners) // 4} markings, "
        f"inside {np.mean(squared <= INSIDE):.2f}"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line a map, and the shares by condition and cameras."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--ports", nargs="+", default=["port1"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--only", nargs="+", default=list(CONDITIONS), choices=CONDITIONS)
    parser.add_argument("--length-m", type=float, default=40.0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    asked = parser.parse_args(arguments)
    squared: dict[tuple[str, str], list[FloatArray]] = {}
    for run in asked.ports:
        for seed in asked.seeds:
            for condition in asked.only:
                port = port_of(run, seed, condition, asked.length_m)
                with open_executor(asked.workers) as executor:
                    for cameras, result, corners, true, errors in mapped(port, executor):
                        squared.setdefault((condition, cameras), []).append(errors)
                        name = f"{run} {seed} {condition}, {cameras}"
                        print(line(name, result, corners, true, errors), flush=True)
    for (condition, cameras), errors in squared.items():
        share = np.mean(np.concatenate(errors) <= INSIDE)
        print(f"{condition}, {cameras}: inside {share:.3f} of {len(errors)} drives")


if __name__ == "__main__":
    main()
