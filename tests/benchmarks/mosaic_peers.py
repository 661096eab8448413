"""The mosaic against the plain loop over images in OpenCV: the same output, how many seconds.

    python -m tests.benchmarks.mosaic_peers RESULT [--images 120] [--threads 1] [--rounds 3]

The loop removes the distortion of each whole image (``cv2.undistort``), warps it onto the part of the canvas
that it shows (``cv2.warpPerspective``) and adds it there with the same weights, in numpy. ``cached`` is that
loop with the lens's maps made once a camera. All decode the same files by the same call. They take turns
within each round; the least of the rounds counts, as CPU seconds of the process, which neighbours on the
machine hardly touch, and as wall seconds.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch

from v2hdm.detection.frames import read_bgr
from v2hdm.io.drive import drive_of
from v2hdm.io.maps.reading import read_geojson
from v2hdm.mosaic.blend import whole
from v2hdm.mosaic.result import MULTIPLE_PX, RESOLUTION_M, ground_of
from v2hdm.mosaic.views import Canvas, Lens, Shot
from v2hdm.store.names import MAP

Undistort = Callable[[str, np.ndarray], np.ndarray]


def plain_loop(
    canvas: Canvas, shots: Sequence[Shot], lenses: Mapping[str, Lens], undistort: Undistort
) -> np.ndarray:
    """(rows, columns, 3) uint8 RGB, and black where nothing was seen."""
    sums = np.zeros((canvas.rows, canvas.columns, 3), dtype=np.float32)
    weights = np.zeros((canvas.rows, canvas.columns), dtype=np.float32)
    trust = {name: undistort(name, lens.trust) for name, lens in lenses.items()}
    canvas_from_map = np.linalg.inv(canvas.map_from_canvas)
    for shot in shots:
        outline = shot.outline_map(lenses[shot.camera]) @ canvas_from_map[:2, :2].T + canvas_from_map[:2, 2]
        low = np.maximum(np.floor(outline.min(axis=0)).astype(int), 0)
        high = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + 1, [canvas.columns, canvas.rows])
        if (high <= low).any():
            continue
        (column, row), (columns, rows) = low.tolist(), (high - low).tolist()
        px_from_part = shot.pinhole_px_from_map @ canvas.window(row, column, rows, columns).map_from_canvas
        pixels = undistort(shot.camera, read_bgr(shot.path))
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        colours = cv2.warpPerspective(pixels, px_from_part, (columns, rows), flags=flags)
        trusted = cv2.warpPerspective(trust[shot.camera], px_from_part, (columns, rows), flags=flags)
        across, down, constant = px_from_part[2].astype(np.float32)
        third = across * np.arange(columns, dtype=np.float32) + (
            down * np.arange(rows, dtype=np.float32)[:, None] + constant
        )
        # Behind the camera nothing is trusted: a mirror image of it may seem so.
        weight = np.where(third > 0, trusted * (np.float32(np.linalg.det(px_from_part)) / third**3) ** 2, 0)
        part = np.s_[row : row + rows, column : column + columns]
        sums[part] += weight[..., None] * colours
        weights[part] += weight
    mean = sums / np.where(weights > 0, weights, 1)[..., None]
    return np.asarray(mean[..., ::-1].round().astype(np.uint8))


def by_undistort(lenses: Mapping[str, Lens]) -> Undistort:
    """``cv2.undistort`` of every image."""

    def undistort(name: str, pixels: np.ndarray) -> np.ndarray:
        info = lenses[name].info
        return cv2.undistort(pixels, info.intrinsic, np.array(info.distortion))

    return undistort


def by_maps(lenses: Mapping[str, Lens]) -> Undistort:
    """``cv2.remap`` by fixed-point maps that are made once."""
    maps = {
        name: cv2.initUndistortRectifyMap(
            lens.info.intrinsic,
            np.array(lens.info.distortion),
            None,
            lens.info.intrinsic,
            (lens.info.width, lens.info.height),
            cv2.CV_16SC2,
        )
        for name, lens in lenses.items()
    }
    return lambda name, pixels: cv2.remap(pixels, *maps[name], cv2.INTER_LINEAR)


def main() -> None:
    """Print the seconds and how far the outputs differ."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("result", type=Path)
    parser.add_argument("--images", type=int, help="only the first (default: all)")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--resolution", type=float, default=RESOLUTION_M)
    parsed = parser.parse_args()
    torch.set_num_threads(parsed.threads)
    cv2.setNumThreads(parsed.threads)
    hd_map = read_geojson(parsed.result / MAP)
    ground = ground_of(parsed.result, drive_of(parsed.result, None), parsed.resolution, hd_map)
    shots, lenses = ground.after[: parsed.images], ground.lenses
    outlines_map = np.concatenate([shot.outline_map(lenses[shot.camera]) for shot in shots])
    canvas = Canvas.around(outlines_map, parsed.resolution, MULTIPLE_PX)
    ways: dict[str, Callable[[], np.ndarray]] = {
        "ours": lambda: whole(canvas, shots, lenses),
        "plain": lambda: plain_loop(canvas, shots, lenses, by_undistort(lenses)),
        "cached": lambda: plain_loop(canvas, shots, lenses, by_maps(lenses)),
    }
    seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in ways}
    pictures = {}
    for number in range(parsed.rounds):
        for name in list(ways)[:: 1 if number % 2 else -1]:
            cpu_s, wall_s = time.process_time(), time.perf_counter()
            pictures[name] = ways[name]()
            seconds[name].append((time.process_time() - cpu_s, time.perf_counter() - wall_s))
    ours = pictures["ours"]
    opaque = ours[..., 3] == 255
    print(
        f"{len(shots)} images on {canvas.rows} x {canvas.columns} px of {parsed.resolution:g} m, "
        f"{parsed.threads} threads, {parsed.rounds} rounds"
    )
    for name, times in seconds.items():
        cpu_s, wall_s = np.min(times, axis=0)
        off = np.abs(ours[opaque][:, :3].astype(int) - pictures[name][opaque][:, :3])
        print(
            f"{name:>7}: CPU {cpu_s:6.2f} s, wall {wall_s:6.2f} s; "
            f"differs by {off.mean():.2f} grey values (99 %: {np.percentile(off, 99):.0f})"
        )


if __name__ == "__main__":
    main()
