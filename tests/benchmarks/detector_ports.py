"""How well the shipped detector sees in single images of the rendered ports, on layouts nobody has looked at.

    python -m tests.benchmarks.detector_ports --runs port1 port2 --images 60

The ports of the shipped runs are built anew with another seed: markings, wear, containers, traffic, shadows
and poses all differ. Of images spread evenly over the drive and its cameras, JPEG as in the drive, the
table of :mod:`tests.benchmarks.detector_quality` is printed, lanes' lines within 50 m.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np

from tests.benchmarks.adjust_ports import port_config
from tests.benchmarks.detector_quality import counted, summary
from train.examples import Example, example_of
from train.scenes.views import TrainingView
from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.records import Camera, FloatArray
from v2hdm.simulate.port.build import Port, build_port
from v2hdm.simulate.render.renderer import Motion, Optics

SEED = 9001
"""No shipped run has it."""

LANES_WITHIN_M = 50.0


def examples(port: Port, images: int) -> Iterator[Example]:
    """So many images of a port's drive, evenly spread, its cameras by turns, and what they show."""
    names = sorted(port.cameras)
    for number, frame in enumerate(np.linspace(0, len(port.driven.stamp_s) - 1, images).astype(int)):
        name = names[number % len(names)]
        rendered = port.picture(name, int(frame))
        recorded = np.frombuffer(port.jpeg(rendered.image), np.uint8)
        image = np.asarray(cv2.imdecode(recorded, cv2.IMREAD_COLOR), dtype=np.uint8)
        view = TrainingView(port.cameras[name].info, port.cam_from_map(name, int(frame)), Optics(), Motion())
        shown = example_of(port.renderer.scene, _lanes_near(port, view), view, rendered, _camera(port, name))
        yield replace(shown, image=image)


def _camera(port: Port, name: str) -> Camera:
    """A port's camera that knows its true IPM."""
    camera = port.cameras[name]
    ipm = ipm_from_extrinsic(camera.info, port.cam_from_vehicle[name])
    return Camera(camera.info, {"true": ipm}, "true", camera.roi_vehicle)


def _lanes_near(port: Port, view: TrainingView) -> list[FloatArray]:
    """The stretches of the port's lines (N, 2, map) that are near the camera."""
    centre = np.linalg.inv(view.cam_from_map)[:2, 3]
    stretches = []
    for lane in port.hd_map.lanes:
        rows = np.flatnonzero(np.linalg.norm(lane.points_map - centre, axis=1) < LANES_WITHIN_M)
        stretches += [lane.points_map[run] for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)]
    return [stretch for stretch in stretches if len(stretch) > 1]


def main() -> None:
    """Run the benchmark and print a table for each port."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--runs", nargs="+", default=["port1", "port2"])
    parser.add_argument("--images", type=int, default=60, help="of each port")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--model")
    parsed = parser.parse_args()
    cv2.setNumThreads(1)
    for run in parsed.runs:
        port = build_port(replace(port_config(run), seed=parsed.seed))
        print(f"{run}, seed {parsed.seed}")
        print(summary(counted(examples(port, parsed.images), parsed.model), parsed.images))


if __name__ == "__main__":
    main()
