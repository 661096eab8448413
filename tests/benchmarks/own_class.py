"""Labelled images of rendered ports with paint of own classes, as docs/labels.md trains from them.

    python -m tests.benchmarks.own_class runs/own/labels

stands in for photos that somebody has labelled: images (JPEG) and ``instances.json`` in COCO's format, every
marking in them labelled, by the edge of its paint. The ports have the stencils of ``docs/own-class/run``, but
other seeds, grounds and light than the port there.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.simulate.port.build import Port, build_port
from v2hdm.simulate.port.config import (
    ExposureConfig,
    PaintConfig,
    PortConfig,
    RouteConfig,
    StencilConfig,
    SurfaceConfig,
    YardConfig,
)

RUN_FILE = Path(__file__).parents[2] / "docs" / "own-class" / "run" / "ownport.yaml"
FIRST_SEED = 101
ROUTE = [[60.0, 0.0], [24.0, -90.0], [40.0, 0.0], [20.0, 60.0], [30.0, 0.0]]
LEAST_PX = 12
"""Smaller pieces are labelled by nobody."""

_FINER = 4
"""Contours run through the centres of parts of pixels, of so many along each side."""

LIGHTS = ((120.0, 42.0), (-35.0, 27.0), (60.0, 65.0), (200.0, 35.0), (-80.0, 20.0), (10.0, 50.0))
GROUNDS = (
    SurfaceConfig(),
    SurfaceConfig(texture="asphalt", albedo=0.13, contrast=0.2, slab_m=[0.0, 0.0], wet_fraction=0.12),
    SurfaceConfig(texture="asphalt", albedo=0.2, contrast=0.15, slab_m=[0.0, 0.0], patches=60),
)


def training_port(number: int, stencils: dict[str, StencilConfig]) -> PortConfig:
    """Port ``number`` of those that are labelled."""
    azimuth, elevation = LIGHTS[number % len(LIGHTS)]
    return PortConfig(
        name=f"labelled{number}",
        seed=FIRST_SEED + number,
        route=RouteConfig(pieces=ROUTE),
        paint=PaintConfig(stencils=stencils, wear=0.1 + 0.05 * (number % 3), dirt=0.2 + 0.05 * (number % 3)),
        surface=GROUNDS[number % len(GROUNDS)],
        yard=YardConfig(sun_azimuth_deg=azimuth, sun_elevation_deg=elevation),
        exposure=replace(ExposureConfig(), level=(0.25, 0.19, 0.3)[number % 3]),
    )


def stencils_of(run_file: Path) -> dict[str, StencilConfig]:
    """The stencils of a run's configuration."""
    stencils = yaml.safe_load(run_file.read_text(encoding="utf-8"))["simulate"]["paint"]["stencils"]
    return {name: StencilConfig(**settings) for name, settings in stencils.items()}


def pictures(port: Port, count: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """About ``count`` images and their labels, evenly along the drive, of all cameras in turn."""
    cameras = sorted(port.cameras)
    frames = np.linspace(0, len(port.driven.stamp_s) - 1, count).astype(int)
    for k, frame in enumerate(frames.tolist()):
        picture = port.picture(cameras[k % len(cameras)], frame)
        yield picture.image, picture.labels


def polygons(mask: np.ndarray) -> list[list[float]]:
    """The outlines of a mask's pieces along its pixels' borders, as COCO has them."""
    fine = np.kron(mask.astype(np.uint8), np.ones((_FINER, _FINER), np.uint8))
    contours, _ = cv2.findContours(fine, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    large_contours = [
        contour[:, 0] for contour in contours if cv2.contourArea(contour) >= _FINER**2 * LEAST_PX
    ]
    return [((contour + 0.5) / _FINER).ravel().tolist() for contour in large_contours]


def main() -> None:
    """Write the labelled images."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--ports", type=int, default=6)
    parser.add_argument("--images", type=int, default=40, help="of each port")
    parsed = parser.parse_args()
    parsed.folder.mkdir(parents=True, exist_ok=True)
    stencils = stencils_of(RUN_FILE)
    classes = (*PAINT_CLASSES, *stencils)
    content: dict[str, list[Any]] = {
        "categories": [{"id": label, "name": name} for label, name in enumerate(classes, start=1)],
        "images": [],
        "annotations": [],
    }
    for number in range(parsed.ports):
        port = build_port(training_port(number, stencils))
        for image, labels in pictures(port, parsed.images):
            identity = len(content["images"]) + 1
            name = f"{identity:04d}.jpg"
            (parsed.folder / name).write_bytes(port.jpeg(image))
            height, width = labels.shape
            content["images"].append({"id": identity, "file_name": name, "width": width, "height": height})
            for label in np.unique(labels[labels > 0]).tolist():
                content["annotations"] += [
                    {
                        "id": len(content["annotations"]) + 1 + k,
                        "image_id": identity,
                        "category_id": label,
                        "segmentation": [polygon],
                    }
                    for k, polygon in enumerate(polygons(labels == label))
                ]
        print(f"port {number}: {len(content['images'])} images, {len(content['annotations'])} markings")
    (parsed.folder / "instances.json").write_text(json.dumps(content), encoding="utf-8")


if __name__ == "__main__":
    main()
