"""CPU time of the detector here and in another checkout, by turns, image by image, on rendered ports.

    python -m tests.benchmarks.detector_checkouts CHECKOUT --runs port1 port2 --images 12 --rounds 3

Each checkout has a process, which reads an image's JPEG file and detects in it (``--mapping``: with the
settings of mapping); of the two only one works at a time. Printed are the medians over the rounds' means, and
their ratio. What is compiled here is used; with ``V2HDM_NATIVE=0`` it is not.
"""

from __future__ import annotations

import argparse
import os
import pickle
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from tests.benchmarks.adjust_ports import port_config
from tests.benchmarks.detector_ports import SEED, examples
from v2hdm.simulate.port.build import build_port

_INFO = ("name", "width", "height", "intrinsic", "distortion_model", "distortion")

PROGRAM = """
import pickle, sys, time
from pathlib import Path
import cv2
from v2hdm.detection.detector import Detector
from v2hdm.detection.frames import read_bgr
from v2hdm.detection.options import DetectorOptions
from v2hdm.records import Camera, CameraInfo

cv2.setNumThreads(1)
cameras = {
    info["name"]: Camera(CameraInfo(**info), ipm, initial, roi)
    for info, ipm, initial, roi in pickle.loads(Path(sys.argv[1]).read_bytes())
}
options = DetectorOptions.for_mapping() if sys.argv[2] == "True" else DetectorOptions()
detector = Detector.load(options=options)
for line in sys.stdin:
    path, name = line.split()
    began_s = time.process_time()
    detector.detect(read_bgr(Path(path)), cameras[name])
    print(time.process_time() - began_s, flush=True)
"""


class Checkout:
    """A process that detects with the code of one checkout."""

    def __init__(self, folder: Path, cameras: Path, mapping: bool):
        self.process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, str(cameras), str(mapping)], cwd=folder, text=True,
            env={**os.environ, "PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"},
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip

    def took_s(self, path: Path, camera: str) -> float:
        """CPU seconds of one image."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        print(path, camera, file=self.process.stdin, flush=True)
        return float(self.process.stdout.readline())

    def close(self) -> None:
        """End the process."""
        self.process.communicate()


def images_of(run: str, count: int, folder: Path) -> tuple[list[tuple[Path, str]], Path]:
    """JPEG files of a port with the names of their cameras, and a file of these cameras."""
    port = build_port(replace(port_config(run), seed=SEED))
    cameras = {}
    shown = []
    for number, example in enumerate(examples(port, count)):
        path = folder / f"{run}-{number}.jpg"
        cv2.imwrite(str(path), example.image, [cv2.IMWRITE_JPEG_QUALITY, 90])
        name = example.camera.info.name
        cameras.setdefault(name, example.camera)
        shown.append((path, name))
    file = folder / f"{run}.pickle"
    # As numbers: records may differ from one checkout to another.
    plain = [
        (
            {key: getattr(camera.info, key) for key in _INFO},
            camera.ipm,
            camera.initial_ipm,
            camera.roi_vehicle,
        )
        for camera in cameras.values()
    ]
    file.write_bytes(pickle.dumps(plain))
    return shown, file


def main() -> None:
    """Print one line for each port."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("checkout", type=Path)
    parser.add_argument("--runs", nargs="+", default=["port1", "port2"])
    parser.add_argument("--images", type=int, default=12)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--mapping", action="store_true")
    parsed = parser.parse_args()
    here = Path(__file__).parents[2]
    with tempfile.TemporaryDirectory() as name:
        for run in parsed.runs:
            shown, cameras = images_of(run, parsed.images, Path(name))
            folders = (here, parsed.checkout.resolve())
            checkouts = [Checkout(folder, cameras, parsed.mapping) for folder in folders]
            # The first round fills caches.
            took_s = np.array(
                [
                    [[checkout.took_s(*image) for checkout in checkouts] for image in shown]
                    for _ in range(parsed.rounds + 1)
                ]
            )[1:]
            for checkout in checkouts:
                checkout.close()
            ours_ms, theirs_ms = 1e3 * np.median(took_s.mean(axis=1), axis=0)
            print(f"{run}: {ours_ms:.1f} ms, there {theirs_ms:.1f} ms: {ours_ms / theirs_ms:.3f}", flush=True)


if __name__ == "__main__":
    main()
