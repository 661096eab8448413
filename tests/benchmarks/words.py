"""How many words of rendered ports are read right, given their places.

    python -m tests.benchmarks.words [--runs port1 port2] [--seeds 41 43] [--wrong FOLDER]

Each port of a shipped run is built anew with other seeds and painted full of words, numbers and codes, as
worn and dirty as its other paint, upright for who drives. The reader gets the true poses and the outline of
each word with errors of 5 cm; only those images are rendered that it reads. Counted are the words that the
drive saw whole at least twice, by the truth: how many are read, how many rightly, and how many of those that
are said with a confidence of .8 and more. ``--wrong`` writes the patches of words that were not read rightly.
How many words of a drive are found at all is in the ``areas`` of ``metrics.json``, after ``v2hdm map``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from tests.benchmarks.adjust_ports import port_config
from v2hdm.records import Calibration, FloatArray, Image, Reading
from v2hdm.report.metrics import symbols_driven_past
from v2hdm.simulate.port.build import Port, build_port
from v2hdm.simulate.port.config import PortConfig, SignsConfig
from v2hdm.simulate.port.drive import true_drive
from v2hdm.site.living.wear import Footage
from v2hdm.words.patches import Word, best_views, patches_of
from v2hdm.words.reading import readings_of
from v2hdm.words.recogniser import Recogniser, load_recogniser

OUTLINE_SIGMA_M = 0.05  # error of a mapped outline's sides, m: half of it in each, as hulls of paint have
SIGHTINGS = 2  # images that show a word whole, at least
SURE = 0.8  # confidence from which a reading counts as sure

WORDS = (
    "EBH", "BUS", "STOP", "SLOW", "GATE", "EXIT", "TAXI", "KEEP CLEAR", "NO ENTRY", "TRUCKS", "REEFER",
    "LANE 4", "A12", "B07", "C31", "T16", "QC4", "RTG", "YARD", "EMPTY", "IN", "OUT", "FIRE", "XRAY",
)  # fmt: skip
NUMBERS = 24


class Result(NamedTuple):
    """A word of a port: what it says, how it was read, and its patches if they are kept."""

    text: str
    reading: Reading | None
    patches: list[list[np.ndarray]]

    @property
    def is_right(self) -> bool:
        """Whether the reading says what stands there."""
        return self.reading is not None and self.reading.text == self.text.replace(" ", "")


def port_of(run: str, seed: int) -> PortConfig:
    """The port of a shipped run, of another seed and full of words and numbers."""
    config = port_config(run)
    first = int(np.random.default_rng(seed).integers(10, 900))
    signs = SignsConfig(words=list(WORDS), numbers=NUMBERS, first_number=first)
    return replace(config, seed=seed, paint=replace(config.paint, signs=signs))


def results_of(config: PortConfig, recogniser: Recogniser, *, keep_wrong: bool = False) -> list[Result]:
    """The words of a port that its drive saw twice, with the patches of those that were not read rightly."""
    port = build_port(config)
    drive, truth = true_drive(config)
    expected = symbols_driven_past(drive, truth, list(drive.cameras), SIGHTINGS)
    numbers = [k for k in truth.texts if expected[k]]
    rng = np.random.default_rng([config.seed, 1])
    words = [Word.around(_measured(port.hd_map.symbols[k].outline_map, rng)) for k in numbers]
    calibrations = {
        name: Calibration(camera.info, port.cam_from_vehicle[name]) for name, camera in drive.cameras.items()
    }
    poses = [image.map_from_vehicle for image in drive.images]
    footage = Footage(drive.images, poses, calibrations, None)
    light = _light(port, drive.images)
    readings = readings_of(words, footage, drive.cameras, light, recogniser)
    results = []
    for number, word, upright in zip(numbers, words, readings, strict=True):
        result = Result(truth.texts[number], None if upright is None else upright.reading, [])
        if keep_wrong and not result.is_right:
            views = best_views([word], footage, drive.cameras)
            result.patches.extend(patch.upright for patch in patches_of([word], views, footage, light))
        results.append(result)
    return results


def _measured(outline_map: FloatArray, rng: np.random.Generator) -> FloatArray:
    """A rectangle (4, 2) whose sides are off by chance."""
    middle = outline_map.mean(axis=0)
    axes = np.diff(outline_map[:3], axis=0)
    half = np.linalg.norm(axes, axis=1) / 2
    directions = axes / (2 * half[:, None])
    corners = (outline_map - middle) @ directions.T
    low = -half + rng.normal(0.0, OUTLINE_SIGMA_M, 2)
    high = half + rng.normal(0.0, OUTLINE_SIGMA_M, 2)
    return np.asarray(middle + np.where(corners < 0, low, high) @ directions)


def _light(port: Port, images: Sequence[Image]) -> Callable[[Image], np.ndarray]:
    """Renders an image and reads its brightest colour, as mapping does."""
    frame_of = {image.path: k // len(port.cameras) for k, image in enumerate(images)}

    def light(image: Image) -> np.ndarray:
        picture = port.jpeg(port.picture(image.camera, frame_of[image.path]).image)
        colours = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
        assert colours is not None
        return np.asarray(colours.max(axis=2), dtype=np.float32)

    return light


def line_of(results: Sequence[Result]) -> str:
    """The figures of the words of a port."""
    right = sum(result.is_right for result in results)
    readings = [result for result in results if result.reading is not None]
    sure = [result for result in readings if result.reading and result.reading.confidence >= SURE]
    share = right / len(results) if results else float("nan")
    return (
        f"{len(results)} words seen twice, {len(readings)} read, {right} rightly ({share:.3f}); "
        f"of {len(sure)} said at {SURE} and more {sum(result.is_right for result in sure)}"
    )


def main() -> None:
    """Run the benchmark and print a line for each port and one for all."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--runs", nargs="+", default=["port1", "port2"])
    parser.add_argument("--seeds", nargs=2, type=int, default=[41, 42], help="from, and up to but without")
    parser.add_argument("--wrong", type=Path, help="folder for patches of words that were not read rightly")
    parsed = parser.parse_args()
    cv2.setNumThreads(1)
    recogniser = load_recogniser(1)
    if recogniser is None:
        raise SystemExit("the text extra is not installed")
    every = []
    for run in parsed.runs:
        for seed in range(*parsed.seeds):
            results = results_of(port_of(run, seed), recogniser, keep_wrong=parsed.wrong is not None)
            print(f"{run}, seed {seed}: {line_of(results)}", flush=True)
            for result in results:
                if not result.is_right:
                    print(f"  {result.text}: {result.reading}", flush=True)
                    if parsed.wrong is not None:
                        _write(parsed.wrong / f"{run}-{seed}-{result.text}.png", result)
            every += results
    print(f"all: {line_of(every)}")


def _write(path: Path, result: Result) -> None:
    """The patches of a word, a column for each image, a row for each direction that is above."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not result.patches:
        return
    sides = []
    for side in zip(*result.patches, strict=True):
        sides.append(
            np.hstack([cv2.copyMakeBorder(patch, 2, 2, 2, 2, cv2.BORDER_CONSTANT) for patch in side])
        )
    width = max(side.shape[1] for side in sides)
    rows = [cv2.copyMakeBorder(side, 0, 0, 0, width - side.shape[1], cv2.BORDER_CONSTANT) for side in sides]
    cv2.imwrite(str(path), np.vstack(rows))


if __name__ == "__main__":
    main()
