"""Whether memory and time an image stay flat over a long life.

``python -m tests.benchmarks.endurance detect DRIVE [--images 20000]`` gives the on-vehicle door a folder in
which the images of a drive repeat, and watches its process. ``... map DRIVE [--images 800000] [--cameras
front]`` detects once and then maps, judges, evaluates and writes the drive again and again in one process, as
a service would. Both print a line now and then: images so far, resident memory, processor time an image. The
last line has the growth after the first tenth. Time is the processor's, so that a busy machine moves no
figure.
"""

from __future__ import annotations

import argparse
import gc
import itertools
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from v2hdm.detection.batch import detect_all
from v2hdm.detection.options import DetectorOptions
from v2hdm.executor import Executor, open_executor
from v2hdm.io.drive import read_drive
from v2hdm.pipeline.config import DriveConfig
from v2hdm.pipeline.context import Context
from v2hdm.pipeline.map_drive import map_drive
from v2hdm.records import Drive

_FIRST = 0.1
"""Share of the whole after which memory must not grow."""

Sample = tuple[int, float, float]
"""Images so far, resident memory in MB, processor time in s."""


def resident_mb(process: int) -> float:
    """Resident memory of a process."""
    for line in Path(f"/proc/{process}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024
    raise SystemExit(f"process {process} has ended")


def processor_s(process: int) -> float:
    """Processor time that a process has used."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(") ")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def detecting(drive: Path, images: int, every: int) -> Iterator[Sample]:
    """Samples of the door's process while it looks at the images of one camera again and again."""
    pictures = sorted(drive.rglob("*.jpg"))
    if not pictures:
        raise SystemExit(f"{drive}: no .jpg in it")
    files = sorted(pictures[0].parent.glob("*.jpg"))
    with TemporaryDirectory(prefix="endurance-") as scratch:
        folder = Path(scratch)
        for i, file in zip(range(images), itertools.cycle(files), strict=False):
            (folder / f"{i:07}.jpg").symlink_to(file.resolve())
        command = [sys.executable, "-m", "v2hdm.detect", str(folder)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as door:
            assert door.stdout is not None
            for count, _ in enumerate(door.stdout, 1):
                if count % every == 0 and count < images:
                    yield count, resident_mb(door.pid), processor_s(door.pid)
        if door.returncode != 0:
            raise SystemExit(f"the door ended with {door.returncode}")


def mapping(drive: Path, images: int, cameras: tuple[str, ...]) -> Iterator[Sample]:
    """Samples of this process while it maps one drive again and again, after each round."""
    read = read_drive(drive, DriveConfig(cameras=list(cameras)))
    with open_executor() as executor:
        detections = detect_all(read, DetectorOptions(), executor)

    def replay(
        drive: Drive, options: DetectorOptions, images: Sequence[int], executor: Executor, take: Any
    ) -> None:
        for index in images:
            take(detections[index])

    with TemporaryDirectory(prefix="endurance-") as scratch:
        for count in itertools.count(len(read.images), len(read.images)):
            result = map_drive(read, detector=DetectorOptions(), context=Context(detect=replay, workers=1))
            result.save(Path(scratch) / "result")
            del result
            gc.collect()
            yield count, resident_mb(os.getpid()), time.process_time()
            if count >= images:
                return


def main() -> int:
    """Run one of the two; 1 where memory has grown by more than a twentieth."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("what", choices=("detect", "map"))
    parser.add_argument("drive", type=Path)
    parser.add_argument("--images", type=int)
    parser.add_argument("--cameras", nargs="*", default=())
    parsed = parser.parse_args()
    images = parsed.images or {"detect": 20_000, "map": 800_000}[parsed.what]
    began = time.perf_counter()
    measured: list[Sample] = []
    if parsed.what == "detect":
        samples = detecting(parsed.drive, images, max(images // 100, 1))
    else:
        samples = mapping(parsed.drive, images, tuple(parsed.cameras))
    for sample in samples:
        measured.append(sample)
        count, resident, used_s = sample
        last = measured[-2] if len(measured) > 1 else (0, 0.0, 0.0)
        each_ms = 1000 * (used_s - last[2]) / (count - last[0])
        print(
            f"{time.perf_counter() - began:8.0f} s  {count:8d} images  {resident:8.1f} MB  "
            f"{each_ms:6.2f} ms an image",
            flush=True,
        )
    counts, resident_all, used = np.array(measured).T
    first = int(np.searchsorted(counts, _FIRST * images))
    growth = resident_all[first:].max() / resident_all[: first + 1].max() - 1
    rate = np.diff(used) / np.diff(counts)
    halves = [1000 * float(np.median(half)) for half in np.array_split(rate, 2)]
    print(
        f"memory after the first tenth: {100 * growth:+.1f} %; ms an image in the first and the second half: "
        f"{halves[0]:.2f}, {halves[1]:.2f}"
    )
    return int(growth > 0.05)


if __name__ == "__main__":
    sys.exit(main())
