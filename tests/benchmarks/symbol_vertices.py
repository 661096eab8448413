"""How far the vertices of a rendered port's mapped arrows are from the paint's.

    python -m tests.benchmarks.symbol_vertices outputs/port2 port2

For every mapped arrow: its vertices, the root mean square distance of the true vertices to the nearest mapped
one, the largest distance of either outline from the other, and how much of the error is one shift of the
whole arrow, cm.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from tests.benchmarks.adjust_ports import port_config
from v2hdm.io.maps.reading import read_geojson
from v2hdm.records import ARROW, FloatArray
from v2hdm.simulate.port.build import build_port

NEAR_M = 0.7  # a mapped arrow farther than this from every true one is false
STEP_M = 0.005


def true_arrows(run: str) -> list[FloatArray]:
    """The vertices (7, 2) of the arrows of a shipped run's port, from its shafts and heads."""
    paints = build_port(port_config(run)).renderer.scene.paints
    pieces = [paint.polygon_map for paint in paints if paint.kind == ARROW]
    arrows = []
    for shaft, (right, tip, left) in zip(pieces[::2], pieces[1::2], strict=True):
        # Shafts run on under their heads: they meet where the head begins.
        along = (tip - (left + right) / 2) / np.linalg.norm(tip - (left + right) / 2)
        notches = [end - ((end - right) @ along) * along for end in shaft[1:3]]
        arrows.append(np.array([shaft[0], notches[0], right, tip, left, notches[1], shaft[3]]))
    return arrows


def along(ring: FloatArray) -> FloatArray:
    """Points of a closed polygon, about :data:`STEP_M` apart."""
    sides = np.roll(ring, -1, axis=0) - ring
    count = np.maximum(np.linalg.norm(sides, axis=1) / STEP_M, 1).astype(int)
    return np.concatenate(
        [a + np.linspace(0, 1, n)[:, None] * b for a, b, n in zip(ring, sides, count, strict=True)]
    )


def apart(outline: FloatArray, other: FloatArray) -> FloatArray:
    """Distances (N,) of points (N, 2) from the nearest of others (M, 2)."""
    return np.asarray(np.linalg.norm(outline[:, None] - other, axis=2).min(axis=1))


def main() -> None:
    """Print a line an arrow, and the figure of all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("run")
    arguments = parser.parse_args()
    true, errors = true_arrows(arguments.run), []
    for symbol in read_geojson(arguments.folder / "map.geojson").symbols:
        outline = along(symbol.outline_map)
        nearest = min(
            true, key=lambda arrow: float(np.linalg.norm(along(arrow).mean(axis=0) - outline.mean(axis=0)))
        )
        if np.linalg.norm(along(nearest).mean(axis=0) - outline.mean(axis=0)) > NEAR_M:
            print(f"false: a {symbol.kind} at {symbol.outline_map.mean(axis=0).round(1)}")
            continue
        off = (
            symbol.outline_map[np.linalg.norm(nearest[:, None] - symbol.outline_map, axis=2).argmin(axis=1)]
            - nearest
        )
        hausdorff_m = max(apart(outline, along(nearest)).max(), apart(along(nearest), outline).max())
        errors.append((off**2).sum(axis=1))
        shift_m, sigma_m = np.linalg.norm(off.mean(axis=0)), symbol.sigma_m or np.nan
        print(
            f"{symbol.sightings:3d} images, {len(symbol.outline_map):2d} vertices: "
            f"{100 * np.sqrt(errors[-1].mean()):5.1f} (largest distance {100 * hausdorff_m:5.1f}, "
            f"shift {100 * shift_m:4.1f}, sigma {100 * sigma_m:.1f}), {(100 * np.sqrt(errors[-1])).round(1)}"
        )
    print(f"{len(errors)} of {len(true)} arrows, vertices {100 * np.sqrt(np.mean(errors)):.2f} cm RMSE")
    print(f"median of the arrows {100 * np.sqrt(np.median(np.mean(errors, axis=1))):.2f} cm")


if __name__ == "__main__":
    main()
