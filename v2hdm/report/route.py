"""The recorded route from above: speed by colour, heading by arrows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from v2hdm.records import FloatArray, Trajectory
from v2hdm.report import style

_ARROWS = 30
"""Arrows along the route: enough to see a heading go wrong, few enough to see each."""

_MOST_POINTS = 5000
"""Points of the line that is drawn."""


def save_route(path: Path, trajectory: Trajectory) -> None:
    """Draw where the vehicle was, how fast, and where its x axis pointed."""
    stride = -(-len(trajectory.stamp_s) // _MOST_POINTS)
    stamp_s, poses = trajectory.stamp_s[::stride], trajectory.map_from_vehicle[::stride]
    place = poses[:, :2, 3]
    with style.figure(path, 8.0, 6.0) as fig:
        axes = fig.subplots()
        if len(place) > 1:
            segments = np.stack([place[:-1], place[1:]], axis=1)
            speed = np.linalg.norm(np.diff(place, axis=0), axis=1) / np.diff(stamp_s)
            line = LineCollection(list(segments), array=speed, cmap="cividis", lw=8, capstyle="round")
            line.set_clim(0.0, max(float(np.percentile(speed, 99)), 1e-9))
            axes.add_collection(line)
            fig.colorbar(line, ax=axes, shrink=0.7, label="speed (m/s)")
        _draw_headings(axes, poses)
        axes.plot(*place[0], "o", color="white", mec="#1b1e21", ms=9, zorder=4, label="start")
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.08)
        axes.set_xlabel("x: east (m)")
        axes.set_ylabel("y: north (m)")
        axes.set_title("Route as recorded; arrows: the vehicle's x axis")
        fig.legend(loc="outside lower left")


def _draw_headings(axes: Axes, poses: FloatArray) -> None:
    """Arrows at even distances along the path, each a twentieth of the route's extent long."""
    place = poses[:, :2, 3]
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=1))])
    chosen = np.unique(np.searchsorted(way, np.linspace(0, way[-1], _ARROWS)))
    length = 0.05 * max(float(np.ptp(place, axis=0).max()), 1e-9)
    axes.quiver(
        *place[chosen].T, *(length * poses[chosen, :2, 0]).T,
        angles="xy", scale_units="xy", scale=1, width=0.0028, color="white", edgecolor="#1b1e21",
        linewidth=0.7, zorder=3,
    )  # fmt: skip
