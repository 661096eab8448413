"""Surveys by detections: the statistics they are made of, and mapping in sections against all at once.

``python -m tests.benchmarks.survey --statistics DRIVE [--every 3]``: the shipped detector on a rendered port,
by distance: errors and stated sigmas of corners, the share of markings found, and of false detections; and
how far errors of one corner are alike in different images. Those of port 2 are the constants of
:mod:`v2hdm.simulate.survey.sightings`.

``python -m tests.benchmarks.survey --joint KM [--section-m M]``: a problem of a survey, adjusted at once and
in rounds over its sections: corners in mm, sigmas in per cent, seconds of CPU.

``python -m tests.benchmarks.survey --grow KM [KM ...] [--section-m M] [--workers N] [--memory-gb GB]``: a map
of each length in sections, in a process of its own: peak memory, CPU, errors and coverage against the truth;
then the exponents of growth. Each of several Dask workers is ended where it takes more memory than so much.
The CPU of all processes counts, ``survey_s`` of which made the survey, or read it where it is in the cache.

``python -m tests.benchmarks.survey --apart KM [--section-m M]``: the same survey mapped at once and in
sections, each in a process of its own: CPU, how far corners are apart, and the ratio of their sigmas.
"""

import argparse
import json
import multiprocessing
import pickle
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from omegaconf import OmegaConf
from scipy.spatial import cKDTree

from v2hdm.adjust import Problem, SolveOptions, solve
from v2hdm.adjust.sections.parts import cut
from v2hdm.adjust.sections.rounds import Shape, save_part
from v2hdm.adjust.sections.solve import finish_parts, join_parts
from v2hdm.adjust.sections.way import parts_of_way
from v2hdm.cli.compose import conf_dir
from v2hdm.detection.batch import detect_image
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.executor import HERE, open_executor
from v2hdm.geometry.lens import distort_points
from v2hdm.io.detections import detections_of, read_detections
from v2hdm.io.drive import join_drives, read_drive
from v2hdm.io.drive.truth import read_truth
from v2hdm.io.maps.reading import read_geojson
from v2hdm.mapping.inputs import Inputs
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.options import MappingOptions
from v2hdm.mapping.sections.run import map_in_sections
from v2hdm.records import BEST, Drive, FloatArray, HDMap, Image, IntArray, MarkingDetection, Truth
from v2hdm.simulate.port.config import PortConfig, SurveyConfig
from v2hdm.simulate.survey.drive import simulated_drives

_MATCH_PX = 12.0  # mean distance of known corners from a marking's, within which a detection is of it
_BORDER_PX = 4.0
_STEP_M = 2.0  # width of a class of distances
_FARTHEST_M = 26.0
_MOTION_M = 0.01  # motion on the ground by which a pixel's is told
_WORKER_END_S = 60.0  # time for a worker to end by itself, on a busy machine
_TAIL_SIGMAS = 3.0  # errors beyond are outliers to the mapping


def _projected(drive: Drive, truth: Truth, row: int) -> dict[int, FloatArray]:
    """Recorded px (4, 2) of the corners of the markings that an image shows, by marking."""
    image = drive.images[row]
    info = drive.cameras[image.camera].info
    cam_from_map = truth.cam_from_vehicle[image.camera] @ np.linalg.inv(truth.map_from_vehicle[row])
    shown = {}
    for j in np.flatnonzero(truth.visibility[row] > 0.05).tolist():
        corners = truth.map.markings[j].corners_map
        points = corners @ cam_from_map[:3, :2].T + cam_from_map[:3, 3]
        if points[:, 2].min() > 0.5:
            pinhole = points @ info.intrinsic.T
            shown[j] = distort_points(info, pinhole[:, :2] / pinhole[:, 2:])
    return shown


def _matched(
    detected: MarkingDetection, shown: dict[int, FloatArray], truth: Truth
) -> tuple[int, FloatArray, int] | None:
    """The marking that a detection is of, the errors (4, 2) of its corners, px, and which came first."""
    is_known = detected.corner_valid if detected.corner_valid.any() else np.ones(4, dtype=bool)
    candidates = [
        (j, detected.corners_px - np.roll(px, turn, axis=0), turn)
        for j, px in shown.items()
        if truth.map.markings[j].kind == detected.kind
        for turn in range(4)
    ]
    if not candidates:
        return None
    best = min(candidates, key=lambda candidate: np.linalg.norm(candidate[1][is_known], axis=1).mean())
    return best if np.linalg.norm(best[1][is_known], axis=1).mean() < _MATCH_PX else None


def statistics(folder: Path, every: int) -> None:
    """Print what the detector does on a rendered drive, by distance."""
    drive = read_drive(folder)
    truth = read_truth(drive)
    detector = Detector.load(options=DetectorOptions.for_mapping())
    corners: list[tuple[float, ...]] = []  # distance, |error|, smaller and larger sigma, squared distance
    markings: list[tuple[float, bool]] = []  # distance, whether found; of those whole in the image
    by_corner: dict[tuple[int, int, str], list[FloatArray]] = {}  # whitened errors on the ground
    detections = false = 0
    for row in range(0, len(drive.images), every):
        image = drive.images[row]
        cam_from_map = truth.cam_from_vehicle[image.camera] @ np.linalg.inv(truth.map_from_vehicle[row])
        camera_map = np.linalg.inv(cam_from_map)[:2, 3]
        shown = _projected(drive, truth, row)
        found_markings = set()
        for detected in detect_image(detector, drive, row).markings:
            if len(detected.outline_px):
                continue
            detections += 1
            match = _matched(detected, shown, truth)
            if match is None:
                false += 1
                continue
            j, off_px, first = match
            found_markings.add(j)
            away_m = float(np.linalg.norm(truth.map.markings[j].corners_map.mean(axis=0) - camera_map))
            for k in np.flatnonzero(detected.corner_valid).tolist():
                covariance = detected.covariance_px[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]
                sigma = np.sqrt(np.linalg.eigvalsh(covariance))
                squared = float(off_px[k] @ np.linalg.solve(covariance, off_px[k]))
                corners.append((away_m, *np.abs(off_px[k]), *sigma, squared))
                of_marking = (k - first) % 4
                point_map = truth.map.markings[j].corners_map[of_marking]
                root = _root_on_ground(drive, row, cam_from_map, point_map, covariance)
                key = j, of_marking, image.camera
                by_corner.setdefault(key, []).append(root @ off_px[k])
        size = np.array([drive.cameras[image.camera].info.width, drive.cameras[image.camera].info.height])
        for j, px in shown.items():
            inside = ((px > _BORDER_PX) & (px < size - 1 - _BORDER_PX)).all()
            if inside and truth.visibility[row, j] > 0.97:
                away_m = float(np.linalg.norm(truth.map.markings[j].corners_map.mean(axis=0) - camera_map))
                markings.append((away_m, j in found_markings))
    _print(np.array(corners), np.array(markings, dtype=float))
    _print_alike(by_corner)
    print(f"{detections} detections, {false} of no marking ({false / detections:.3f})")


def _root_on_ground(
    drive: Drive, row: int, cam_from_map: FloatArray, point_map: FloatArray, covariance_px: FloatArray
) -> FloatArray:
    """The matrix (2, 2) that makes of an error, px, one along map x and y of unit covariance.

    It is the symmetric root of the information on the ground, times the motion there of a pixel.
    """
    info = drive.cameras[drive.images[row].camera].info
    around = point_map + _MOTION_M * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    points = around @ cam_from_map[:3, :2].T + cam_from_map[:3, 3]
    pinhole = points @ info.intrinsic.T
    px = distort_points(info, pinhole[:, :2] / pinhole[:, 2:])
    px_by_m = np.column_stack([px[0] - px[1], px[2] - px[3]]) / (2 * _MOTION_M)
    information = px_by_m.T @ np.linalg.solve(covariance_px, px_by_m)
    share, axes = np.linalg.eigh(information)
    return np.asarray((axes * np.sqrt(share)) @ axes.T @ np.linalg.inv(px_by_m))


def _print_alike(by_corner: dict[tuple[int, int, str], list[FloatArray]]) -> None:
    """Print the correlation of the errors of one corner in images of one camera, and in those of several."""
    whitened = {key: _without_tails(np.array(errors)) for key, errors in by_corner.items()}
    inside = [errors for errors in whitened.values() if len(errors) > 1]
    square = float(np.mean(np.concatenate(inside) ** 2))
    products = sum(float((errors.sum(axis=0) ** 2 - (errors**2).sum(axis=0)).sum()) for errors in inside)
    pairs = sum(2 * len(errors) * (len(errors) - 1) for errors in inside)
    print(f"errors of a corner in images of one camera: correlation {products / pairs / square:.3f}")
    across, count = 0.0, 0
    for (j, k, camera), errors in whitened.items():
        for other in {name for *_, name in whitened if name > camera}:
            others = whitened.get((j, k, other))
            if others is not None:
                across += float(errors.sum(axis=0) @ others.sum(axis=0))
                count += 2 * len(errors) * len(others)
    if count:
        print(f"errors of a corner in images of two cameras: correlation {across / count / square:.3f}")


def _without_tails(errors: FloatArray) -> FloatArray:
    """Whitened errors (n, 2), those beyond the tail's sigmas drawn in to it."""
    return np.clip(errors, -_TAIL_SIGMAS, _TAIL_SIGMAS)


def _print(corners: FloatArray, markings: FloatArray) -> None:
    print("distance  corners  |u| |v| px  stated px   spread  chi2: median/1.39  p95   p99   found")
    for low in np.arange(2.0, _FARTHEST_M, _STEP_M):
        rows = corners[(corners[:, 0] >= low) & (corners[:, 0] < low + _STEP_M)]
        shown = markings[(markings[:, 0] >= low) & (markings[:, 0] < low + _STEP_M)]
        if len(rows) < 20 or not len(shown):
            continue
        u, v, fine, coarse = np.median(rows[:, 1:5], axis=0)
        tail = np.percentile(rows[:, 5], [50, 95, 99])
        print(
            f"{low + 1:5.0f} m {len(rows):8d}   {1.48 * u:.2f} {1.48 * v:.2f}   {coarse:.3f} {fine:.3f}"
            f"  {np.log(rows[:, 4]).std():6.2f} {tail[0] / 1.386:12.2f} {tail[1]:10.1f} {tail[2]:5.1f}"
            f"   {shown[:, 1].mean():.3f}"
        )


def survey_of(length_km: float, cache: Path) -> tuple[Drive, HDMap]:
    """The drives of a survey as one, and its true map."""
    port = OmegaConf.merge(
        OmegaConf.structured(PortConfig), OmegaConf.load(conf_dir() / "run" / "port2.yaml").simulate
    )
    config = replace(OmegaConf.to_object(port), survey=SurveyConfig(length_km=length_km))
    folders = simulated_drives(config, cache, HERE, lambda finished, total: None)
    drive = join_drives([read_drive(folder) for folder in folders])
    return drive, read_geojson(folders[0] / "truth" / "map.geojson")


def joint(length_km: float, section_m: float, cache: Path) -> None:
    """Print how far the joint solve of a survey's problem is from that in sections."""
    drive, _ = survey_of(length_km, cache)
    inputs = Inputs(drive, detections_of(drive), list(drive.cameras), MappingOptions())
    bundle = inputs.optimiser.settle(inputs.tracks)
    problem = replace(bundle.problem, cam_from_vehicle=bundle.solution.cam_from_vehicle)
    options = bundle.model.solver
    print(f"{len(problem.map_from_vehicle)} frames, {problem.corner_count} corners, ", end="")
    print(f"{len(problem.observations.corner)} observations")
    begin_s = time.process_time()
    whole = solve(problem, options)
    groups = np.arange(problem.corner_count)[:, None]
    of_whole = np.sqrt(np.diagonal(whole.covariance.corners(groups), axis1=1, axis2=2))
    print(f"at once: {time.process_time() - begin_s:.1f} s")
    begin_s = time.process_time()
    off_mm, off_share = _in_sections(problem, options, section_m, whole.corners_map, of_whole)
    print(f"in sections: {time.process_time() - begin_s:.1f} s")
    print(f"corners {off_mm:.5f} mm, sigmas {100 * off_share:.5f} % at most")


def _in_sections(
    problem: Problem, options: SolveOptions, section_m: float, corners_map: FloatArray, sigma_m: FloatArray
) -> tuple[float, float]:
    """Largest differences of corners, mm, and of the shares of their sigmas."""
    position = problem.map_from_vehicle[:, :2, 3]
    part_of_frame = parts_of_way(position, problem.session_of_frame, section_m)
    parts, links = cut(problem, part_of_frame, tuple(options.pose_states))
    shared = np.mean([len(part.border_corners) for part in parts])
    print(f"{len(parts)} sections, {shared:.0f} corners on the border of each, {len(links)} links")
    off_mm = off_share = 0.0
    with tempfile.TemporaryDirectory() as folder:
        for number, part in enumerate(parts):
            save_part(Path(folder), number, part)
        shape = Shape.of(problem, options)
        joined = join_parts(
            Path(folder), len(parts), links, shape, lambda number, part, solution: None, at_once=0
        )
        results = finish_parts(
            Path(folder), joined, shape,
            lambda number, part, solution: (
                part.corners,
                solution.corners_map,
                solution.covariance.corners(np.arange(part.problem.corner_count)[:, None]),
            ),
        )  # fmt: skip
    for corners, found_map, covariance in results:
        off_mm = max(off_mm, 1e3 * float(np.abs(found_map - corners_map[corners]).max()))
        sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        off_share = max(off_share, float(np.abs(sigma / sigma_m[corners] - 1).max()))
    return off_mm, off_share


class FromFiles:
    """Detections from a drive's files, read where they are needed."""

    def __call__(self, images: list[Image], numbers: IntArray) -> list:
        return [read_detections(image.path, at) for at, image in enumerate(images)]


def _show_step(step: str, done: int, total: int) -> None:
    """Print a step of the mapping and how far it is, for whoever waits."""
    print(f"{time.strftime('%H:%M:%S')} {step}: {done} of {total}", file=sys.stderr, flush=True)


def one_length(
    length_km: float, section_m: float, workers: int, memory_gb: float, cache: Path, keep: Path | None
) -> None:
    """Map one survey, in no sections if these are of 0 m, and print its figures as JSON."""
    begin_s = time.process_time()
    drive, true_map = survey_of(length_km, cache)
    survey_s = time.process_time() - begin_s
    cameras = list(drive.cameras)
    begin_s = time.perf_counter()
    if section_m == 0:
        result = run_methods(drive, detections_of(drive), cameras, MappingOptions(), naive=False)[BEST]
    else:
        with (
            open_executor(workers, memory_gb=memory_gb) as executor,
            tempfile.TemporaryDirectory(dir=cache) as folder,
        ):
            result = map_in_sections(
                drive, FromFiles(), cameras, MappingOptions(), section_m, executor, Path(folder), _show_step
            )
    if keep is not None:
        keep.write_bytes(pickle.dumps(result.hd_map))
    _wait_for_workers()
    usage = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    figures = {
        "km": length_km,
        "images": len(drive.images),
        "observations": result.diagnostics["observations"],
        "markings": len(result.hd_map.markings),
        "true": len(true_map.markings),
        "wall_s": time.perf_counter() - begin_s,
        "cpu_s": sum(part.ru_utime + part.ru_stime for part in usage),
        "survey_s": survey_s,
        "peak_mb": usage[0].ru_maxrss / 1e3,
        "worker_peak_mb": usage[1].ru_maxrss / 1e3,
        **_against(result.hd_map, true_map),
    }
    print(json.dumps(figures))


def _wait_for_workers() -> None:
    """Wait for processes that are left: the CPU of one counts once it was waited for."""
    for worker in multiprocessing.active_children():
        worker.join(_WORKER_END_S)
        if worker.is_alive():
            worker.terminate()
            worker.join()


def _against(hd_map: HDMap, true_map: HDMap) -> dict[str, float]:
    """RMSE of corners, cm, the share of coordinates within 1.96 sigmas, and the false markings.

    Sigmas are those of corners and of markings' centres.
    """
    true = np.array([marking.corners_map for marking in true_map.markings])
    tree = cKDTree(true.mean(axis=1))
    off, inside, centre_inside, false = [], [], [], 0
    for marking in hd_map.markings:
        away_m, j = tree.query(marking.corners_map.mean(axis=0))
        if away_m > 0.5 or true_map.markings[int(j)].kind != marking.kind:
            false += 1
            continue
        turned = [np.roll(true[j], turn, axis=0) for turn in range(4)]
        error = marking.corners_map - min(
            turned, key=lambda corners: np.abs(marking.corners_map - corners).max()
        )
        off.append(error)
        covariance_m2 = marking.covariance_m2
        inside.append(np.abs(error.ravel()) < 1.96 * np.sqrt(np.diag(covariance_m2)))
        centre_inside.append(np.abs(error.mean(axis=0)) < 1.96 * np.sqrt(_of_centre(covariance_m2)))
    return {
        "rmse_cm": 100 * float(np.sqrt(2 * np.mean(np.square(off)))),
        "inside_95": float(np.mean(inside)),
        "centres_inside_95": float(np.mean(centre_inside)),
        "false": false,
    }


def _of_centre(covariance_m2: FloatArray) -> FloatArray:
    """The variances (2,) of a marking's centre, m^2."""
    return np.asarray(covariance_m2.reshape(4, 2, 4, 2).mean(axis=(0, 2)).diagonal())


def apart(length_km: float, section_m: float, cache: Path) -> None:
    """Print how far a map in sections is from that of one solve, and the CPU of both."""
    maps: list[HDMap] = []
    spent_s = []
    with tempfile.TemporaryDirectory() as folder:
        for most_m in (0.0, section_m):
            keep = Path(folder, "map")
            words = ["--one", str(length_km), "--section-m", str(most_m), "--keep", str(keep)]
            figures = _in_a_process(words, cache)
            maps.append(pickle.loads(keep.read_bytes()))
            spent_s.append(figures["cpu_s"])
            print(" ".join(f"{key} {value:g}" for key, value in figures.items()), flush=True)
    print(f"CPU in sections over that at once: {spent_s[1] / spent_s[0]:.2f}")
    _print_apart(*maps)


def _print_apart(whole: HDMap, parted: HDMap) -> None:
    """Print distances of the corners of two maps, and ratios of their sigmas."""
    corners = np.array([marking.corners_map for marking in whole.markings])
    away_m, nearest = cKDTree(corners.mean(axis=1)).query(
        [marking.corners_map.mean(axis=0) for marking in parted.markings]
    )
    are_same = away_m < 0.3
    off_mm, ratio = [], []
    for number in np.flatnonzero(are_same).tolist():
        marking, other = parted.markings[number], whole.markings[int(nearest[number])]
        turn = min(
            range(4),
            key=lambda turn: np.abs(np.roll(marking.corners_map, turn, axis=0) - other.corners_map).max(),
        )
        moved = np.roll(marking.corners_map, turn, axis=0) - other.corners_map
        off_mm.append(1e3 * np.linalg.norm(moved, axis=1))
        variance_m2 = np.diag(marking.covariance_m2).reshape(4, 2).sum(axis=1)
        ratio.append(
            np.sqrt(np.roll(variance_m2, turn) / np.diag(other.covariance_m2).reshape(4, 2).sum(axis=1))
        )
    print(f"{len(whole.markings)} and {len(parted.markings)} markings, {are_same.sum()} of them the same")
    median, most_of_all, most = np.percentile(off_mm, [50, 95, 100])
    print(f"corners apart: median {median:.4f}, 95 % within {most_of_all:.4f}, most {most:.4f} mm")
    share = np.percentile(ratio, [0, 5, 50, 95, 100])
    print("sigmas, least, 5 %, median, 95 %, most:", " ".join(f"{value:.4f}" for value in share))


def grow(lengths_km: list[float], section_m: float, workers: int, memory_gb: float, cache: Path) -> None:
    """Print the figures of each length, and the exponents of growth from the first to the last."""
    rows = []
    for length_km in lengths_km:
        words = ["--one", str(length_km), "--section-m", str(section_m), "--workers", str(workers)]
        words += ["--memory-gb", str(memory_gb)]
        rows.append(_in_a_process(words, cache))
        shown = {key: round(value, 3) for key, value in rows[-1].items()}
        print(" ".join(f"{key} {value:g}" for key, value in shown.items()), flush=True)
    if len(rows) > 1:
        # Short networks have more streets than yards: cost follows the observations as well as the way.
        for size in ("images", "observations"):
            ratio = np.log(rows[-1][size] / rows[0][size])
            for key in ("cpu_s", "peak_mb"):
                exponent = np.log(rows[-1][key] / rows[0][key]) / ratio
                print(f"exponent of {key} by {size}: {exponent:.2f}")


def _in_a_process(words: list[str], cache: Path) -> dict[str, float]:
    """The figures that this module prints with some words of its command; its progress is shown."""
    command = [sys.executable, "-m", "tests.benchmarks.survey", *words, "--cache", str(cache)]
    process = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    figures: dict[str, float] = json.loads(process.stdout.splitlines()[-1])
    return figures


def main() -> None:
    """Print what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    choice = parser.add_mutually_exclusive_group(required=True)
    choice.add_argument("--statistics", type=Path, metavar="DRIVE")
    choice.add_argument("--joint", type=float, metavar="KM")
    choice.add_argument("--grow", type=float, nargs="+", metavar="KM")
    choice.add_argument("--apart", type=float, metavar="KM")
    choice.add_argument("--one", type=float, metavar="KM", help=argparse.SUPPRESS)
    parser.add_argument("--every", type=int, default=3, metavar="N", help="look at every N-th image")
    parser.add_argument("--section-m", type=float, default=1000.0, metavar="M")
    parser.add_argument("--keep", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--workers", type=int, default=1, metavar="N")
    parser.add_argument("--memory-gb", type=float, default=2.0, metavar="GB", help="most for each of several")
    parser.add_argument("--cache", type=Path, default=Path("cache"), metavar="DIR", help="keeps the surveys")
    parsed = parser.parse_args()
    if parsed.statistics is not None:
        statistics(parsed.statistics, parsed.every)
    elif parsed.joint is not None:
        joint(parsed.joint, parsed.section_m, parsed.cache)
    elif parsed.grow is not None:
        grow(parsed.grow, parsed.section_m, parsed.workers, parsed.memory_gb, parsed.cache)
    elif parsed.apart is not None:
        apart(parsed.apart, parsed.section_m, parsed.cache)
    else:
        one_length(parsed.one, parsed.section_m, parsed.workers, parsed.memory_gb, parsed.cache, parsed.keep)


if __name__ == "__main__":
    main()
