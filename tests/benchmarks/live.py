"""Whether ``v2hdm detect --live`` keeps up with two cameras.

    python -m tests.benchmarks.live --seconds 30 --rate 10 --markings 20

Rendered images of port 2, built with another seed, in which the detector finds about so many markings, are
written to a folder per camera at that rate, and a process per camera looks at the newest. For each camera
it prints images a second, how old an image was when its line came out, how many were dropped, CPU time an
image, and how long the process waited for a core: on a machine that others use the last says what the ages
are worth. Then the CPU time of each stage, medians. For Linux.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from tests.benchmarks.adjust_ports import port_config
from tests.benchmarks.detector_ports import SEED
from v2hdm.detection.road import RoadDetector
from v2hdm.io.calibration.writing import write_calibration
from v2hdm.records import Calibration
from v2hdm.simulate.port.build import build_port

_DETECT = """
import signal, sys, time
from unittest.mock import patch
from v2hdm.cli.commands.detect import _run as run
signal.signal(signal.SIGINT, signal.default_int_handler)  # which what runs in the background ignores
with patch("time.perf_counter", time.process_time):
    run(sys.argv[1:])
"""  # the command itself, whose stages tell CPU time
_CHOSEN_OF = 4  # times as many images are rendered as are shown
_WARM_UP_S = 3.0  # after the first line of every process


@dataclass
class _Camera:
    """A process that detects in a folder, and the lines that it wrote."""

    name: str
    folder: Path
    images: Sequence[bytes]
    process: subprocess.Popen[bytes]
    lines: list[tuple[float, bytes]] = field(default_factory=list)

    def follow(self) -> None:
        """Take its lines as they come."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append((time.time(), line))

    def write(self, number: int) -> None:
        """Write an image; it appears whole."""
        partial = self.folder / "partial"
        partial.write_bytes(self.images[number % len(self.images)])
        partial.replace(self.folder / f"{number:06d}.jpg")

    def spent_s(self) -> np.ndarray:
        """Seconds that the process ran, and that it waited for a core."""
        schedule = Path(f"/proc/{self.process.pid}/schedstat").read_text().split()
        return np.array(schedule[:2], dtype=np.float64) / 1e9


def pictures(folder: Path, images: int, markings: int) -> dict[str, list[bytes]]:
    """For each camera so many JPEG files of about so many markings, in order; writes its calibration."""
    port = build_port(replace(port_config("port2"), seed=SEED))
    chosen = {}
    for name in sorted(port.cameras):
        calibration = folder / f"{name}.yaml"
        write_calibration(Calibration(port.cameras[name].info, port.cam_from_vehicle[name]), calibration)
        road = RoadDetector.load(calibration)
        frames = np.linspace(0, len(port.driven.stamp_s) - 1, _CHOSEN_OF * images).astype(int).tolist()
        files = [port.jpeg(port.picture(name, frame).image) for frame in frames]
        decoded = (cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) for data in files)
        counts = np.array([len(road.detect(np.asarray(image)).markings) for image in decoded])
        nearest = np.argsort(np.abs(counts - markings), kind="stable")[:images]
        chosen[name] = [files[k] for k in np.sort(nearest).tolist()]
    return chosen


def watched(folder: Path, shown: dict[str, list[bytes]], rate_hz: float, seconds: float) -> None:
    """Write images, and print what became of them."""
    cameras = []
    for name, images in shown.items():
        place = folder / name
        place.mkdir()
        arguments = [place, "--camera", folder / f"{name}.yaml", "--live"]
        command = [sys.executable, "-c", _DETECT, *map(str, arguments)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        cameras.append(_Camera(name, place, images, process))
    for camera in cameras:
        threading.Thread(target=camera.follow, daemon=True).start()
    begin, spent = None, []
    number, next_s = 0, time.time()
    while begin is None or time.time() < begin + seconds:
        for camera in cameras:
            camera.write(number)
        number, next_s = number + 1, next_s + 1 / rate_hz
        time.sleep(max(next_s - time.time(), 0.0))
        first = [camera.lines[0][0] for camera in cameras if camera.lines]
        if begin is None and len(first) == len(cameras) and time.time() > max(first) + _WARM_UP_S:
            begin, spent = time.time(), [camera.spent_s() for camera in cameras]
    spent = [camera.spent_s() - before for camera, before in zip(cameras, spent, strict=True)]
    end = time.time()
    for camera in cameras:
        camera.process.send_signal(signal.SIGINT)
    print(f"{'camera':8s}  images/s  age, ms: p50   p99  most  dropped  markings  CPU, ms  waited, ms")
    for camera, (ran_s, waited_s) in zip(cameras, spent, strict=True):
        records = [(at, json.loads(line)) for at, line in camera.lines if begin <= at < end]
        age_ms = [1e3 * (at - record["stamp_s"]) for at, record in records]
        p50, p99, most = np.percentile(age_ms, [50, 99, 100])
        count, dropped = len(records), sum(record["dropped"] for _, record in records)
        markings = np.mean([len(record["markings"]) for _, record in records])
        print(
            f"{camera.name:8s} {count / (end - begin):9.1f} {p50:13.0f} {p99:5.0f} {most:5.0f} {dropped:8d} "
            f"{markings:9.1f} {1e3 * ran_s / count:8.1f} {1e3 * waited_s / count:11.1f}"
        )
    for camera in cameras:
        assert camera.process.stderr is not None
        rows = (line.split() for line in camera.process.stderr.read().decode().splitlines())
        stages = [f"{row[0]} {row[1]}" for row in rows if len(row) == 4 and row[0] != "age"]
        print(f"{camera.name}, CPU ms: {', '.join(stages)}")
        camera.process.wait()


def main() -> None:
    """Run the benchmark and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--rate", type=float, default=10.0, help="images a second of each camera")
    parser.add_argument("--markings", type=int, default=20, help="found in an image, about")
    parser.add_argument("--images", type=int, default=12, help="different ones of each camera")
    parsed = parser.parse_args()
    cv2.setNumThreads(1)
    print(f"{os.cpu_count()} cores, of which others kept {os.getloadavg()[0]:.1f} busy before")
    with TemporaryDirectory() as folder:
        shown = pictures(Path(folder), parsed.images, parsed.markings)
        watched(Path(folder), shown, parsed.rate, parsed.seconds)


if __name__ == "__main__":
    main()
