"""The figures of an experiment, as PNG, and the values that their captions state."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from v2hdm.experiment.measures import CELLS, Matched, Measured
from v2hdm.experiment.plan import PAPER, Job
from v2hdm.experiment.summary import by_port
from v2hdm.geometry.rigid import camera_centre
from v2hdm.mapping.options import INCREMENTAL
from v2hdm.records import CameraInfo, FloatArray
from v2hdm.report import style
from v2hdm.report.photos import project_outline

Caption = Mapping[str, Any]  # the values in a figure's caption, by their names in the template figures.md


def save_figures(
    folder: Path,
    todo: Sequence[Job],
    records: Sequence[Mapping[str, Any]],
    measured: Sequence[Measured],
    progress: Callable[[int, int], None],
) -> dict[str, tuple[str, Caption]]:
    """Draw all figures into a folder; figures of single drives show the first seed of each port.

    ``progress`` is called with how many figures are drawn, of how many.

    Returns:
        By file name the kind and the caption of each figure that could be drawn.
    """
    firsts: dict[str, int] = {}
    for number, one in enumerate(measured):
        firsts.setdefault(one.port, number)
    work: dict[str, tuple[str, Callable[[Path], Caption | None]]] = {}
    for port, n in firsts.items():
        record, one = records[n], measured[n]
        of_port = {
            "map": partial(_save_map, record=record, measured=one),
            "eni_oni": partial(_save_shift, record=record, measured=one),
            "calibration": partial(_save_calibration, record=record, pictures=todo[n].folder),
            "reprojection": partial(_save_fields, record=record),
        }
        work |= {f"{kind}_{port}.png": (kind, draw) for kind, draw in of_port.items()}
    work["corners.png"] = "corners", partial(_save_boxes, firsts=[measured[n] for n in firsts.values()])
    work["growth.png"] = "growth", partial(_save_growth, records=records)
    work["range.png"] = "range", partial(_save_ranges, records=records)
    work["bias_spread.png"] = "bias_spread", partial(_save_balance, measured=measured)
    captions = {}
    for done, (name, (kind, save)) in enumerate(work.items()):
        progress(done, len(work))
        caption = save(folder / name)
        if caption is None:
            (folder / name).unlink(missing_ok=True)
        else:
            captions[name] = kind, caption
    progress(len(work), len(work))
    return captions


LINK = "#e3001b"  # colour of lines between corners that belong together


def _drive_of(record: Mapping[str, Any]) -> str:
    return str(record["port"]) if record["seed"] is None else f"{record['port']}, seed {record['seed']}"


_SITE_IN = 9.0  # longer side of the site
_INSET_IN = 3.4
_BESIDE_M = 12.0
_WIDE = 1.6  # width of a site over its height above which the insets stand below it

_OPT, _LANE = style.METHOD["Opt"], style.METHOD["ONI"]

_NEAR_M, _FAR_M = 1.0, 6.0  # half the width, m, of an inset on a corner's error, and on a neighbourhood
_LETTERS = {"a": (2, (3, 1)), "b": (0, (-9, -9)), "c": (3, (-9, 1))}
"""Corner of each inset's square that its letter stands at, and how far from it (pt)."""

_ENI = "#3a3f44"  # ENI's outlines, where its own red is that of the correspondences


def _save_map(path: Path, record: Mapping[str, Any], measured: Measured) -> Caption | None:
    """Draw the optimised map over the truth, with three insets."""
    cameras = list(measured.matched)[-1]
    found = measured.matched[cameras].get("Opt")
    if found is None or not len(found.true):
        return None
    mapped = _mapped(record, found)
    error_cm = 100 * np.linalg.norm(found.errors_m, axis=2)
    mean_cm = error_cm.mean(axis=1)
    median, (worst, corner) = int(np.argsort(mean_cm)[len(mean_cm) // 2]), divmod(int(error_cm.argmax()), 4)
    insets = [
        (_crowd(mapped.mean(axis=1), _FAR_M), _FAR_M, "most markings together"),
        (mapped[median].mean(axis=0), _NEAR_M, f"a usual one, {mean_cm[median]:.1f} cm off"),
        (mapped[worst, corner], _NEAR_M, f"the worst corner, {error_cm.max():.1f} cm off"),
    ]
    lanes = [np.array(line) for line in record["lanes"].get("Opt", [])]
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
        site.set_title(f"{_drive_of(record)}: Opt, {cameras}, {len(mapped)} markings over the truth")
        site.plot([], [], color=style.ROUTE, lw=5, label="route")
        site.fill([], [], facecolor=style.PAINT, edgecolor=style.TRUTH, label="truth")
        site.fill([], [], facecolor=_OPT, edgecolor=_OPT, label="mapped marking")
        site.plot([], [], color=_LANE, lw=1.0, label="mapped lane line")
        fig.legend(handles=site.get_legend_handles_labels()[0], loc="outside lower center", ncols=4)
    median_cm, worst_cm = f"{mean_cm[median]:.1f}", f"{error_cm.max():.1f}"
    return {"drive": _drive_of(record), "cameras": cameras, "median": median_cm, "worst": worst_cm}


def _save_shift(path: Path, record: Mapping[str, Any], measured: Measured) -> Caption | None:
    """Draw ENI against ONI with corner correspondences."""
    cameras = list(measured.matched)[-1]
    before, after = (measured.matched[cameras].get(name) for name in ("ENI", "ONI"))
    if before is None or after is None:
        return None
    common, rows, columns = np.intersect1d(before.true, after.true, return_indices=True)
    if not len(common):
        return None
    eni, oni = _mapped(record, before)[rows], _mapped(record, after)[columns]
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
        site.set_title(f"{_drive_of(record)}: ENI against ONI, {cameras}")
        site.plot([], [], color=_ENI, label="ENI")
        site.plot([], [], color=style.METHOD["ONI"], label="ONI")
        site.plot([], [], color=LINK, ls=(0, (3, 2)), label="the same corner")
        site.fill([], [], facecolor=style.PAINT, edgecolor=style.TRUTH, label="truth")
        fig.legend(handles=site.get_legend_handles_labels()[0], loc="outside lower center", ncols=4)
    errors = {name: f"{error:.1f}" for name, error in zip(("eni", "oni"), error_cm, strict=True)}
    return {"drive": _drive_of(record), "cameras": cameras, "markings": len(common), **errors}


_Place = tuple[FloatArray, float, str]  # an inset: its centre (2,) and half its width, m, and its title


def _true_corners(record: Mapping[str, Any]) -> FloatArray:
    return np.array(record["truth"]["corners"]).reshape(-1, 4, 2)


def _mapped(record: Mapping[str, Any], found: Matched) -> FloatArray:
    return np.asarray(_true_corners(record)[found.true] + found.errors_m)


def _crowd(centres: FloatArray, half_m: float) -> FloatArray:
    """The centre (2,) with the most others within a square about it."""
    near = (np.abs(centres[:, None] - centres[None]).max(axis=2) < half_m).sum(axis=1)
    return np.asarray(centres[int(near.argmax())])


def _layout(record: Mapping[str, Any]) -> tuple[bool, float, float]:
    """Whether the insets stand below the site, which is much wider than high; its width and height."""
    extent_m = np.ptp(np.array(record["route"]), axis=0) + 2 * _BESIDE_M
    width_in, height_in = (_SITE_IN * extent_m / extent_m.max()).tolist()
    return extent_m[0] > _WIDE * extent_m[1], width_in, height_in


def _size_in(record: Mapping[str, Any], insets: int) -> tuple[float, float]:
    below, width, height = _layout(record)
    if below:
        return max(width, insets * _INSET_IN) + 0.6, height + _INSET_IN + 1.4
    return width + _INSET_IN + 1.4, max(height, insets * (_INSET_IN + 0.5)) + 0.8


def _axes(fig: Figure, record: Mapping[str, Any], insets: int) -> tuple[Axes, list[Axes]]:
    """The site with its route, and the axes of the insets."""
    below, width, height = _layout(record)
    if below:
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


def _draw_truth(axes: Axes, record: Mapping[str, Any]) -> None:
    paint: dict[str, Any] = {"facecolors": style.PAINT, "edgecolors": style.TRUTH, "lw": 0.4}
    axes.add_collection(PolyCollection(list(_true_corners(record)), zorder=1, **paint))
    lanes = [np.array(line) for line in record["true_lanes"]]
    axes.add_collection(LineCollection(lanes, colors=style.PAINT, lw=2.2, zorder=0.5))


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


def _save_calibration(path: Path, record: Mapping[str, Any], pictures: Path) -> Caption | None:
    cameras = record["cameras"]
    with style.figure(path, 13.0, 4.3 * len(cameras)) as fig:
        panels = fig.subplots(len(cameras), 2, squeeze=False, width_ratios=[1.5, 1])
        for row, (name, camera) in enumerate(cameras.items()):
            _draw_image(panels[row, 0], camera, pictures)
            _draw_ground(panels[row, 1], camera)
            panels[row, 0].set_title(f"{_drive_of(record)}, {name}: as clicked")
            panels[row, 1].set_title(f"{name}: as surveyed")
        panels[0, 1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    count = [len(camera["clicked_px"]) for camera in cameras.values() if camera["clicked_px"] is not None]
    started = sorted({camera["initial_ipm"] for camera in cameras.values()})
    return {"drive": _drive_of(record), "points": max(count, default=0), "started": " and ".join(started)}


def _draw_image(axes: Axes, camera: Mapping[str, Any], pictures: Path) -> None:
    image = cv2.imread(str(pictures / camera["picture"]))
    plain = dict(camera["info"])
    plain |= {"intrinsic": np.array(plain["intrinsic"]), "distortion": tuple(plain["distortion"])}
    info = CameraInfo(**plain)
    if image is not None:
        axes.imshow(image[..., ::-1])
    mounting, roi = (np.array(camera[key]) for key in ("true_cam_from_vehicle", "roi_vehicle"))
    for piece in project_outline(info, mounting, roi):
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


def _save_fields(path: Path, record: Mapping[str, Any]) -> Caption | None:
    """Draw the median residuals over the image, before and after."""
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
                panels[row, column].set_title(f"{_drive_of(record)}, {name}: {when}, {lengths[-1]}")
            changes.append(f"{name} from {lengths[0]} to {lengths[1]}")
    return {"drive": _drive_of(record), "changes": ", ".join(changes)}


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
    longest = float(np.linalg.norm(arrows, axis=1).max()) if arrows else 0.0
    span = _ARROW_SHARE * cell[0]
    look = {"width": 0.004, "color": LINK, "pivot": "mid"}
    style.draw_arrows(axes, np.array(places), np.array(arrows), longest, span, **look)


_BOX = "#7fb8b4"
_TOP_PERCENTILE = 99.5  # of the corner errors, where a panel ends: one bad corner would flatten the rest
_EQUAL_CM = (0.5, 1, 2, 5, 10, 20, 50, 100)


def _save_boxes(path: Path, firsts: Sequence[Measured]) -> Caption | None:
    """Draw the four corner errors of each marking and their running mean."""
    sets = list(dict.fromkeys(cameras for one in firsts for cameras in one.matched))
    beyond = 0
    with style.figure(path, 8.0 * len(firsts), 3.1 * len(sets)) as fig:
        panels = fig.subplots(len(sets), len(firsts), squeeze=False)
        for column, one in enumerate(firsts):
            for row, cameras in enumerate(sets):
                found = one.matched.get(cameras, {}).get("Opt")
                if found is None or not len(found.true):
                    panels[row, column].set_axis_off()
                    continue
                beyond += _draw_boxes(panels[row, column], found)
                panels[row, column].set_title(f"{one.title}: Opt, {cameras}, {len(found.true)} markings")
        drawn = next((axes for axes in panels.flat if axes.axison), None)
        if drawn is not None:
            fig.legend(handles=drawn.get_legend_handles_labels()[0], loc="outside lower center", ncols=3)
    return {"beyond": beyond}


def _draw_boxes(axes: Axes, found: Matched) -> int:
    """One panel; returns how many corners lie above it."""
    error_cm = 100 * np.linalg.norm(found.errors_m, axis=2)
    low, lower, upper, high = np.percentile(error_cm, [0, 25, 75, 100], axis=1)
    number = np.arange(1, len(error_cm) + 1)
    for bottom, top, width, tint, name in (
        (low, high, 0.7, _BOX, "least to largest"),
        (lower, upper, 2.6, _BOX, "quartiles"),
    ):
        lines = np.stack([np.column_stack([number, bottom]), np.column_stack([number, top])], axis=1)
        axes.add_collection(LineCollection(list(lines), colors=tint, lw=width))
        axes.plot([], [], color=tint, lw=width, label=name)
    mean = error_cm.mean(axis=1).cumsum() / number
    axes.plot(number, mean, color="#14302e", lw=1.8, label="running mean")
    axes.annotate(
        f"{mean[-1]:.1f} cm", (number[-1], mean[-1]), xytext=(4, 0), textcoords="offset points", va="center"
    )
    top = float(np.percentile(error_cm, _TOP_PERCENTILE))
    axes.set(xlim=(0, len(number) + 1), ylim=(0, 1.05 * top), axisbelow=True)
    axes.grid(axis="y", color=style.GRID)
    axes.set(xlabel="marking, in the order of the route", ylabel="corner error (cm)")
    return int((error_cm > 1.05 * top).sum())


def _save_growth(path: Path, records: Sequence[Mapping[str, Any]]) -> Caption | None:
    ports = list(dict.fromkeys(record["port"] for record in records))
    if not any(record["growth"] for record in records):
        return None
    with style.figure(path, 6.4 * len(ports), 4.6) as fig:
        panels = fig.subplots(1, len(ports), squeeze=False, sharey=True)[0]
        for axes, port in zip(panels, ports, strict=True):
            for record in records:
                if record["port"] == port:
                    for method, points in record["growth"].get(INCREMENTAL, {}).items():
                        counts, errors = np.array(points, dtype=np.float64).reshape(-1, 2).T
                        axes.plot(counts, 100 * errors, ms=5, lw=1.3, **style.line_of(method))
            style.set_logarithmic(axes, "y")
            style.set_logarithmic(axes, "x")
            axes.set(xlabel="markings mapped so far", ylabel="corner RMSE (cm)", axisbelow=True)
            axes.set_title(f"{port}: the error while the map grows")
        methods = dict.fromkeys(name for one in records for name in one["growth"].get(INCREMENTAL, {}))
        fig.legend(handles=_samples(methods, style.line_of), loc="outside lower center", ncols=5)
    return {}


def _save_ranges(path: Path, records: Sequence[Mapping[str, Any]]) -> Caption | None:
    known = [record for record in records if record.get("residuals")]
    if not known:
        return None
    ports = list(dict.fromkeys(record["port"] for record in known))
    cameras = list(dict.fromkeys(name for record in known for name in record["residuals"]))
    with style.figure(path, 5.6 * len(cameras), 4.0 * len(ports)) as fig:
        panels = fig.subplots(len(ports), len(cameras), squeeze=False, sharex=True, sharey=True)
        for row, port in enumerate(ports):
            for column, camera in enumerate(cameras):
                axes = panels[row, column]
                seen = [
                    r["residuals"][camera] for r in known if r["port"] == port and camera in r["residuals"]
                ]
                _draw_ranges(axes, [one["range"] for one in seen])
                style.set_logarithmic(axes, "y")
                axes.set(xlabel="distance of the corner from the camera (m)", axisbelow=True)
                axes.set(ylabel="error on the ground (cm)", title=f"{port}, {camera}")
        fig.legend(handles=_samples(style.MARKER, style.line_of), loc="outside lower center", ncols=4)
    return {}


def _draw_ranges(axes: Axes, found: Sequence[Mapping[str, Any]]) -> None:
    for method in style.MARKER:
        bins: dict[float, list[list[float]]] = {}
        for middle, *quartiles, _ in (one for range_ in found for one in range_.get(method, [])):
            bins.setdefault(middle, []).append(quartiles)
        if bins:
            middles = np.array(sorted(bins))
            lower, median, upper = 100 * np.array([np.mean(bins[m], axis=0) for m in middles]).T
            axes.plot(middles, median, ms=4, **style.line_of(method))
            axes.fill_between(middles, lower, upper, color=style.METHOD[method], alpha=0.13, lw=0)


def _save_balance(path: Path, measured: Sequence[Measured]) -> Caption | None:
    ports = by_port(measured)
    sets = list(dict.fromkeys(cameras for one in measured for cameras in one.rows))
    shown = ("CNI", "ENI", "Opt", "ONI", f"Opt, {PAPER}")
    with style.figure(path, 6.2 * len(ports), 0.8 + 3.6 * len(sets)) as fig:
        panels = fig.subplots(len(sets), len(ports), squeeze=False, sharex=True, sharey=True)
        for row, cameras in zip(panels, sets, strict=True):
            for axes, (port, drives) in zip(row, ports.items(), strict=True):
                for name in shown:
                    found = [one.rows[cameras][name] for one in drives if name in one.rows.get(cameras, {})]
                    pairs = [(one.spread_m, one.bias_m) for one in found if one.spread_m > 0]
                    axes.plot(*(100 * np.array(pairs).reshape(-1, 2).T), **_sign(name))
                style.set_logarithmic(axes, "x")
                style.set_logarithmic(axes, "y")
                axes.set(title=f"{port}, {cameras}", axisbelow=True)
        for axes in panels[:, 0]:
            axes.set_ylabel("bias (cm)")
        for axes in panels[-1]:
            axes.set_xlabel("spread of the corner errors (cm)")
        _equal_errors(list(panels.flat))
        drawn = {name for one in measured for rows in one.rows.values() for name in rows}
        handles = _samples((name for name in shown if name in drawn), _sign)
        handles.append(Line2D([], [], color=style.TRUTH, ls=":", label="equal RMSE"))
        fig.legend(handles=handles, loc="outside lower center", ncols=6)
    return {}


def _samples(names: Iterable[str], look: Callable[[str], dict[str, Any]]) -> list[Line2D]:
    return [Line2D([], [], label=name, **look(name)) for name in names]


def _sign(row: str) -> dict[str, Any]:
    """Keywords of a row of the tables, such as ``Opt, paper``, drawn as single points."""
    method = row.split(",")[0]
    colour = style.METHOD[method]
    face = "white" if PAPER in row else colour
    return {"lw": 0, "marker": style.MARKER[method], "color": colour, "mfc": face, "ms": 7}


def _equal_errors(panels: Sequence[Axes]) -> None:
    """Dotted lines of equal RMSE within the limits that the points have set."""
    for axes in panels:
        (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
        for value in _EQUAL_CM:
            spread = np.geomspace(left, min(value * 0.99999, right), 200) if left < value else np.empty(0)
            bias = np.sqrt(value**2 - spread**2)
            inside = (bias >= bottom) & (bias <= top)
            if inside.sum() > 1:
                axes.plot(spread[inside], bias[inside], ":", color=style.TRUTH, lw=1, zorder=0)
                axes.annotate(
                    f"{value:g}", (spread[inside][0], bias[inside][0]), color=style.TRUTH, fontsize=8,
                    xytext=(2, -9), textcoords="offset points",
                )  # fmt: skip
        axes.set(xlim=(left, right), ylim=(bottom, top))
