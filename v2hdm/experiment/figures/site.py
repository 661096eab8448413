"""The site from above, ENI against ONI corner by corner, and each camera's calibration and residuals."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from v2hdm.experiment.measures import CELLS, Matched, Measured
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import CameraInfo, FloatArray
from v2hdm.report import style
from v2hdm.report.photos import project_line

LINK = "#e3001b"
"""Colour of lines between corners that belong together."""


def colour(row: str) -> str:
    """Colour of a row of the tables: that of its method, under whichever recipe."""
    return style.METHOD.get(method_of(row), "k")


def method_of(row: str) -> str:
    """The method of a row of the tables, such as ``Opt, paper``."""
    return row.split(",")[0]


def drive_of(record: Mapping[str, Any]) -> str:
    """The drive of a record in words."""
    return str(record["port"]) if record["seed"] is None else f"{record['port']}, seed {record['seed']}"


_SITE_IN = 9.0  # longer side of the site
_INSET_IN = 3.4
_BESIDE_M = 12.0
_WIDE = 1.6  # width of a site over its height above which the insets stand below it

_OPT, _LANE = style.METHOD["Opt"], style.METHOD["ONI"]

_NEAR_M, _FAR_M = 1.0, 6.0
"""Half the width of an inset: of one that shows a corner's error, and of one that shows a neighbourhood."""

_LETTERS = {"a": (2, (3, 1)), "b": (0, (-9, -9)), "c": (3, (-9, 1))}
"""Corner of each inset's square that its letter stands at, and how far from it (pt)."""

_ENI = "#3a3f44"  # ENI's outlines, where its own red is that of the correspondences


def save_map(path: Path, record: Mapping[str, Any], measured: Measured) -> str | None:
    """Draw the optimised map over the truth, with three insets; returns the caption."""
    cameras = list(measured.matched)[-1]
    found = measured.matched[cameras].get("Opt")
    if found is None or not len(found.true):
        return None
    mapped = _corners(record, found)[1]
    error_cm = 100 * np.linalg.norm(found.errors_m, axis=2)
    mean_cm = error_cm.mean(axis=1)
    median, (worst, corner) = int(np.argsort(mean_cm)[len(mean_cm) // 2]), divmod(int(error_cm.argmax()), 4)
    insets = [
        (_crowd(mapped.mean(axis=1), _FAR_M), _FAR_M, "most markings together"),
        (mapped[median].mean(axis=0), _NEAR_M, f"a usual one, {mean_cm[median]:.1f} cm off"),
        (mapped[worst, corner], _NEAR_M, f"the worst corner, {error_cm.max():.1f} cm off"),
    ]
    lanes = _lines(record["lanes"].get("Opt", []))
    with style.figure(path, *_size_in(record, len(insets))) as fig:
        site, others = _axes(fig, record, len(insets))
        for axes in (site, *others):
            _draw_truth(axes, record)
            axes.add_collection(LineCollection(lanes, colors=_LANE, lw=1.0, zorder=2))
            fill = _OPT if axes is site else "none"
            outlines = PolyCollection(list(mapped), facecolors=fill, edgecolors=_OPT, lw=1.4, zorder=3)
            axes.add_collection(outlines)
        for letter, axes, place in zip("abc", others, insets, strict=True):
            _frame(site, axes, place, letter)
        site.set_title(f"{drive_of(record)}: Opt, {cameras}, {len(mapped)} markings over the truth")
        site.plot([], [], color=style.ROUTE, lw=5, label="route")
        site.fill([], [], facecolor=style.PAINT, edgecolor=style.TRUTH, label="truth")
        site.fill([], [], facecolor=_OPT, edgecolor=_OPT, label="mapped marking")
        site.plot([], [], color=_LANE, lw=1.0, label="mapped lane line")
        fig.legend(handles=site.get_legend_handles_labels()[0], loc="outside lower center", ncols=4)
    return (
        f"The map of {drive_of(record)} (Opt, cameras: {cameras}) in teal over the true paint in grey; "
        "lanes in blue; east and north in m. The insets are the places marked on the map: a shows the "
        f"most markings together, b, 2 m wide, one of the median error ({mean_cm[median]:.1f} cm on "
        f"average over its corners), c, as wide, the worst corner of all ({error_cm.max():.1f} cm). See "
        "that in b the outline runs along the edge of the paint, and how far it leaves it in c. True "
        "markings without an outline were not mapped."
    )


def save_shift(path: Path, record: Mapping[str, Any], measured: Measured) -> str | None:
    """Draw ENI against ONI with corner correspondences; returns the caption."""
    cameras = list(measured.matched)[-1]
    before, after = (measured.matched[cameras].get(name) for name in ("ENI", "ONI"))
    if before is None or after is None:
        return None
    common, rows, columns = np.intersect1d(before.true, after.true, return_indices=True)
    if not len(common):
        return None
    eni, oni = _corners(record, before)[1][rows], _corners(record, after)[1][columns]
    true = _true_corners(record)[common]
    error_cm = [100 * np.sqrt(((corners - true) ** 2).sum(axis=2).mean()) for corners in (eni, oni)]
    links = list(np.stack([eni.reshape(-1, 2), oni.reshape(-1, 2)], axis=1))
    moved = np.linalg.norm(eni - oni, axis=2).mean(axis=1)
    insets = [
        (_crowd(true.mean(axis=1), _FAR_M), _FAR_M, "most markings together"),
        (true[moved.argmax()].mean(axis=0), _FAR_M / 2, f"moved the most, by {100 * moved.max():.0f} cm"),
    ]
    with style.figure(path, *_size_in(record, len(insets))) as fig:
        site, others = _axes(fig, record, len(insets))
        for axes in (site, *others):
            _draw_truth(axes, record)
            width = 0.7 if axes is site else 1.5
            for corners, colour in ((eni, _ENI), (oni, style.METHOD["ONI"])):
                look: dict[str, Any] = {"edgecolors": colour, "lw": width, "zorder": 3}
                axes.add_collection(PolyCollection(list(corners), facecolors="none", **look))
            axes.add_collection(LineCollection(links, colors=LINK, lw=width, ls=(0, (3, 2)), zorder=4))
        for letter, axes, place in zip("ab", others, insets, strict=True):
            _frame(site, axes, place, letter)
        site.set_title(f"{drive_of(record)}: ENI against ONI, {cameras}")
        site.plot([], [], color=_ENI, label="ENI")
        site.plot([], [], color=style.METHOD["ONI"], label="ONI")
        site.plot([], [], color=LINK, ls=(0, (3, 2)), label="the same corner")
        site.fill([], [], facecolor=style.PAINT, edgecolor=style.TRUTH, label="truth")
        fig.legend(handles=site.get_legend_handles_labels()[0], loc="outside lower center", ncols=4)
    return (
        f"The naive map of {drive_of(record)} (cameras: {cameras}) under the borrowed IPM (ENI, black) and "
        f"under the IPM that the optimisation found (ONI, blue), for the {len(common)} markings that both "
        "have; a red dashed line joins the two places of each corner. East and north in m; the insets are "
        f"the squares on the map. ENI is {error_cm[0]:.1f} cm off (RMSE), ONI {error_cm[1]:.1f} cm. See "
        "that the lines of neighbours run alike and turn with the vehicle: the error is one of the "
        "calibration, not of single sightings."
    )


_Place = tuple[FloatArray, float, str]
"""An inset: its centre (2,) and half its width, m, and its title."""


def _true_corners(record: Mapping[str, Any]) -> FloatArray:
    return np.array(record["truth"]["corners"]).reshape(-1, 4, 2)


def _corners(record: Mapping[str, Any], found: Matched) -> tuple[FloatArray, FloatArray]:
    """True and mapped corners (M, 4, 2) of matched markings, in the same order."""
    true = _true_corners(record)[found.true]
    return true, true + found.errors_m


def _crowd(centres: FloatArray, half_m: float) -> FloatArray:
    """The centre (2,) with the most others within a square about it."""
    near = (np.abs(centres[:, None] - centres[None]).max(axis=2) < half_m).sum(axis=1)
    return np.asarray(centres[int(near.argmax())])


def _extent_m(record: Mapping[str, Any]) -> FloatArray:
    return np.asarray(np.ptp(np.array(record["route"]), axis=0) + 2 * _BESIDE_M)


def _size_in(record: Mapping[str, Any], insets: int) -> tuple[float, float]:
    """Width and height: the insets stand to the right of a site, below one that is much wider than high."""
    extent = _extent_m(record)
    width, height = _SITE_IN * extent / extent.max()
    if extent[0] > _WIDE * extent[1]:
        return max(width, insets * _INSET_IN) + 0.6, height + _INSET_IN + 1.4
    return width + _INSET_IN + 1.4, max(height, insets * (_INSET_IN + 0.5)) + 0.8


def _axes(fig: Figure, record: Mapping[str, Any], insets: int) -> tuple[Axes, list[Axes]]:
    """The site with its route, and the axes of the insets."""
    extent = _extent_m(record)
    width, height = _SITE_IN * extent / extent.max()
    if extent[0] > _WIDE * extent[1]:
        grid = fig.add_gridspec(2, insets, height_ratios=[height, _INSET_IN])
        site, others = fig.add_subplot(grid[0, :]), [fig.add_subplot(grid[1, n]) for n in range(insets)]
    else:
        grid = fig.add_gridspec(insets, 2, width_ratios=[width, _INSET_IN])
        site, others = fig.add_subplot(grid[:, 0]), [fig.add_subplot(grid[n, 1]) for n in range(insets)]
    route = np.array(record["route"])
    site.plot(*route.T, color=style.ROUTE, lw=5, zorder=0, solid_capstyle="round")
    low, high = route.min(axis=0) - _BESIDE_M, route.max(axis=0) + _BESIDE_M
    site.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    for axes in (site, *others):
        style.set_map_axes(axes)
    return site, others


def _lines(plain: Sequence[Any]) -> list[FloatArray]:
    return [np.array(line) for line in plain]


def _draw_truth(axes: Axes, record: Mapping[str, Any]) -> None:
    corners = _true_corners(record)
    axes.add_collection(
        PolyCollection(list(corners), facecolors=style.PAINT, edgecolors=style.TRUTH, lw=0.4, zorder=1)
    )
    axes.add_collection(LineCollection(_lines(record["true_lanes"]), colors=style.PAINT, lw=2.2, zorder=0.5))


def _frame(site: Axes, inset: Axes, place: _Place, letter: str) -> None:
    """Cut an inset to a square, and mark that square on the site."""
    centre, half_m, text = place
    square = centre + half_m * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    site.plot(*square.T, color="k", lw=1.0, zorder=5)
    corner, offset = _LETTERS[letter]
    bold: dict[str, Any] = {"weight": "bold", "zorder": 6, "fontsize": 12}
    site.annotate(letter, square[corner], xytext=offset, textcoords="offset points", **bold)
    style.cut_to_square(inset, centre, half_m)
    inset.set_title(f"{letter}: {text}", fontsize=10)


_ROI = "#0b7a75"
_ARROW_SHARE = 0.8  # share of a cell's width that the longest arrow of a field takes


def save_calibration(path: Path, record: Mapping[str, Any], pictures: Path) -> str | None:
    """Draw the clicked and surveyed points and the region of interest; returns the caption."""
    cameras = record["cameras"]
    with style.figure(path, 13.0, 4.3 * len(cameras)) as fig:
        panels = fig.subplots(len(cameras), 2, squeeze=False, width_ratios=[1.5, 1])
        for row, (name, camera) in enumerate(cameras.items()):
            _draw_image(panels[row, 0], camera, pictures)
            _draw_ground(panels[row, 1], camera)
            panels[row, 0].set_title(f"{drive_of(record)}, {name}: as clicked")
            panels[row, 1].set_title(f"{name}: as surveyed")
        panels[0, 1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    count = [len(camera["clicked_px"]) for camera in cameras.values() if camera["clicked_px"] is not None]
    points = f"The {count[0]} points" if count else "No points are known"
    started = sorted({camera["initial_ipm"] for camera in cameras.values()})
    return (
        f"{points} of the manual calibration of {drive_of(record)}: numbered as clicked in the image (px), "
        "and as surveyed on the ground in the vehicle's frame (m; x forward, y left). The teal line is "
        "the region of interest within which the IPM that the mapping starts from "
        f"({' and '.join(started)}) is trusted. See that the points span the ground that the naive methods "
        "use, and that the far ones are clicked where a pixel is decimetres long."
    )


def _draw_image(axes: Axes, camera: Mapping[str, Any], pictures: Path) -> None:
    image = cv2.imread(str(pictures / camera["picture"]))
    info = info_of(camera)
    if image is not None:
        axes.imshow(image[..., ::-1])
    roi = np.array(camera["roi_vehicle"])
    closed = np.vstack([roi, roi[:1]])
    dense = np.concatenate([np.linspace(a, b, 40) for a, b in itertools.pairwise(closed)])
    for piece in project_line(info, np.array(camera["true_cam_from_vehicle"]), dense):
        axes.plot(*piece.T, color=_ROI, lw=2.5)
    if camera["clicked_px"] is not None:
        clicked = np.array(camera["clicked_px"])
        axes.plot(*clicked.T, "+", color=LINK, ms=11, mew=2)
        for number, point in enumerate(clicked, 1):
            axes.annotate(
                str(number), point, xytext=(6, 4), textcoords="offset points", color="white", weight="bold",
                bbox={"facecolor": "black", "alpha": 0.55, "pad": 1.0, "lw": 0}, fontsize=8,
            )  # fmt: skip
    style.set_image_axes(axes, -0.5, info.width - 0.5, info.height - 0.5, -0.5)


def _draw_ground(axes: Axes, camera: Mapping[str, Any]) -> None:
    roi = np.array(camera["roi_vehicle"])
    axes.plot(*np.vstack([roi, roi[:1]]).T, color=_ROI, lw=2.5, label="region of interest")
    if camera["surveyed_vehicle"] is not None:
        surveyed = np.array(camera["surveyed_vehicle"])
        axes.plot(*surveyed.T, "+", color=LINK, ms=11, mew=2, label="surveyed point")
        for number, point in enumerate(surveyed, 1):
            axes.annotate(str(number), point, xytext=(6, 4), textcoords="offset points", fontsize=8)
    centre = camera_centre(np.array(camera["true_cam_from_vehicle"]))
    axes.plot(*centre[:2], "k^", ms=8, label="camera")
    axes.plot(0, 0, "ko", mfc="white", ms=7, label="rear axle")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.1)
    axes.set(xlabel="x: forward (m)", ylabel="y: left (m)")


def save_fields(path: Path, record: Mapping[str, Any]) -> str | None:
    """Draw the median residuals over the image, before and after; returns the caption."""
    cameras = record.get("residuals")
    if not cameras:
        return None
    changes = []
    with style.figure(path, 13.0, 4.2 * len(cameras)) as fig:
        panels = fig.subplots(len(cameras), 2, squeeze=False)
        for row, (name, found) in enumerate(cameras.items()):
            field, lengths = found["field"], []
            for column, when in enumerate(("before", "after")):
                _draw_field(panels[row, column], field[when], field["size_px"])
                length = field[when]["length_px"]
                lengths.append("-" if length is None else f"{length:.2f} px")
                panels[row, column].set_title(f"{drive_of(record)}, {name}: {when}, {lengths[-1]}")
            changes.append(f"{name} from {lengths[0]} to {lengths[1]}")
    return (
        "Median residual of detected corners against the optimised map by cell of the image, "
        f"{drive_of(record)}: before, under the IPM that the mapping started from and the recorded poses; "
        "after, under the optimised extrinsic and the adjusted poses. Axes in px of the image without "
        "distortion. The arrow above each panel gives its scale, which differs between panels; cells "
        "without an arrow hold too few corners. The median length of all residuals falls: "
        f"{', '.join(changes)}. See that before the arrows run along with each other, as under a turned "
        "camera, and look for any such order that is left after."
    )


def _draw_field(axes: Axes, field: Mapping[str, Any], size_px: tuple[int, int]) -> None:
    width, height = size_px
    cell = np.array([width / CELLS[0], height / CELLS[1]])
    places, arrows = [], []
    for index, mean in enumerate(field["median_px"]):
        if mean is not None:
            places.append((np.array([index % CELLS[0], index // CELLS[0]]) + 0.5) * cell)
            arrows.append(mean)
    style.set_image_axes(axes, 0, width, height, 0)
    axes.set(xticks=np.arange(CELLS[0] + 1) * cell[0], yticks=np.arange(CELLS[1] + 1) * cell[1])
    axes.set(aspect="equal", axisbelow=True)
    axes.grid(color=style.GRID)
    if not arrows:
        return
    longest = float(np.linalg.norm(arrows, axis=1).max())
    scale = max(longest, 1e-6) / (_ARROW_SHARE * cell[0])
    drawn = axes.quiver(
        *np.array(places).T, *np.array(arrows).T, angles="xy", scale_units="xy", scale=scale, width=0.004,
        color=LINK, pivot="mid",
    )  # fmt: skip
    round_px = float(f"{longest:.1g}")
    axes.quiverkey(drawn, 0.85, 1.06, round_px, f"{round_px:g} px", labelpos="E")


def info_of(camera: Mapping[str, Any]) -> CameraInfo:
    """The intrinsics in a record."""
    plain = dict(camera["info"])
    return CameraInfo(
        **plain | {"intrinsic": np.array(plain["intrinsic"]), "distortion": tuple(plain["distortion"])}
    )
