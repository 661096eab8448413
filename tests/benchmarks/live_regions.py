"""The time that looks at parts of an image save on the vehicle, and the accuracy that they cost.

    python -m tests.benchmarks.live_regions DRIVE --images 160 --every-full 1 5 [--seconds 60]

DRIVE is a rendered drive of ``v2hdm map +run=port2`` (its ``cache``), which has the truth. Its images are
given to the detector and the localiser, with the map of the truth, an odometry that is off by half a percent
and .006 deg/s, and calibrations stated to 5 mm and .03 deg. For each ``--every-full``: errors of the tracked
poses, what was found, CPU time of an image in the detector, of looks at parts alone, and in the localiser.

With ``--seconds`` the command ``v2hdm localize --live`` itself then runs for so long on images that are
written at 10 Hz, the drive to and fro, and an odometry of 50 Hz. Printed is the age of each image when the
first pose that has it was written, from when it was due, and the CPU that each process used: the writer's is
this benchmark's own, on the same cores. On a machine that others use the ages say little.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from scipy.interpolate import CubicSpline

from v2hdm.detection.camera import camera_from_calibration
from v2hdm.detection.detector import Detector
from v2hdm.detection.road import RoadDetector
from v2hdm.geometry.planar import wrapped
from v2hdm.geometry.rigid import heading_rad
from v2hdm.io.calibration.writing import write_calibration
from v2hdm.io.drive import read_drive
from v2hdm.io.drive.truth import read_truth
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.localization.localizer import Localizer
from v2hdm.localization.motion import Motion
from v2hdm.localization.places import rough_position
from v2hdm.localization.pose import Status
from v2hdm.localization.seeing import Look
from v2hdm.records import Calibration, Drive, FloatArray, Truth

_SCALE, _BIAS_RAD_S = 1.005, 1e-4  # stated over true speed, and the bias of the yaw rate
_MOUNT = np.diag(np.square([*(3 * [0.005]), *(3 * [np.deg2rad(0.03)])]))  # stated covariance of a calibration
_SAMPLES = 5  # of the odometry between two images
_RATE_HZ = 10.0
_LATE_S = 0.15  # age, s, that no image may have
_STARTING_S = 3.0  # time, s, that the processes take to start
_SAME_S = 0.01  # difference, s, of two times of one image: poses round theirs
_LATER = 2  # moments after which a whole search that follows a look at parts is done
_KEPT = 50  # images of a camera that stay in its folder
_ANSWER_S = 1.0  # time, s, in which the last images are answered


@dataclass(frozen=True)
class Ride:
    """A rendered drive as a vehicle has it: images in the order of their times, and its odometry."""

    drive: Drive
    truth: Truth
    moments: list[list[int]]  # (M) the images of each
    stamp_s: FloatArray  # (M,)
    map_from_vehicle: FloatArray  # (M, 4, 4)
    calibrations: dict[str, Calibration]

    def motion(self, moment: int) -> list[Motion]:
        """The odometry's samples since the last moment."""
        if moment == 0:
            return []
        times_s = np.linspace(self.stamp_s[moment - 1], self.stamp_s[moment], _SAMPLES + 1)[1:]
        speed_m_s, rate_rad_s = self._course(times_s - self.stamp_s[0], 1).T
        speeds = (_SCALE * speed_m_s).tolist()
        rates = (rate_rad_s + _BIAS_RAD_S).tolist()
        return [Motion(*sample) for sample in zip(times_s.tolist(), speeds, rates, strict=True)]

    @cached_property
    def _course(self) -> CubicSpline:
        """Its way and heading, so that what the odometry says adds up also where the vehicle turns back."""
        heading = np.unwrap(np.asarray(heading_rad(self.map_from_vehicle)))
        middle = (heading[1:] + heading[:-1]) / 2
        ahead = np.column_stack([np.cos(middle), np.sin(middle)])
        steps_m = (np.diff(self.map_from_vehicle[:, :2, 3], axis=0) * ahead).sum(axis=1)
        way_m = np.concatenate([[0.0], np.cumsum(steps_m)])
        return CubicSpline(self.stamp_s - self.stamp_s[0], np.column_stack([way_m, heading]))

    def to_and_fro(self, stamp_s: FloatArray) -> Ride:
        """The drive on to its end, back to its begin and so on, with moments at some times (N,)."""
        count = len(self.moments)
        turns = [*range(count), *range(count - 2, 0, -1)]
        order = [turns[number % len(turns)] for number in range(len(stamp_s))]
        moments = [self.moments[moment] for moment in order]
        return replace(self, moments=moments, stamp_s=stamp_s, map_from_vehicle=self.map_from_vehicle[order])


def ride_of(folder: Path, images: int) -> Ride:
    """The first images of a rendered drive."""
    drive = read_drive(folder)
    truth = read_truth(drive)
    order = sorted(range(len(drive.images)), key=lambda i: drive.images[i].stamp_s)[:images]
    by_stamp = {
        stamp_s: list(of_moment)
        for stamp_s, of_moment in groupby(order, key=lambda i: drive.images[i].stamp_s)
    }
    calibrations = {
        name: Calibration(camera.info, truth.cam_from_vehicle[name], _MOUNT)
        for name, camera in drive.cameras.items()
    }
    moments = list(by_stamp.values())
    poses = truth.map_from_vehicle[[of_moment[0] for of_moment in moments]]
    return Ride(drive, truth, moments, np.array(list(by_stamp)), poses, calibrations)


def followed(ride: Ride, every_full: int, roads: dict[str, RoadDetector]) -> str:
    """Localise through a ride; the figures as one line."""
    begin = ride.map_from_vehicle[0]
    start = rough_position(*begin[:2, 3].tolist(), float(np.degrees(heading_rad(begin))))
    localizer = Localizer(ride.truth.map, ride.calibrations, start, every_full=every_full)
    errors, counts, detected_s, parts_s, localised_s = [], [], [], [], []
    later: list[tuple[int, Look]] = []
    for moment, images in enumerate(ride.moments):
        localizer.update([look for due, look in later if due == moment], ride.motion(moment))
        for i in images:
            image = ride.drive.images[i]
            pixels = np.asarray(cv2.imread(str(image.path)))
            times = [time.process_time()]
            _, regions_px, is_all_later = localizer.glance(image.camera, image.stamp_s)
            times.append(time.process_time())
            road = roads[image.camera].detect(pixels, regions_px=regions_px)
            times.append(time.process_time())
            pose = localizer.update([Look.of(image.camera, image.stamp_s, road)])
            times.append(time.process_time())
            second_s = 0.0
            if is_all_later:
                whole = Look.of(image.camera, image.stamp_s, roads[image.camera].detect(pixels))
                second_s = time.process_time() - times[-1]
                later.append((moment + _LATER, replace(whole, is_second=True)))
            asked_s, look_s, update_s = np.diff(times).tolist()
            detected_s.append(look_s + second_s)
            localised_s.append(asked_s + update_s)
            if regions_px is not None:
                parts_s.append(look_s)
            counts.append(len(road.markings))
            if pose.status == Status.TRACKING and pose.map_from_vehicle is not None:
                true = ride.truth.map_from_vehicle[i]
                off = true[:2, :2].T @ (pose.map_from_vehicle[:2, 3] - true[:2, 3])
                turn_rad = float(wrapped(heading_rad(pose.map_from_vehicle) - heading_rad(true)))
                errors.append([*off, turn_rad])
    rmse = np.sqrt((np.array(errors) ** 2).mean(axis=0)) * [100, 100, np.degrees(1)]
    parts = f", {1e3 * np.median(parts_s):.0f} (median) of {len(parts_s)} in parts" if parts_s else ""
    count = sum(map(len, ride.moments))
    return (
        f"every {every_full}: tracked {len(errors)} of {count}, along {rmse[0]:.2f} cm, lateral "
        f"{rmse[1]:.2f} cm, heading {rmse[2]:.3f} deg, {np.mean(counts):.1f} markings an image; CPU, ms: "
        f"detector {1e3 * np.mean(detected_s):.0f} (mean){parts}, localiser {1e3 * np.mean(localised_s):.0f}"
    )


def paced(ride: Ride, every_full: int, seconds: float) -> str:
    """Run the command on images that come at 10 Hz; the ages of poses as one line."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "result").mkdir()
        write_geojson(ride.truth.map, folder / "result" / "map.geojson")
        for camera, calibration in ride.calibrations.items():
            write_calibration(calibration, folder / "result" / f"calibration_{camera}.yaml")
            (folder / camera).mkdir()
        begin = ride.map_from_vehicle[0]
        start = [*begin[:2, 3].tolist(), float(np.degrees(heading_rad(begin)))]
        command = [sys.executable, "-m", "v2hdm", "localize", str(folder / "result"), "--live"]
        command += [
            part for camera in ride.calibrations for part in ("--images", f"{camera}={folder / camera}")
        ]
        command += [
            "--motion",
            "-",
            "--every-full",
            str(every_full),
            "--start",
            *(f"{value:.4f}" for value in start),
        ]
        pipe = subprocess.PIPE
        poses = Poses()
        writer_s = time.process_time()
        with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as process:
            threading.Thread(target=poses.follow, args=(process,), daemon=True).start()
            stamps_s = _write(ride, folder, process, seconds)
            cpu_s = _spent_s(process.pid)
            time.sleep(_ANSWER_S)
            process.terminate()
        writer_s = time.process_time() - writer_s
    ages_s = np.array([age_s for ages in poses.ages_s.values() for age_s in ages.values()])
    if not len(ages_s):
        return f"every {every_full}, at 10 Hz: no pose was tracked ({poses.lines} lines)"
    p50, p99, most = np.percentile(ages_s, [50, 99, 100]) * 1e3
    late = (ages_s > _LATE_S).sum()
    first_s = min(min(ages) for ages in poses.ages_s.values())
    before = sum(stamp_s < first_s - _SAME_S for stamp_s in stamps_s)
    cores = ", ".join(f"{used_s / seconds:.2f}" for used_s in cpu_s)
    load = f"load {os.getloadavg()[0]:.1f} of {os.cpu_count()} cores"
    return (
        f"every {every_full}, at 10 Hz for {seconds:.0f} s, {load}: "
        f"{len(ages_s)} of {len(stamps_s)} images in tracked poses, {before} of the others before the first; "
        f"age, ms: "
        f"{p50:.0f} (median), {p99:.0f} (99 %), {most:.0f} (most), {late} over {1e3 * _LATE_S:.0f}; "
        f"order of stamps kept: {poses.is_in_order}; CPU seconds a second: {cores} (localiser, cameras), "
        f"{writer_s / seconds:.2f} (writer)"
    )


@dataclass
class Poses:
    """The command's lines as they come."""

    lines: int = 0
    is_in_order: bool = True
    ages_s: dict[str, dict[float, float]] = field(default_factory=dict)  # by camera and time of the image
    stamp_s: float = -np.inf

    def follow(self, process: subprocess.Popen[str]) -> None:
        """Take lines until there are no more."""
        assert process.stdout is not None
        for line in process.stdout:
            now_s = time.time()
            record = json.loads(line)
            self.lines += 1
            self.is_in_order &= record["stamp_s"] >= self.stamp_s
            self.stamp_s = record["stamp_s"]
            if record["status"] == "tracking":
                for camera, image_s in record["images_s"].items():
                    self.ages_s.setdefault(camera, {}).setdefault(image_s, now_s - image_s)


def _spent_s(pid: int) -> list[float]:
    """CPU seconds of a process and of those that it has started; for Linux."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    schedules = [Path(f"/proc/{number}/schedstat").read_text().split() for number in (str(pid), *children)]
    return [int(schedule[0]) / 1e9 for schedule in schedules]


def _write(ride: Ride, folder: Path, process: subprocess.Popen[str], seconds: float) -> list[float]:
    """Write images and odometry as they come; when each image was due.

    The ride begins when the processes have had time to start.
    """
    assert process.stdin is not None
    time.sleep(_STARTING_S)
    stamp_s = time.time() + np.arange(int(seconds * _RATE_HZ)) / _RATE_HZ
    paced_ride = ride.to_and_fro(stamp_s)
    written_s = []
    for moment, images in enumerate(paced_ride.moments):
        for sample in paced_ride.motion(moment):
            time.sleep(max(sample.stamp_s - time.time(), 0.0))
            print(json.dumps(sample._asdict()), file=process.stdin, flush=True)
        for i in images:
            image = ride.drive.images[i]
            partial = folder / image.camera / "partial"
            shutil.copyfile(image.path, partial)
            # Exposed when it was due, however late this process was to write it.
            os.utime(partial, (float(stamp_s[moment]), float(stamp_s[moment])))
            partial.replace(folder / image.camera / f"{moment:06d}.jpg")
            written_s.append(float(stamp_s[moment]))
            if moment >= _KEPT:
                (folder / image.camera / f"{moment - _KEPT:06d}.jpg").unlink(missing_ok=True)
    return written_s


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark and print its lines."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("drive", type=Path, help="a rendered drive with its truth")
    parser.add_argument("--images", type=int, default=160, help="of all cameras together")
    parser.add_argument("--every-full", type=int, nargs="+", default=[1, 5])
    parser.add_argument("--seconds", type=float, default=0.0, help="of the command itself, at 10 Hz")
    parser.add_argument("--only-command", action="store_true", help="with --seconds: nothing but that")
    parsed = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    ride = ride_of(parsed.drive, parsed.images)
    if parsed.only_command:
        for every_full in parsed.every_full:
            print(paced(ride, every_full, parsed.seconds), flush=True)
        return
    detector = Detector.load()
    roads = {
        name: RoadDetector(detector, camera_from_calibration(calibration), calibration, is_for_localizer=True)
        for name, calibration in ride.calibrations.items()
    }
    for every_full in parsed.every_full:
        print(followed(ride, every_full, roads), flush=True)
        if parsed.seconds:
            print(paced(ride, every_full, parsed.seconds), flush=True)


if __name__ == "__main__":
    main()
