"""One drive of an experiment: read or rendered, detected, mapped by every recipe, held against the truth.

Everything that tables, figures and text need of it is kept as plain content, a file for each recipe, so that
a finished drive is never opened again. Files are gzipped JSON, whose numbers come back exactly, under the key
of all that they were made from. A file of another key, or a damaged one, counts as absent.
"""

from __future__ import annotations

import gzip
import json
import shutil
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import AdjustError, MappingError
from v2hdm.experiment.measures import residuals
from v2hdm.experiment.plan import OURS, Job
from v2hdm.geometry.ipm import extrinsic_from_ipm
from v2hdm.io.drive import read_drive
from v2hdm.io.drive.truth import read_truth
from v2hdm.mapping.methods import NAIVE_IPMS, run_methods
from v2hdm.mapping.results import MethodResult
from v2hdm.pipeline.camera_sets import camera_sets
from v2hdm.pipeline.context import Context
from v2hdm.pipeline.detections import detect_in_pieces
from v2hdm.pipeline.evaluate import growth_of
from v2hdm.pipeline.inspect import Inspection, inspect_each
from v2hdm.pipeline.keys import Contents, model_key
from v2hdm.progress import Progress
from v2hdm.records import Drive, ImageDetections, Marking, Truth
from v2hdm.report.metrics import driven_past, extrinsic_metrics
from v2hdm.simulate import rendered_drive, surveyed_cameras
from v2hdm.store.cache import StageCache, code_key, key_of
from v2hdm.store.files import file_digest, whole_file

_FASTEST = 1  # level of gzip: a fifth of the size already, at a tenth of the time of the default


def store(path: Path, key: str, content: Mapping[str, Any]) -> None:
    """Write plain content (lists, numbers, texts, arrays) under a key, whole or not at all."""
    text = json.dumps({"key": key, "content": content}, default=lambda value: value.tolist())
    with whole_file(path) as partial:
        partial.write_bytes(gzip.compress(text.encode(), _FASTEST))


def stored(path: Path, key: str) -> dict[str, Any] | None:
    """The content of a file of :func:`store`; None where there is none of this key."""
    try:
        found = json.loads(gzip.decompress(path.read_bytes()))
        content: dict[str, Any] | None = found["content"] if found["key"] == key else None
    except (OSError, EOFError, zlib.error, ValueError, KeyError, TypeError):
        return None
    return content


SETTING_FILE = "drive.json.gz"


def setting_key(job: Job) -> str:
    """The key of what a drive is before it is mapped."""
    path = job.site.drive.path
    return key_of(code_key(), job.site, _content(Path(path)) if path else None)


def recipe_key(job: Job, recipe: str) -> str:
    """The key of all that a drive's maps under a recipe are made from."""
    return key_of(setting_key(job), job.detector, model_key(job.detector), job.options[recipe])


@cache
def _content(drive: Path) -> list[tuple[str, str]]:
    """The files of a drive, or one, and the digests of what they hold."""
    files = sorted(path for path in [drive, *drive.rglob("*")] if path.is_file())
    return [(path.relative_to(drive).as_posix(), file_digest(path)) for path in files]


def recipe_file(recipe: str) -> str:
    """Name of the file with a drive's maps under a recipe."""
    return f"{recipe}.json.gz"


def drive_record(job: Job, workers: int, progress: Progress) -> dict[str, Any]:
    """The record of a drive and of its maps, from disk or made now and kept there.

    ``workers`` are processes to render and detect in; 1 stays in this one. Raises V2hdmError where the drive
    cannot be rendered, read or looked at, or has no truth.
    """
    known = _kept(job)
    if known is None:
        _find(job, workers, progress)
        known = _kept(job)
    assert known is not None
    progress("finished", 1, 1)
    return known


def _kept(job: Job) -> dict[str, Any] | None:
    """One record of a drive and of its maps under all recipes, from disk; None where something is missing."""
    setting = stored(job.folder / SETTING_FILE, setting_key(job))
    kept = {name: stored(job.folder / recipe_file(name), recipe_key(job, name)) for name in job.options}
    maps = {recipe: found for recipe, found in kept.items() if found is not None}
    if setting is None or len(maps) < len(kept):
        return None
    return {
        **setting,
        "maps": {
            name: {row: one for found in maps.values() for row, one in found["maps"].get(name, {}).items()}
            for name in setting["expected"]
        },
        "growth": {recipe: found["growth"] for recipe, found in maps.items() if found["growth"]},
        "extrinsics": {recipe: found["extrinsics"] for recipe, found in maps.items()},
        "failures": [[recipe, *one] for recipe, found in maps.items() for one in found["failures"]],
        "lanes": maps[OURS]["lanes"],
        "residuals": maps[OURS]["residuals"],
    }


def _find(job: Job, workers: int, progress: Progress) -> None:
    """Open the drive, and map it by those recipes whose maps are missing."""
    if job.site.simulate is not None:
        folder = rendered_drive(job.site.simulate, job.cache, workers, partial(progress, "render"))
    else:
        folder = Path(job.site.drive.path or "")
    drive = read_drive(folder, job.site.drive)
    truth = read_truth(drive)
    store(job.folder / SETTING_FILE, setting_key(job), _setting(job, drive, truth))
    cache, contents = StageCache(job.cache), Contents.of([drive])
    context = Context(cache, progress, workers=workers)
    with cache.in_use():
        (inspection,) = inspect_each([drive], contents, job.site.drive.max_gap_s, context)
        detections = detect_in_pieces(inspection.drive, contents, job.detector, context)
    for recipe in job.options:
        path, key = job.folder / recipe_file(recipe), recipe_key(job, recipe)
        if stored(path, key) is None:
            store(path, key, _mapped(job, recipe, inspection, detections, truth, progress))


def _setting(job: Job, drive: Drive, truth: Truth) -> dict[str, Any]:
    job.folder.mkdir(parents=True, exist_ok=True)
    sets = camera_sets(drive)
    manual = {} if job.site.simulate is None else surveyed_cameras(job.site.simulate)
    cameras = {}
    for name, camera in drive.cameras.items():
        images = [image for image in drive.images if image.camera == name]
        if not images:
            continue
        picture = f"{name}{images[len(images) // 2].path.suffix}"
        with whole_file(job.folder / picture) as partial_file:
            shutil.copyfile(images[len(images) // 2].path, partial_file)
        clicks = manual[name][1] if name in manual else None
        cameras[name] = {
            "picture": picture,
            "info": asdict(camera.info),
            "roi_vehicle": camera.roi_vehicle,
            "initial_ipm": camera.initial_ipm,
            "ipm": dict(camera.ipm),
            "true_cam_from_vehicle": truth.cam_from_vehicle[name],
            "clicked_px": None if clicks is None else clicks.clicked_px,
            "surveyed_vehicle": None if clicks is None else clicks.surveyed_vehicle,
        }
    return {
        "port": job.port,
        "seed": job.seed,
        "cameras": cameras,
        "truth": _plain_map(truth.map.markings),
        "true_lanes": [lane.points_map for lane in truth.map.lanes],
        "route": np.array([image.map_from_vehicle[:2, 3] for image in drive.images]),
        "expected": {name: driven_past(drive, truth, members) for name, members in sets.items()},
    }


def _mapped(
    job: Job,
    recipe: str,
    inspection: Inspection,
    detections: Sequence[ImageDetections],
    truth: Truth,
    progress: Progress,
) -> dict[str, Any]:
    """Maps, growth and extrinsics of a drive under a recipe; under ours residuals, too."""
    drive = inspection.drive
    sets = camera_sets(drive)
    out: dict[str, Any] = {
        "maps": {}, "growth": {}, "extrinsics": {}, "failures": [], "lanes": {}, "residuals": {},
    }  # fmt: skip
    for done, (name, members) in enumerate(sets.items()):
        progress(f"map, {recipe}", done, len(sets))
        last = name == list(sets)[-1]
        try:
            methods = run_methods(drive, detections, members, job.options[recipe])
        except (MappingError, AdjustError) as failure:
            out["failures"].append([name, str(failure)])
            continue
        # Under other recipes than ours the naive methods give the same maps again.
        rows = {
            method if recipe == OURS else f"{method}, {recipe}": result
            for method, result in methods.items()
            if recipe == OURS or method not in NAIVE_IPMS
        }
        out["maps"][name] = {row: _plain_map(one.hd_map.markings) for row, one in rows.items()}
        out["extrinsics"][name] = _extrinsics(drive, methods, truth)
        if last:
            grown = {name: methods[name] for name in ("Opt", *NAIVE_IPMS) if name in methods}
            out["growth"] = growth_of(grown, truth)
        if last and recipe == OURS:
            out["lanes"] = {"Opt": [lane.points_map for lane in methods["Opt"].hd_map.lanes]}
            out["residuals"] = residuals(inspection.drive_as_described, detections, methods, truth)
    progress(f"map, {recipe}", len(sets), len(sets))
    return out


def _plain_map(markings: Sequence[Marking]) -> dict[str, Any]:
    return {
        "kinds": [marking.kind for marking in markings],
        "corners": [marking.corners_map for marking in markings],
        "sightings": [marking.sightings for marking in markings],
    }


def _extrinsics(drive: Drive, methods: Mapping[str, MethodResult], truth: Truth) -> dict[str, Any]:
    """By camera and method, how far the extrinsic is from the truth: deg and m."""
    out: dict[str, Any] = {}
    for name, found in methods["Opt"].calibrations.items():
        camera, true = drive.cameras[name], truth.cam_from_vehicle[name]
        poses = {"Opt": found.cam_from_vehicle}
        for method, ipm in NAIVE_IPMS.items():
            if ipm in camera.ipm:
                poses[method] = extrinsic_from_ipm(camera.info, camera.ipm[ipm])
        out[name] = {method: asdict(extrinsic_metrics(pose, true)) for method, pose in poses.items()}
    return out
