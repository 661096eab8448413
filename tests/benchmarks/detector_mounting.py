"""Whether a guess of the camera's mounting decides what the detector finds.

    python -m tests.benchmarks.detector_mounting --cameras 10
    python -m tests.benchmarks.detector_mounting --labels data/roadmark/instances.json --mounting 1.3 -11.4 90

Folders of images, each of one camera, go through ``v2hdm.detect`` with nothing stated, with the mounting
stated, and with a pitch that is some degrees off. Printed by class: the share of the true markings that is
found (overlap over .3) and that is named, and how many are given. Folders are renders of random cameras, or
photographs with labels (COCO; squeezed to squares from 16:9, numbered stems, below ``--stems`` only).
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from train.examples import HEIGHT, MAX_RANGE_M, WIDTH, Example, example_of, polygon_overlap
from train.scenes.scenes import random_scene
from train.scenes.views import TrainingView, looking
from v2hdm.detection.camera import rough_calibration
from v2hdm.detection.detector import Detector
from v2hdm.detection.frames import read_bgr
from v2hdm.detection.options import DetectorOptions
from v2hdm.geometry.ipm import apply_homography, ipm_from_extrinsic
from v2hdm.pipeline.detect_images import detect_images
from v2hdm.records import Camera, FloatArray
from v2hdm.simulate.render.renderer import Motion, Optics, Renderer

SEED = 771_000_011
"""No training or validation seed, nor one of other benchmarks."""

WRONG_DEG = (3.0, -3.0)
_OVERLAP = 0.3
_LONGEST_DASH_M = 6.5  # labels do not tell dashes from lines
_BODY_DEG = 0.35

Truth = list[tuple[str, FloatArray]]


@dataclass(frozen=True)
class Folder:
    """Images of one camera on a disk, what each shows, and the camera's mounting as it would be stated."""

    path: Path
    truth: list[Truth]
    mounting: tuple[float, float, float]


def rendered(root: Path, camera: int, images: int, seed: int = SEED) -> Folder:
    """Images of random scenes from one random camera that a vehicle may carry, its body in motion."""
    rng = np.random.default_rng([seed, camera])
    fov_deg, height_m = (float(np.exp(rng.uniform(*np.log(r)))) for r in ((45, 100), (1.1, 2.7)))
    pitch_deg, roll_deg, yaw_deg = float(rng.uniform(-10, 18)), rng.normal(0, 1.5), rng.normal(0, 3)
    folder = root / f"camera {camera}"
    folder.mkdir()
    truth = []
    for index in range(images):
        rng_of_image = np.random.default_rng([seed, camera, index])
        angles = np.deg2rad(
            [yaw_deg, *(np.array([pitch_deg, roll_deg]) + rng_of_image.normal(0, _BODY_DEG, 2))]
        )
        centre = np.array([0.0, rng_of_image.normal(0, 0.6), height_m])
        shown = _render(rng_of_image, looking(centre, *angles.tolist()), fov_deg)
        cv2.imwrite(str(folder / f"{index:03d}.png"), shown.image)
        in_range = [t for t in shown.markings if t.fair and t.range_m <= MAX_RANGE_M]
        truth.append([(t.kind, t.polygon_px) for t in in_range])
    return Folder(folder, truth, (height_m, pitch_deg, fov_deg))


def _render(rng: np.random.Generator, cam_from_map: FloatArray, fov_deg: float) -> Example:
    scene, lanes = random_scene(rng)
    info = rough_calibration("rendered", WIDTH, HEIGHT, 1.0, 0.0, fov_deg).info
    view = TrainingView(info, cam_from_map, Optics(), Motion())
    image = Renderer(scene).render(info, cam_from_map, rng, view.optics, view.motion)
    ipm = ipm_from_extrinsic(info, cam_from_map)
    middle = apply_homography(ipm, np.array([[WIDTH / 2, HEIGHT - 1.0]]))
    square = middle + np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])
    return example_of(scene, lanes, view, image, Camera(info, {"true": ipm}, "true", square))


def photographs(
    root: Path, labels: Path, mounting: tuple[float, float, float], stems: int, every: int
) -> Folder:
    """Labelled photographs of one camera, 16:9 again."""
    content = json.loads(labels.read_text(encoding="utf-8"))
    names = {category["id"]: category["name"] for category in content["categories"]}
    of_image = defaultdict(list)
    for annotation in content["annotations"]:
        of_image[annotation["image_id"]].append(annotation)
    chosen = sorted(content["images"], key=lambda image: image["file_name"])
    chosen = [image for image in chosen if int(image["file_name"][:3]) < stems][::every]
    folder = root / "photographs"
    folder.mkdir()
    truth = []
    for annotation in chosen:
        squeezed = read_bgr(labels.parent / "images" / annotation["file_name"])
        image = cv2.resize(squeezed, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / Path(annotation["file_name"]).with_suffix(".png")), image)
        scale = np.array([WIDTH / annotation["width"], HEIGHT / annotation["height"]])
        parts = [
            (names[a["category_id"]], np.reshape(part, (-1, 2)) * scale)
            for a in of_image[annotation["id"]]
            for part in a["segmentation"]
        ]
        truth.append([(kind, p) for name, p in parts if (kind := _kind(name, p, mounting))])
    return Folder(folder, truth, mounting)


def _kind(name: str, polygon_px: FloatArray, mounting: tuple[float, float, float]) -> str | None:
    if name == "line":
        calibration = rough_calibration("camera", WIDTH, HEIGHT, *mounting)
        ipm = ipm_from_extrinsic(calibration.info, calibration.cam_from_vehicle)
        ends = polygon_px[[polygon_px[:, 1].argmin(), polygon_px[:, 1].argmax()]]
        length_m = float(np.linalg.norm(np.subtract(*apply_homography(ipm, ends))))
        return "lane_dash" if length_m < _LONGEST_DASH_M else None
    if name.startswith("arrow"):
        return "arrow"
    return "diamond" if name == "diamond_outline" else None


def mountings(folder: Folder) -> Iterator[tuple[str, tuple[float, float, float] | None]]:
    """The stated mounting, by name."""
    height_m, pitch_deg, fov_deg = folder.mounting
    yield "nothing stated", None
    yield "stated", folder.mounting
    for off in WRONG_DEG:
        yield f"stated {off:+g} deg", (height_m, pitch_deg + off, fov_deg)


def count(
    folder: Folder, stated: Sequence[float] | None, detector: Detector, counts: Counter[tuple[str, str]]
) -> None:
    """Detect in a folder and count by class."""
    begin_s = time.process_time()
    with contextlib.redirect_stderr(io.StringIO()):
        results = list(detect_images(folder.path, mounting=stated, detector=detector))
    counts["all", "ms"] += round(1e3 * (time.process_time() - begin_s))
    for result, truth in zip(results, folder.truth, strict=True):
        counts["all", "images"] += 1
        shapes = [
            (m.kind, m.image.outline_px if len(m.image.outline_px) else m.image.corners_px)
            for m in result.road.markings
        ]
        counts.update((kind, "given") for kind, _ in shapes)
        for kind, polygon_px in truth:
            overlaps = [(polygon_overlap(shape, polygon_px), kind) for kind, shape in shapes]
            best, name = max(overlaps, default=(0.0, ""))
            counts[kind, "true"] += 1
            counts[kind, "found"] += best > _OVERLAP
            counts[kind, "named"] += best > _OVERLAP and name == kind


def summary(name: str, counts: Counter[tuple[str, str]]) -> str:
    """One line of the table."""
    kinds = sorted({kind for kind, what in counts if what == "true"})
    parts = [
        f"{kind} {counts[kind, 'found'] / true:.3f}/{counts[kind, 'named'] / true:.3f} of {true} "
        f"({counts[kind, 'given']})"
        for kind in kinds
        if (true := counts[kind, "true"])
    ]
    every = sum(counts[kind, "true"] for kind in kinds)
    named = sum(counts[kind, "named"] for kind in kinds) / max(every, 1)
    ms = counts["all", "ms"] / counts["all", "images"]
    return f"{name:16s} all {named:.3f}  {ms:.0f} ms  {'; '.join(parts)}"


def main() -> None:
    """Run the benchmark and print its table: class found/named of true (given)."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cameras", type=int, default=10)
    parser.add_argument("--images", type=int, default=8, help="of each rendered camera")
    parser.add_argument("--labels", type=Path, help="COCO file of photographs, in place of renders")
    parser.add_argument("--mounting", type=float, nargs=3, help="of the photographs' camera")
    parser.add_argument("--stems", type=int, default=200)
    parser.add_argument("--every", type=int, default=4)
    parser.add_argument("--only", help="of the mountings that are stated, the one of this name")
    parsed = parser.parse_args()
    cv2.setNumThreads(1)
    detector = Detector.load(options=DetectorOptions(max_range_m=40.0))
    counts: dict[str, Counter[tuple[str, str]]] = defaultdict(Counter)
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        if parsed.labels:
            folders = iter(
                [photographs(root, parsed.labels, tuple(parsed.mounting), parsed.stems, parsed.every)]
            )
        else:
            folders = (rendered(root, camera, parsed.images) for camera in range(parsed.cameras))
        for folder in folders:
            for said, stated in mountings(folder):
                if parsed.only in (None, said):
                    count(folder, stated, detector, counts[said])
    for said, counted in counts.items():
        print(summary(said, counted))


if __name__ == "__main__":
    main()
