"""Whether a map lives: two drives together, and an earlier map brought up to date once paint was altered.

``python -m tests.benchmarks.living_map [--full] [--base FOLDER] [--cache FOLDER] [--workers N]`` renders port
2 three times: a drive, another drive through it, and one after markings were moved by 10 cm to 1 m, removed
and painted anew. It maps the first two alone and together, brings the map of the first up to date by the
second and by the third, and prints corner errors against ground truth, how many ids stayed, and what
alterations are listed. The route is short and four markings of each kind are altered, unless ``--full``
drives all of port 2, with twelve. ``--base`` takes the first drive's map from the results of
``v2hdm.map +run=port2`` and leaves the second drive out.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from omegaconf import OmegaConf

from tests.benchmarks.made.altered import Alteration, altered
from v2hdm.detection.batch import detect_all
from v2hdm.detection.options import DetectorOptions
from v2hdm.executor import HERE, open_executor
from v2hdm.io.drive import join_drives, read_drive
from v2hdm.io.drive.truth import read_truth
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.maps.reading import read_geojson
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.results import MethodResult
from v2hdm.pipeline.base import grey_reader, read_base
from v2hdm.records import Change, Drive, Fate, FloatArray, HDMap, ImageDetections, Truth
from v2hdm.report.metrics import corner_errors, driven_past, marking_metrics, match_markings
from v2hdm.simulate.port.build import build_port
from v2hdm.simulate.port.config import PortConfig, RouteConfig, YardConfig
from v2hdm.simulate.port.drive import rendered_drive
from v2hdm.site.living.changes import Base

CACHE = Path("~/.cache/v2hdm/living").expanduser()

SAME_M = 0.25
"""A change is listed where it is if its centre lies nearer than this."""

Seen = tuple[Drive, list[ImageDetections]]


def port(full: bool, session: int) -> PortConfig:
    """Port 2, or a short way through its yard."""
    run = OmegaConf.load(Path(__file__).parents[2] / "conf/run/port2.yaml").simulate
    config = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(PortConfig), run))
    assert isinstance(config, PortConfig)
    config = replace(config, session=session)
    if full:
        return config
    route = RouteConfig(pieces=[[30.0, 0.0], [23.0, -90.0], [25.0, 0.0]])
    yard = replace(config.yard, parked_trucks=2, barriers=2, moving_trucks=1, shadow_strips=4)
    assert isinstance(yard, YardConfig)
    return replace(config, name="port2-short", route=route, yard=yard)


def detected(config: PortConfig, cache: Path, workers: int) -> Seen:
    """A drive and its detections."""
    with open_executor(workers) as executor:
        drive = read_drive(rendered_drive(config, cache, executor, lambda _, __: None))
        drive = replace(drive, name=f"{drive.name} {config.session}")
        return drive, detect_all(drive, DetectorOptions.for_mapping(), executor)


def mapped(drive_seen: Seen, base: Base | None = None) -> MethodResult:
    """The optimised map by all cameras."""
    drive, detections = drive_seen
    methods = run_methods(drive, detections, tuple(drive.cameras), base=base, grey=grey_reader(drive))
    return methods["Opt"]


def together(drives: Sequence[Seen]) -> Seen:
    """Drives as sessions of one."""
    detections: list[ImageDetections] = []
    for drive, in_images in drives:
        before = sum(len(earlier.images) for earlier, _ in drives[: [d for d, _ in drives].index(drive)])
        detections += [replace(in_image, image=in_image.image + before) for in_image in in_images]
    return join_drives([drive for drive, _ in drives]), detections


def told(name: str, hd_map: HDMap, truth: Truth, drive: Drive) -> float:
    """Print how good a map is; returns its corner RMSE, m."""
    figures = marking_metrics(hd_map, truth, driven_past(drive, truth, tuple(drive.cameras)))
    print(
        f"{name}: {figures.markings} markings, recall {figures.recall:.3f}, {figures.false_markings} false, "
        f"corners {100 * figures.corner_rmse_m:.2f} cm off, bias {100 * figures.corner_bias_m:.2f} cm",
        flush=True,
    )
    return figures.corner_rmse_m


def base_of(result: MethodResult) -> Base:
    """A result as an earlier map, by way of its file."""
    with TemporaryDirectory() as folder:
        write_geojson(result.hd_map, Path(folder) / "map.geojson")
        hd_map = read_geojson(Path(folder) / "map.geojson")
    assert result.poses is not None
    left_out = tuple(
        (candidate.kind, candidate.position_map, candidate.sightings) for candidate in result.excluded
    )
    return Base(hd_map, result.poses.map_from_vehicle, left_out)


def ids_kept(before: HDMap, after: HDMap, truth: Truth) -> str:
    """How many of the true markings that both maps have are of one id in both, in words."""
    ids = []
    for hd_map in (before, after):
        rows, columns = match_markings(hd_map.markings, truth.map.markings)
        ids.append({column: hd_map.markings[row].id for row, column in zip(rows, columns, strict=True)})
    common = ids[0].keys() & ids[1].keys()
    return f"{sum(ids[0][k] == ids[1][k] for k in common)} of {len(common)} ids stayed"


def at(corners: FloatArray | None, other: FloatArray | None) -> bool:
    """Whether two outlines, or two absences, are one."""
    if corners is None or other is None:
        return corners is None and other is None
    return bool(np.linalg.norm(corners.mean(axis=0) - other.mean(axis=0)) < SAME_M)


def _is_same(alteration: Alteration, change: Change) -> bool:
    return at(alteration.before, change.before) and at(alteration.after, change.after)


def tell_changes(changes: Sequence[Change], alterations: Sequence[Alteration], base: HDMap) -> None:
    """Print which alterations are listed, and what else is."""
    known_corners = [marking.corners_map for marking in base.markings]
    for fate, is_of_fate in (
        (Fate.MOVED, lambda alteration: alteration.before is not None and alteration.after is not None),
        (Fate.VANISHED, lambda alteration: alteration.after is None),
        (Fate.NEW, lambda alteration: alteration.before is None),
    ):
        own_alterations = [alteration for alteration in alterations if is_of_fate(alteration)]
        listed = [change for change in changes if change.fate is fate]
        right = [
            alteration
            for alteration in own_alterations
            if any(_is_same(alteration, change) for change in listed)
        ]
        others = [
            change
            for change in listed
            if not any(_is_same(alteration, change) for alteration in own_alterations)
        ]
        unknown = [
            alteration
            for alteration in own_alterations
            if alteration.before is not None and not any(at(alteration.before, k) for k in known_corners)
        ]
        print(
            f"{fate.value}: {len(right)} of {len(own_alterations)} listed "
            f"({len(unknown)} were not in the earlier map), {len(others)} others: "
            + "; ".join(f"{c.id} {c.kind} p {c.probability:.2f} {c.views_showing}/{c.views}" for c in others)
        )
        for alteration in own_alterations:
            if not any(alteration is other for other in right):
                corners = alteration.before if alteration.after is None else alteration.after
                assert corners is not None
                changes_near = [
                    c for c in changes if any(at(x, corners) for x in (c.before, c.after) if x is not None)
                ]
                fates = ", ".join(
                    f"{c.fate.value} p {c.probability:.2f} {c.views_showing}/{c.views}" for c in changes_near
                )
                x, y = corners.mean(axis=0)
                print(f"   missed at ({x:.1f}, {y:.1f}): {fates or 'nothing listed'}")


def common_rmse_m(hd_map: HDMap, others: Sequence[HDMap], truth: Truth) -> float:
    """Corner RMSE, m, over the true markings that all of the maps have."""
    columns = [
        set(match_markings(compared.markings, truth.map.markings)[1]) for compared in (hd_map, *others)
    ]
    shared = set.intersection(*columns)
    pairs = [
        (row, column)
        for row, column in zip(*match_markings(hd_map.markings, truth.map.markings), strict=True)
        if column in shared
    ]
    errors = corner_errors([hd_map.markings[r] for r, _ in pairs], [truth.map.markings[c] for _, c in pairs])
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


def two_drives(arguments: argparse.Namespace) -> Base:
    """Map two drives alone and together; returns the map of the first."""
    first = detected(port(arguments.full, 0), arguments.cache, arguments.workers)
    truth = read_truth(first[0])
    of_first = mapped(first)
    told("first drive", of_first.hd_map, truth, first[0])
    base = base_of(of_first)
    second = detected(port(arguments.full, 1), arguments.cache, arguments.workers)
    of_second = mapped(second)
    of_both = mapped(together([first, second]))
    updated = mapped(second, base)
    maps = {
        "second drive": of_second.hd_map,
        "both in one adjustment": of_both.hd_map,
        "first map brought up to date by the second drive": updated.hd_map,
    }
    for name, hd_map in maps.items():
        told(name, hd_map, truth, first[0])
    every = [of_first.hd_map, *maps.values()]
    rmse_m = [common_rmse_m(hd_map, every, truth) for hd_map in every]
    better = min(rmse_m[:2])
    print(
        "over the markings that all have: "
        + ", ".join(f"{100 * rmse:.2f} cm" for rmse in rmse_m)
        + f"; of the better drive alone {rmse_m[2] / better:.2f} (both), {rmse_m[3] / better:.2f} (update)"
    )
    assert updated.changes is not None
    print(ids_kept(base.hd_map, updated.hd_map, truth))
    tell_changes(updated.changes.changes, (), base.hd_map)
    return base


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--base", type=Path)
    parser.add_argument("--cache", type=Path, default=CACHE)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    arguments = parser.parse_args()
    count = 12 if arguments.full else 4
    base = two_drives(arguments) if arguments.base is None else read_base(arguments.base)
    config = port(full=arguments.full, session=1 if arguments.full else 2)
    config = replace(config, name=f"{config.name}-altered")
    with altered(count, config.seed) as alterations:  # in this process alone, which renders them
        build_port(config)
        rendered_drive(config, arguments.cache, HERE, lambda _, __: None)
    third = detected(config, arguments.cache, arguments.workers)
    renewed = mapped(third, base)
    assert renewed.changes is not None
    told("first map after the paint was altered", renewed.hd_map, read_truth(third[0]), third[0])
    print(ids_kept(base.hd_map, renewed.hd_map, read_truth(third[0])))
    tell_changes(renewed.changes.changes, alterations, base.hd_map)


if __name__ == "__main__":
    main()
