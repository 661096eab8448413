"""Markings labelled as polygons in COCO's format (Lin et al., "Microsoft COCO", 2014; instances JSON)."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from train.config import DataConfig, LabelError
from train.labels_image import LabelledImage, Shape
from v2hdm.catalogue import NOT_PAINT, PAINT_CLASSES
from v2hdm.records import FloatArray
from v2hdm.safe.texts import read_json, shown
from v2hdm.store.files import load_json

EITHER = "|"
"""Stands between classes of which a category is one, nobody knows which."""

UNKNOWN = "unknown"
"""The category of ground of which nothing is known."""

_HALF_PX = 0.5
"""COCO counts from the top-left pixel's corner, this project from its centre."""


def read_coco(
    path: Path, images: Path, config: DataConfig, own_classes: Sequence[str] = PAINT_CLASSES
) -> list[LabelledImage]:
    """Every image of a COCO file; those without annotations are images without markings.

    Args:
        path: the JSON file.
        images: the folder that its ``file_name`` entries start from.
        config: what its categories mean, see ``coco_classes``, and at which size its images are shown.
        own_classes: the classes.

    Raises:
        LabelError: the file is missing or damaged, or uses a category that is not known.
    """
    content = load_json(path, LabelError)
    names = {
        entry["id"]: str(entry["name"]) for entry in _entries(content, "categories", ("id", "name"), path)
    }
    shapes: dict[Any, list[Shape]] = {}
    entries = _entries(content, "images", ("id", "file_name"), path)
    for entry in entries:
        if entry["id"] in shapes:
            raise LabelError(f"{path}: two images have the id {entry['id']}; give each its own")
        shapes[entry["id"]] = []
    category_of = _relabelled(config.coco_relabel)
    kinds = _kinds((*names.values(), *config.coco_relabel), config.coco_classes, own_classes, path)
    shown_size = None if config.coco_size is None else (config.coco_size[0], config.coco_size[1])
    scales = {entry["id"]: _scale(entry, shown_size, path) for entry in entries}
    for number, entry in enumerate(
        _entries(content, "annotations", ("image_id", "category_id", "segmentation"), path)
    ):
        where = f"{path}: annotation {entry.get('id', number)}"
        _check_references(entry, names, shapes, where)
        # What COCO calls a crowd is of no score there: nobody knows what of it is one of the category.
        unsure = bool(entry.get("iscrowd"))
        category = category_of.pop(entry.get("id"), names[entry["category_id"]])
        kind = (UNKNOWN,) if unsure else _kind(category, kinds, own_classes, where)
        if kind != (NOT_PAINT,):
            rings = _rings(entry["segmentation"], where, scales[entry["image_id"]])
            shapes[entry["image_id"]].append(Shape(kind, rings))
    if category_of:
        number, category = next(iter(category_of.items()))
        raise LabelError(
            f"{config.coco_relabel[category]}: {path} has no annotation {shown(number)}; list its own"
        )
    if not entries:
        raise LabelError(f"{path}: has no images; give another file")
    return [
        LabelledImage(
            f"{path}: image {entry['id']}",
            images / str(entry["file_name"]),
            _size(entry),
            shapes=tuple(shapes[entry["id"]]),
            shown_size=shown_size,
            edge_px=config.coco_edge_px,
        )
        for entry in entries
    ]


def _check_references(
    entry: Mapping[str, Any], categories: Container[Any], images: Container[Any], where: str
) -> None:
    if entry["category_id"] not in categories:
        raise LabelError(f"{where}: its category {shown(entry['category_id'])} is not in the file; add it")
    if entry["image_id"] not in images:
        raise LabelError(f"{where}: its image {shown(entry['image_id'])} is not in the file; add it")


def _relabelled(files: Mapping[str, str]) -> dict[Any, str]:
    """The category that each annotation of some lists is of, by its id."""
    category_of: dict[Any, str] = {}
    for category, name in files.items():
        content = read_json(Path(name), LabelError)
        ids = content.get("annotations") if isinstance(content, dict) else content
        if not isinstance(ids, list) or not all(isinstance(number, int | str) for number in ids):
            raise LabelError(f'{name}: is no list of ids of annotations; write {{"annotations": [3, 17]}}')
        for number in ids:
            if category_of.setdefault(number, category) != category:
                raise LabelError(
                    f"{name}: annotation {shown(number)} is to be {category}, but "
                    f"{files[category_of[number]]} says {category_of[number]}; take it out of one"
                )
    return category_of


def _kinds(
    names: Sequence[str], classes: Mapping[str, str], own_classes: Sequence[str], path: Path
) -> dict[str, tuple[str, ...]]:
    """The classes that each category may be, complete with the names that are classes."""
    for name, kind in classes.items():
        if name not in names:
            raise LabelError(
                f"data.coco_classes: {path} has no category {shown(name)}, only {', '.join(names)}; list its "
                f"annotations in data.coco_relabel, or drop it: '~data.coco_classes.{name}'"
            )
        for name_of_class in kind.split(EITHER):
            if name_of_class not in (*own_classes, NOT_PAINT, UNKNOWN):
                raise LabelError(
                    f"data.coco_classes: {shown(name)} is to be {shown(name_of_class)}; choose from: "
                    f"{', '.join(own_classes)}, {NOT_PAINT}, {UNKNOWN}"
                )
    alike = {name: name.strip().lower().replace(" ", "_").replace("-", "_") for name in names}
    by_name = {kind.lower(): (kind,) for kind in own_classes}
    mapped = {name: tuple(kind.split(EITHER)) for name, kind in classes.items()}
    return {name: by_name[kind] for name, kind in alike.items() if kind in by_name} | mapped


def _kind(
    name: str, kinds: Mapping[str, tuple[str, ...]], own_classes: Sequence[str], where: str
) -> tuple[str, ...]:
    if name not in kinds:
        raise LabelError(
            f"{where}: category {shown(name)} is no class of the detector; say which it is with "
            f"'+data.coco_classes={{{name}: CLASS}}', CLASS one of: {', '.join(own_classes)}, "
            f"{NOT_PAINT}, {UNKNOWN}"
        )
    return kinds[name]


def _rings(segmentation: object, where: str, scale: FloatArray) -> tuple[FloatArray, ...]:
    if not isinstance(segmentation, list) or not segmentation:
        raise LabelError(f"{where}: its segmentation is no list of polygons (masks are not); export polygons")
    rings = []
    for polygon in segmentation:
        try:
            ring = np.array(polygon, dtype=np.float64).reshape(-1, 2) * scale - _HALF_PX
        except (TypeError, ValueError):
            raise LabelError(f"{where}: a polygon is not x, y, x, y, ...; mend it") from None
        if len(ring) < 3 or not np.isfinite(ring).all():
            raise LabelError(f"{where}: a polygon has under three points, or one not finite; mend it")
        rings.append(ring)
    return tuple(rings)


def _scale(entry: Mapping[str, Any], shown_size: tuple[int, int] | None, path: Path) -> FloatArray:
    """By how much (2,) an image is stretched before it is shown."""
    if shown_size is None:
        return np.ones(2)
    size = _size(entry)
    if size is None or min(size) < 1:
        raise LabelError(
            f"{path}: image {entry['id']} states no width and height, so data.coco_size cannot undo its "
            "aspect; add them"
        )
    return np.array(shown_size) / size


def _size(entry: Mapping[str, Any]) -> tuple[int, int] | None:
    width = entry.get("width")
    height = entry.get("height")
    return (width, height) if isinstance(width, int) and isinstance(height, int) else None


def _entries(
    content: Mapping[str, Any], key: str, needed: tuple[str, ...], path: Path
) -> list[dict[str, Any]]:
    """The list of objects under a key, each with the keys that are needed."""
    entries = content.get(key)
    if not isinstance(entries, list):
        raise LabelError(f"{path}: has no list {shown(key)}; is it a COCO instances file?")
    for number, entry in enumerate(entries):
        missing = [name for name in needed if not isinstance(entry, dict) or name not in entry]
        if missing:
            raise LabelError(f"{path}: {key}[{number}] has no {shown(missing[0])}; add it")
        for name in {"id", "image_id", "category_id"} & set(needed):
            if not isinstance(entry[name], int | str):
                raise LabelError(
                    f"{path}: {key}[{number}]: {name}: expected a number, got {shown(entry[name])}"
                )
    return entries
