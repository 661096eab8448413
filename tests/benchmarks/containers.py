"""One drive in many containers: whether each gives the same map and the same verdict as the image folder.

``python -m tests.benchmarks.containers DRIVE [--only NAME ...] [--keep FOLDER]`` writes a drive folder (one
that ``v2hdm.map +run=port2`` has rendered into its cache, say) as a ROS 1 bag, ROS 2 bags in SQLite, MCAP and
MCAP with zstd, and as videos with the poses in a file: without loss (FFV1) and as a camera would (H.264 at
CRF 18). Every one is mapped as a user would map it. The table has markings, the largest distance of a corner
from the folder's map, and whether the verdict's findings are the same.

Bags carry images, camera_info and odometry. Survey, guesses and noise stay in ``drive.yaml``, which bags
cannot state.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import av
import cv2
import numpy as np
import yaml
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from tests.drive.bags import messages_of, write_ros1, write_ros2
from v2hdm.io.maps.reading import read_geojson
from v2hdm.pipeline.config import DriveConfig, RunConfig
from v2hdm.pipeline.run import run
from v2hdm.records import Marking

SAME_M = 0.5
"""Markings of one class whose centres lie nearer than this are the same."""


@dataclass(frozen=True)
class Mapped:
    """The map of one container, and the checks of its verdict that found something."""

    markings: Sequence[Marking]
    verdict: str
    raised: frozenset[str]


def described(drive: Path, folder: Path, images: Callable[[str], Any], **keys: Any) -> Path:
    """A folder with the description of ``drive``, its images from elsewhere."""
    content = yaml.safe_load((drive / "drive.yaml").read_text())
    content.pop("truth", None)
    content["name"] = "drive"
    for name, camera in content["cameras"].items():
        shutil.copyfile(drive / camera["camera_info"], folder / f"{name}.yaml")
        camera |= {"camera_info": f"{name}.yaml", "images": images(name)}
    shutil.copyfile(drive / "poses.tum", folder / "poses.tum")
    (folder / "drive.yaml").write_text(yaml.safe_dump(content | keys))
    return folder


def as_bag(drive: Path, folder: Path, write: Callable[[Path], Path]) -> Path:
    """A bag beside its description: the front camera's images raw, the others' as JPEG."""
    bag = write(folder / "site")
    topics = {True: "/sensing/{}/image_raw", False: "/sensing/{}/image_raw/compressed"}
    return described(
        drive,
        folder,
        lambda name: {"topic": topics[name == "front"].format(name)},
        bag=bag.name,
        poses={"topic": "/odom"},
    )


def as_video(drive: Path, folder: Path, codec: str, form: str, options: Mapping[str, str]) -> Path:
    """A video and a file of times for every camera."""
    for name in yaml.safe_load((drive / "drive.yaml").read_text())["cameras"]:
        rows = [line.split() for line in (drive / name / "images.txt").read_text().splitlines()[1:]]
        np.savetxt(folder / f"{name}.txt", [float(stamp) for stamp, _ in rows], fmt="%.9f")
        _film([drive / name / file for _, file in rows], folder / f"{name}.mkv", codec, form, options)
    return described(drive, folder, lambda name: {"video": f"{name}.mkv", "stamps": f"{name}.txt"})


def _film(files: Sequence[Path], path: Path, codec: str, form: str, options: Mapping[str, str]) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10, options=dict(options))
        height, width = cv2.imread(str(files[0])).shape[:2]
        stream.width, stream.height, stream.pix_fmt = width, height, form
        for number, file in enumerate(files):
            frame = av.VideoFrame.from_ndarray(cv2.imread(str(file)), format="bgr24")
            frame.pts, frame.time_base = number, Fraction(1, 10)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def containers(drive: Path) -> dict[str, Callable[[Path], Path]]:
    """How each is written into an empty folder; returns what is to be mapped."""

    def ros2(path: Path, storage: StoragePlugin, compression: CompressionMode) -> Path:
        return write_ros2(path, messages_of(drive), storage, compression)

    bag = partial(as_bag, drive)
    plain, packed = CompressionMode.NONE, CompressionMode.MESSAGE
    sqlite = partial(ros2, storage=StoragePlugin.SQLITE3, compression=plain)
    mcap = partial(ros2, storage=StoragePlugin.MCAP, compression=plain)
    zstd = partial(ros2, storage=StoragePlugin.MCAP, compression=packed)
    filmed = partial(as_video, drive)
    return {
        "folder": lambda folder: described(
            drive, folder, lambda name: str(drive.resolve() / name / "images.txt")
        ),
        "ROS 1 bag": lambda folder: bag(folder, lambda path: write_ros1(path, messages_of(drive, ros1=True))),
        "ROS 2 sqlite3": lambda folder: bag(folder, sqlite),
        "MCAP": lambda folder: bag(folder, mcap),
        "MCAP, zstd": lambda folder: bag(folder, zstd),
        "video, FFV1": lambda folder: filmed(folder, "ffv1", "bgr0", {}),
        "video, H.264": lambda folder: filmed(folder, "libx264", "yuv420p", {"crf": "18"}),
    }


def map_of(path: Path, output: Path, workers: int) -> Mapped:
    """The result of ``v2hdm.map drive.path=PATH``."""
    config = RunConfig(
        name="drive", drive=DriveConfig(path=str(path), cache=str(output / "cache")),
        output=str(output), cache=str(output / "cache"), workers=workers,
    )  # fmt: skip
    result = run(config)
    raised = frozenset(f"{finding.check}: {finding.status.name}" for finding in result.verdict.findings)
    markings = read_geojson(result.folder / "map.geojson").markings
    return Mapped(markings, result.verdict.status.name, raised)


def apart_m(a: Sequence[Marking], b: Sequence[Marking]) -> tuple[int, float]:
    """How many markings of ``a`` are in ``b``, and the largest distance of a corner of theirs."""
    largest, shared = 0.0, 0
    for marking in a:
        candidates = [
            two for two in b
            if two.kind == marking.kind
            and np.linalg.norm(two.corners_map.mean(axis=0) - marking.corners_map.mean(axis=0)) < SAME_M
        ]  # fmt: skip
        if candidates:
            shared += 1
            rolled = [np.roll(candidates[0].corners_map, k, axis=0) for k in range(4)]
            largest = max(largest, min(np.linalg.norm(marking.corners_map - r, axis=1).max() for r in rolled))
    return shared, float(largest)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("drive", type=Path)
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--keep", type=Path, help="folder that takes containers and maps")
    parser.add_argument("--workers", type=int, default=1)
    parsed = parser.parse_args()
    reference: Mapped | None = None
    with nullcontext(parsed.keep) if parsed.keep else TemporaryDirectory() as folder:
        for number, (name, write) in enumerate(containers(parsed.drive).items()):
            if parsed.only and name not in ("folder", *parsed.only):
                continue
            run_folder = Path(folder) / str(number)
            (run_folder / "given").mkdir(parents=True)
            mapped = map_of(write(run_folder / "given"), run_folder / "out", parsed.workers)
            reference = reference or mapped
            shared, largest_m = apart_m(reference.markings, mapped.markings)
            same = (
                "same"
                if mapped.raised == reference.raised
                else f"differs: {mapped.raised ^ reference.raised}"
            )
            print(
                f"{name:14s} {len(mapped.markings):4d} markings, {shared:4d} of the folder's, "
                f"largest distance {1e3 * largest_m:7.4f} mm, verdict {mapped.verdict} ({same})",
                flush=True,
            )
            if not parsed.keep:
                shutil.rmtree(run_folder)


if __name__ == "__main__":
    main()
