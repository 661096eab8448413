"""The score of a map of docs/own-class's port, class by class.

    python -m tests.benchmarks.own_class_score outputs/ownport

Figures of markings are those of ``metrics.json``. Symbols are held against the paint: one is found if a
symbol of its class is mapped within half a metre. Its error is the distance of the centres of area, its
overlap the intersection over union of the outlines.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import yaml

from tests.benchmarks.own_class import RUN_FILE, stencils_of
from v2hdm.geometry.planar import inside_convex
from v2hdm.geometry.rigid import ground_in_vehicle
from v2hdm.io.maps.reading import read_geojson
from v2hdm.records import ARROW, FloatArray, Symbol
from v2hdm.report.metrics import MIN_SIGHTINGS
from v2hdm.simulate.port.build import Port, build_port
from v2hdm.simulate.port.config import PaintConfig, PortConfig, RouteConfig
from v2hdm.simulate.port.drive import placed_boxes, points_seen

FOUND_M = 0.5
CELL_M = 0.005
ARROW_PIECES = 2


@dataclass(frozen=True)
class TrueSymbol:
    """A painted symbol: its class, its convex pieces (N, 2), and whether it was driven past."""

    kind: str
    pieces: list[FloatArray]
    expected: bool


def port_of(run_file: Path) -> Port:
    """The port of a run's configuration."""
    settings = yaml.safe_load(run_file.read_text(encoding="utf-8"))["simulate"]
    paint = PaintConfig(stencils=stencils_of(run_file))
    plain = {key: settings[key] for key in ("name", "seed", "initial_ipm")}
    return build_port(PortConfig(**plain, route=RouteConfig(**settings["route"]), paint=paint))


def true_symbols(port: Port) -> list[TrueSymbol]:
    """All painted symbols; one was driven past as a marking is, see :mod:`v2hdm.report.metrics`."""
    pieces_of = {name: len(stencil.shapes_m) for name, stencil in port.config.paint.stencils.items()}
    pieces_of = {ARROW: ARROW_PIECES} | {name: count for name, count in pieces_of.items() if count > 1}
    symbols = []
    for kind, count in pieces_of.items():
        pieces = [paint.polygon_map for paint in port.renderer.scene.paints if paint.kind == kind]
        groups = [pieces[k : k + count] for k in range(0, len(pieces), count)]
        symbols += [
            TrueSymbol(kind, pieces, _images(port, np.concatenate(pieces)) >= MIN_SIGHTINGS)
            for pieces in groups
        ]
    return symbols


def _images(port: Port, points: FloatArray) -> int:
    """How many images show all of some points inside their camera's region of interest."""
    count = 0
    for frame, pose in enumerate(port.driven.map_from_vehicle):
        for name, camera in port.cameras.items():
            if inside_convex(camera.roi_vehicle, ground_in_vehicle(pose, points)).all():
                boxes = placed_boxes(port.renderer.scene.boxes + port.moving_boxes(frame))
                is_seen = points_seen(camera.info, port.cam_from_map(name, frame), points, boxes)
                count += bool(is_seen.all())
    return count


def centre_and_overlap(pieces: Sequence[FloatArray], outline: FloatArray) -> tuple[FloatArray, float]:
    """Error (2,) of an outline's centre of area, m, and its intersection over union with some pieces."""
    low = np.concatenate([*pieces, outline]).min(axis=0) - 10 * CELL_M
    high = np.concatenate([*pieces, outline]).max(axis=0) + 10 * CELL_M
    masks = [np.zeros(np.ceil((high - low) / CELL_M).astype(int)[::-1], dtype=np.uint8) for _ in range(2)]
    for mask, shapes in zip(masks, (pieces, [outline]), strict=True):
        for shape in shapes:
            fixed = np.round((shape - low) / CELL_M * 16).astype(np.int32)
            cv2.fillPoly(mask, [fixed], 1, shift=4)
    true, mapped = (np.argwhere(mask)[:, ::-1].mean(axis=0) for mask in masks)
    overlap = masks[0] & masks[1]
    return (mapped - true) * CELL_M, float(overlap.sum() / (masks[0] | masks[1]).sum())


def scored(kind: str, true: Sequence[TrueSymbol], mapped: Sequence[Symbol]) -> str:
    """One line of the table."""
    of_kind = [symbol for symbol in true if symbol.kind == kind]
    left = [symbol for symbol in mapped if symbol.kind == kind]
    count, errors, overlaps, hits, expected = len(left), [], [], 0, 0
    for symbol in of_kind:
        centre = np.concatenate(symbol.pieces).mean(axis=0)
        distances_m = [float(np.linalg.norm(symbol.outline_map.mean(axis=0) - centre)) for symbol in left]
        nearest = int(np.argmin(distances_m)) if distances_m else -1
        is_found = nearest >= 0 and distances_m[nearest] < FOUND_M
        expected += symbol.expected
        hits += symbol.expected and is_found
        if is_found:
            error, overlap = centre_and_overlap(symbol.pieces, left.pop(nearest).outline_map)
            errors.append(error)
            overlaps.append(overlap)
    rmse_cm = 100 * np.sqrt((np.array(errors) ** 2).sum(axis=1).mean()) if errors else float("nan")
    return (
        f"{kind:14s} {count:6d} {len(left):6d} {hits:4d} of {expected:3d} {rmse_cm:9.1f}"
        f"   (centres; overlap {np.median(overlaps) if overlaps else float('nan'):.2f})"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    results = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))["results"]
    best = list(results.values())[-1]["Opt"]
    print(f"{'class':14s} {'mapped':>6s} {'false':>6s} {'driven past':>11s} {'RMSE (cm)':>9s}")
    for kind, row in best["by_class"].items():
        hits = round(row.get("recall", 0) * row["expected"])
        rmse_cm = 100 * row.get("corner_rmse_m", float("nan"))
        print(
            f"{kind:14s} {row['markings']:6d} {row['false_markings']:6d} {hits:4d} of {row['expected']:3d} "
            f"{rmse_cm:9.1f}   (corners)"
        )
    true = true_symbols(port_of(RUN_FILE))
    mapped = read_geojson(folder / "map.geojson").symbols
    for kind in dict.fromkeys([*(symbol.kind for symbol in true), *(symbol.kind for symbol in mapped)]):
        print(scored(kind, true, mapped))


if __name__ == "__main__":
    main()
