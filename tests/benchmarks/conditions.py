"""Whether sigmas hold on worn paint and at dusk, with both cameras and with each alone, on rendered ports.

``python -m tests.benchmarks.conditions [--ports port1] [--seeds 1 2] [--only worn dusk] [--length-m 40]``
renders a straight piece of each port in each condition, whose drive states its noise and drift as they are,
and maps it. It prints the corners' error, what of it remains after the best common motion, the sigma that is
stated of a corner, by how much diagonals of markings are too long, and the shares of corners and of sides
inside their 95 % regions; then, of each condition and set of cameras, mean squared errors in sigmas (1 if
they are as stated) of corners, of the shift that all markings share, of distances between neighbours and of
sides. Corners of one drive share its errors, so that often all of them or none lie inside: only many drives
together mean much, and a port's conditions share the errors of its seed.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from omegaconf import OmegaConf

from tests.benchmarks.sigmas import corner_pairs, left_m
from tests.benchmarks.uncertainty import CACHE, INSIDE, Errors, squared_errors
from v2hdm.detection.batch import detect_all
from v2hdm.detection.options import DetectorOptions
from v2hdm.executor import Executor, open_executor
from v2hdm.io.drive import read_drive
from v2hdm.io.drive.truth import read_truth
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.results import MethodResult
from v2hdm.records import BEST, FloatArray
from v2hdm.report.consistency import INSIDE_95
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
"""Changes of a port by each condition."""


def port_of(run: str, seed: int, condition: str, length_m: float) -> PortConfig:
    """A straight piece of a port as configured in ``conf/run``, in one of the :data:`CONDITIONS`."""
    stated = OmegaConf.load(Path(__file__).parents[2] / "conf/run" / f"{run}.yaml").simulate
    changes = {"seed": seed, "route": {"pieces": [[length_m, 0.0]]}, **CONDITIONS[condition]}
    merged = OmegaConf.merge(OmegaConf.structured(PortConfig), stated, changes)
    port = OmegaConf.to_object(merged)
    assert isinstance(port, PortConfig)
    return port


class Mapped(NamedTuple):
    """A map by some cameras, beside the truth."""

    cameras: str
    result: MethodResult
    corners: FloatArray  # (N, 2) m, of the markings that are found
    true: FloatArray  # (N, 2) m
    errors: Errors


def mapped(port: PortConfig, executor: Executor) -> Iterator[Mapped]:
    """The map of a rendered drive by all cameras, and by each alone."""
    drive = read_drive(rendered_drive(port, CACHE, executor, lambda _, __: None))
    detections = detect_all(drive, DetectorOptions.for_mapping(), executor)
    truth = read_truth(drive)
    for cameras in (list(drive.cameras), *([name] for name in drive.cameras)):
        result = run_methods(drive, detections, cameras, naive=False)[BEST]
        name = cameras[0] if len(cameras) == 1 else "all"
        yield Mapped(name, result, *corner_pairs(result, truth), squared_errors(result, truth))


def line(name: str, mapping: Mapped) -> str:
    """The figures of one map."""
    corners = inside(mapping.errors["corners"])
    sides = inside(mapping.errors["sides"])
    rmse_m = float(np.sqrt(np.mean(np.sum((mapping.corners - mapping.true) ** 2, axis=1))))
    stated_m2 = [np.trace(marking.covariance_m2) / 4 for marking in mapping.result.hd_map.markings]
    return (
        f"{name:24s} {100 * rmse_m:5.2f} cm, left {100 * left_m(mapping.corners, mapping.true):.2f}, "
        f"stated {100 * float(np.sqrt(np.median(stated_m2))):.2f}, {len(mapping.corners) // 4} markings, "
        f"diagonals {1000 * longer_m(mapping):+.1f} mm, inside: corners {corners:.2f}, sides {sides:.2f}"
    )


def longer_m(mapping: Mapped) -> float:
    """Median by which diagonals of markings are longer than the true ones, m."""
    lengths_m = [
        np.linalg.norm(corners[:, :2] - corners[:, 2:], axis=2)
        for corners in (mapping.corners.reshape(-1, 4, 2), mapping.true.reshape(-1, 4, 2))
    ]
    return float(np.median(lengths_m[0] - lengths_m[1]))


def shift_errors(mapping: Mapped) -> FloatArray:
    """The squared median shift (2,) that markings share, in sigmas of a marking's centre."""
    off_m = np.median((mapping.corners - mapping.true).reshape(-1, 4, 2).mean(axis=1), axis=0)
    of_centres_m2 = [
        np.diagonal(marking.covariance_m2.reshape(4, 2, 4, 2).mean(axis=(0, 2)))
        for marking in mapping.result.hd_map.markings
        if marking.covariance_m2 is not None
    ]
    return np.asarray(off_m**2 / np.median(of_centres_m2, axis=0))


def components(mapping: Mapped) -> dict[str, FloatArray]:
    """Squared errors in sigmas by component, with a mean of 1 where they are as stated."""
    errors = mapping.errors
    return {
        "corners": errors["corners"] * INSIDE_95 / INSIDE / 2,
        "shift": shift_errors(mapping),
        "distances": errors["distances"],
        "sides": errors["sides"],
    }


def inside(squared: FloatArray) -> float:
    """The share of squared errors (N,) that lie inside their 95 % regions."""
    return float(np.mean(squared <= INSIDE))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line a map, and the shares by condition and cameras."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--ports", nargs="+", default=["port1"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--only", nargs="+", default=list(CONDITIONS), choices=CONDITIONS)
    parser.add_argument("--length-m", type=float, default=40.0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parsed = parser.parse_args(arguments)
    of_cells: dict[tuple[str, str], list[Mapped]] = {}
    for run in parsed.ports:
        for seed in parsed.seeds:
            for condition in parsed.only:
                port = port_of(run, seed, condition, parsed.length_m)
                with open_executor(parsed.workers) as executor:
                    for mapping in mapped(port, executor):
                        of_cells.setdefault((condition, mapping.cameras), []).append(mapping)
                        print(line(f"{run} {seed} {condition}, {mapping.cameras}", mapping), flush=True)
    for (condition, cameras), mappings in of_cells.items():
        share = inside(np.concatenate([mapping.errors["corners"] for mapping in mappings]))
        by_map = [components(mapping) for mapping in mappings]
        means = ", ".join(
            f"{name} {np.mean([np.mean(part[name]) for part in by_map]):.2f}" for name in by_map[0]
        )
        print(
            f"{condition}, {cameras}: corners inside {share:.3f}, of {len(mappings)} drives; squared: {means}"
        )


if __name__ == "__main__":
    main()
