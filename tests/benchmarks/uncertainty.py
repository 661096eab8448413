"""Whether the stated uncertainty holds: the share of errors inside their 95 % regions, over many drives.

``python -m tests.benchmarks.uncertainty [--ports port1 port2] [--seeds 1 2 3 4] [--drives FOLDER ...] [--mode
incremental] [--no-noise]`` renders both ports with these seeds (or reads drives with truth), detects, maps
with both cameras, and prints a line a drive and one for all: of corners, side lengths, distances between
markings about 10 m apart, camera heights, roll, pitch and yaw. ``--no-noise`` maps as if ``drive.yaml``
stated no pose noise. All shares should lie between .93 and .97.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from omegaconf import OmegaConf
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from v2hdm.detection.batch import detect_all
from v2hdm.detection.options import DetectorOptions
from v2hdm.executor import open_executor
from v2hdm.io.drive import read_drive
from v2hdm.io.drive.truth import read_truth
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.options import MappingOptions
from v2hdm.mapping.results import MethodResult
from v2hdm.records import Calibration, Drive, FloatArray, Marking, PoseNoise, Truth
from v2hdm.report.consistency import INSIDE_95, squared_in_sigmas
from v2hdm.report.metrics import match_markings
from v2hdm.simulate.port.config import PortConfig
from v2hdm.simulate.port.drive import rendered_drive
from v2hdm.site.relative import neighbours

QUANTITIES = ("corners", "sides", "distances", "height", "roll", "pitch", "yaw")
CACHE = Path("~/.cache/v2hdm/uncertainty").expanduser()

Errors = Mapping[str, FloatArray]
"""By quantity, squared errors in sigmas, as if of one degree of freedom: inside 95 % below 3.84."""

INSIDE = float(chi2.ppf(0.95, 1))
"""Squared error, in sigmas, below which a quantity lies inside its 95 % region."""


def squared_errors(result: MethodResult, truth: Truth) -> Errors:
    """How far a result is from the truth, in the uncertainties that it states."""
    rows, columns = match_markings(result.hd_map.markings, truth.map.markings)
    mapped = [result.hd_map.markings[row] for row in rows]
    true = np.stack(
        [
            in_order_of(mapped[k].corners_map, truth.map.markings[column].corners_map)
            for k, column in enumerate(columns)
        ]
    )
    cameras = np.array(
        [
            camera_errors(calibration, truth.cam_from_vehicle[name])
            for name, calibration in result.calibrations.items()
        ]
    )
    return {
        "corners": corner_errors(mapped, true) * INSIDE / INSIDE_95,
        "sides": side_errors(mapped, true),
        "distances": distance_errors(mapped, true),
        **{name: cameras[:, axis] for axis, name in enumerate(("height", "roll", "pitch", "yaw"))},
    }


def in_order_of(corners: FloatArray, other: FloatArray) -> FloatArray:
    """``other`` (4, 2), beginning with the corner that comes nearest to ``corners``."""
    turned = [np.roll(other, shift, axis=0) for shift in range(4)]
    return min(turned, key=lambda corners_turned: float(((corners_turned - corners) ** 2).sum()))


def corner_errors(mapped: Sequence[Marking], true: FloatArray) -> FloatArray:
    """Squared errors of markings' (M,) corners, in sigmas; chi-square of two degrees of freedom."""
    assert all(marking.covariance_m2 is not None for marking in mapped)
    pairs = zip(mapped, true, strict=True)
    return squared_in_sigmas(mapped, [replace(marking, corners_map=corners) for marking, corners in pairs])


def side_errors(mapped: Sequence[Marking], true: FloatArray) -> FloatArray:
    """Squared errors of every side's length, in sigmas."""
    out = []
    for marking, corners in zip(mapped, true, strict=True):
        assert marking.covariance_m2 is not None
        for k in range(4):
            after = (k + 1) % 4
            side = marking.corners_map[after] - marking.corners_map[k]
            length = np.linalg.norm(side)
            slope = np.zeros(8)
            slope[2 * k : 2 * k + 2], slope[2 * after : 2 * after + 2] = -side / length, side / length
            error = length - np.linalg.norm(corners[after] - corners[k])
            out.append(error**2 / (slope @ marking.covariance_m2 @ slope))
    return np.array(out)


def distance_errors(mapped: Sequence[Marking], true: FloatArray) -> FloatArray:
    """Squared errors of distances between centres of markings about 10 m apart, in their relative sigmas."""
    centres = np.array([marking.corners_map.mean(axis=0) for marking in mapped])
    true_centres = true.mean(axis=1)
    sigma = np.array([marking.relative_sigma_m or np.nan for marking in mapped])
    neighbours_of = neighbours(centres)
    first = np.array([k for k, others in enumerate(neighbours_of) if len(others)], dtype=np.int64)
    second = np.array([neighbours_of[k][0] for k in first], dtype=np.int64)
    off = np.linalg.norm(centres[first] - centres[second], axis=1)
    off -= np.linalg.norm(true_centres[first] - true_centres[second], axis=1)
    squared = off**2 / (sigma[first] ** 2 + sigma[second] ** 2)
    return np.asarray(squared[np.isfinite(squared)])


def camera_errors(calibration: Calibration, true: FloatArray) -> FloatArray:
    """Squared errors of a camera's height, roll, pitch and yaw (4,), in sigmas."""
    assert calibration.covariance is not None
    off = calibration.cam_from_vehicle @ np.linalg.inv(true)
    turn = Rotation.from_matrix(off[:3, :3]).as_rotvec()
    to_vehicle = np.kron(np.eye(2), calibration.cam_from_vehicle[:3, :3].T)
    error = to_vehicle @ np.concatenate([off[:3, 3], turn])
    variance = np.diag(to_vehicle @ calibration.covariance @ to_vehicle.T)
    return np.asarray((error**2 / variance)[2:])


def shares(errors: Errors) -> dict[str, float]:
    """By quantity, the share inside the 95 % region."""
    return {name: float(np.mean(errors[name] <= INSIDE)) for name in QUANTITIES}


def print_shares(name: str, errors: Errors) -> None:
    """One line of the table."""
    print(f"{name:24s} " + " ".join(f"{share:9.3f}" for share in shares(errors).values()), flush=True)


def drives(arguments: argparse.Namespace) -> Iterator[tuple[str, Drive]]:
    """The drives that were asked for, by name."""
    if arguments.drives:
        yield from ((folder.name, read_drive(folder)) for folder in arguments.drives)
        return
    for port in arguments.ports:
        for seed in arguments.seeds:
            run = OmegaConf.load(Path(__file__).parents[2] / "conf/run" / f"{port}.yaml").simulate
            config = OmegaConf.merge(OmegaConf.structured(PortConfig), run, {"seed": seed})
            with open_executor(arguments.workers) as executor:
                folder = rendered_drive(OmegaConf.to_object(config), CACHE, executor, lambda _, __: None)
            yield f"{port}, seed {seed}", read_drive(folder)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--ports", nargs="+", default=["port1", "port2"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3, 4])
    parser.add_argument("--drives", nargs="+", type=Path, default=[])
    parser.add_argument("--mode", default="batch", choices=("batch", "incremental"))
    parser.add_argument("--no-noise", action="store_true")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    arguments = parser.parse_args()
    print(" " * 25 + " ".join(f"{name:>9s}" for name in QUANTITIES))
    errors_of_drives: list[Errors] = []
    for name, recorded in drives(arguments):
        drive = replace(recorded, pose_noise=PoseNoise.from_stated()) if arguments.no_noise else recorded
        with open_executor(arguments.workers) as executor:
            detections = detect_all(drive, DetectorOptions.for_mapping(), executor)
        result = run_methods(drive, detections, list(drive.cameras), MappingOptions(mode=arguments.mode))[
            "Opt"
        ]
        errors_of_drives.append(squared_errors(result, read_truth(drive)))
        print_shares(name, errors_of_drives[-1])
    print_shares(
        "all", {name: np.concatenate([errors[name] for errors in errors_of_drives]) for name in QUANTITIES}
    )


if __name__ == "__main__":
    main()
