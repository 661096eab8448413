"""Time of the whole detector on one CPU core, beside graphs of the size of its peers, and its memory.

    python -m tests.benchmarks.detector_peers                    # a table of medians
    pytest tests/benchmarks/detector_peers.py --benchmark-only   # the same by pytest-benchmark

Ours is the whole chain: JPEG of 1280 x 720 read, network, corners, lanes, metres. The peers are their
networks alone, nothing read before and nothing made of what they give. All run in onnxruntime with the same
options and one thread, and take turns, so that a busy machine slows all of them; CPU time leaves out what it
spent on others.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import pytest

from tests.benchmarks.detector_peer_graphs import PEERS
from train.scenes.scenes import random_scene
from train.scenes.views import looking
from v2hdm.detection.frames import read_bgr
from v2hdm.detection.road import RoadDetector
from v2hdm.detection.stopwatch import Stopwatch, lap
from v2hdm.io.calibration.writing import write_calibration
from v2hdm.records import Calibration, CameraInfo
from v2hdm.simulate.render.renderer import Motion, Optics, Renderer

WIDTH, HEIGHT = 1280, 720
OURS = "ours, read to metres"
_SEED = 90_125


def write_images(folder: Path, count: int) -> tuple[list[Path], Path]:
    """Renders of ports and streets by one calibrated camera: the images and the calibration."""
    intrinsic = np.array([[1000.0, 0, 639.5], [0, 1000.0, 359.5], [0, 0, 1]])
    info = CameraInfo("front", WIDTH, HEIGHT, intrinsic, "plumb_bob", (-0.1, 0.02, 0.0, 0.0, 0.0))
    cam_from_vehicle = looking(np.array([0.0, 0.0, 1.8]), 0.0, np.deg2rad(6.0), 0.0)
    calibration = folder / "calibration_front.yaml"
    write_calibration(Calibration(info, cam_from_vehicle, 1e-6 * np.eye(6)), calibration)
    paths = []
    for index in range(count):
        rng = np.random.default_rng([_SEED, index])
        scene = random_scene(rng, difficulty=0.5)[0]
        image = Renderer(scene).render(info, cam_from_vehicle, rng, Optics(), Motion()).image
        paths.append(folder / "images" / f"{index:06d}.jpg")
        paths[-1].parent.mkdir(exist_ok=True)
        cv2.imwrite(str(paths[-1]), image)
    return paths, calibration


def our_chain(paths: list[Path], calibration: Path, model: str | None) -> Callable[[], None]:
    """A call that reads the next image and finds what it shows."""
    road = RoadDetector.load(calibration, model)
    turn = iter(range(1_000_000_000))

    def run() -> None:
        with lap("read"):
            image = read_bgr(paths[next(turn) % len(paths)])
        road.detect(image)

    return run


def peer_graph(name: str) -> Callable[[], None]:
    """A call that runs a peer's network on an image that is in memory already."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    peer = PEERS[name]
    session = onnxruntime.InferenceSession(peer.onnx(), options, providers=["CPUExecutionProvider"])
    image = np.random.default_rng(0).random((1, 3, peer.height, peer.width), dtype=np.float32)
    return lambda: session.run(None, {"image": image})


def peak_memory_mb(images: Path, calibration: Path, model: str | None) -> float:
    """The on-vehicle process's peak memory, by its own count."""
    command = [sys.executable, "-m", "v2hdm.detect", str(images), "--camera", str(calibration)]
    command += ["--model", model] if model else []
    process = subprocess.run(command, capture_output=True, text=True, check=True)
    peak = re.search(r"peak memory (\d+) MB", process.stderr)
    assert peak is not None, process.stderr
    return float(peak[1])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--model", help="ONNX file of our detector (default: the one that is shipped)")
    parser.add_argument("--rounds", type=int, default=5, help="turns of every peer; ours has 12 in each")
    parser.add_argument("--peers", nargs="*", choices=PEERS, default=list(PEERS))
    parsed = parser.parse_args()
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as name:
        paths, calibration = write_images(Path(name), 12)
        ours = our_chain(paths, calibration, parsed.model)
        peers = {peer: peer_graph(peer) for peer in parsed.peers}
        stopwatch, times_s = _take_turns({OURS: ours} | peers, parsed.rounds, len(paths))
        memory_mb = peak_memory_mb(Path(name) / "images", calibration, parsed.model)
    medians_ms = {name: 1e3 * np.median(np.array(times), axis=0) for name, times in times_s.items()}
    print(f"{'medians':24s} {'wall ms':>9s} {'CPU ms':>9s} {'ours x':>8s}")
    for name, (wall_ms, cpu_ms) in medians_ms.items():
        print(f"{name:24s} {wall_ms:9.1f} {cpu_ms:9.1f} {cpu_ms / medians_ms[OURS][1]:8.1f}")
        for stage in stopwatch.stages if name == OURS else ():
            print(f"  {stage:22s} {1e3 * float(np.median(stopwatch.times_s(stage))):9.1f}")
    print(f"peak memory of python -m v2hdm.detect: {memory_mb:.0f} MB")


def _take_turns(
    runs: dict[str, Callable[[], None]], rounds: int, images: int
) -> tuple[Stopwatch, dict[str, list[tuple[float, float]]]]:
    """Our wall times by stage, and wall and CPU seconds of every run, after a warm-up."""
    stopwatch = Stopwatch()
    times_s: dict[str, list[tuple[float, float]]] = {name: [] for name in runs}
    for run in runs.values():
        run()
    for _ in range(rounds):
        for name, run in runs.items():
            for _ in range(images if name == OURS else 1):
                wall_s, cpu_s = time.perf_counter(), time.process_time()
                with stopwatch.image() if name == OURS else nullcontext():
                    run()
                times_s[name].append((time.perf_counter() - wall_s, time.process_time() - cpu_s))
    return stopwatch, times_s


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", [OURS, *PEERS])
def test_latency(name: str, benchmark: Callable[..., None], tmp_path: Path) -> None:
    run = our_chain(*write_images(tmp_path, 12), None) if name == OURS else peer_graph(name)
    benchmark.pedantic(run, rounds=60 if name == OURS else 5, warmup_rounds=1)  # type: ignore[attr-defined]


if __name__ == "__main__":
    main()
