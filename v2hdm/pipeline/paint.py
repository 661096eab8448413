"""Mapped paint in the images: how much of each marking is left, and what words say."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from v2hdm.detection.frames import read_image
from v2hdm.io.maps.corrections import Correction
from v2hdm.mapping.results import MethodResult
from v2hdm.pipeline.context import Context
from v2hdm.pipeline.stages import MappedSet
from v2hdm.records import BEST, TEXT, Drive, HDMap, Image
from v2hdm.site.corrections import with_paint_of_added
from v2hdm.site.living.changes import Base
from v2hdm.site.living.wear import Footage, with_wear

_log = logging.getLogger(__name__)


def with_paint(
    sets: Mapping[str, MappedSet],
    drive: Drive,
    earlier: Base | None,
    corrections: Sequence[Correction],
    context: Context,
) -> dict[str, MappedSet]:
    """The same with the paint that is left of each marking of the best map, and what its words say.

    By their paint, the markings that a person added are compared with the images.
    """
    name, last = list(sets.items())[-1]
    best = last.methods[BEST]
    if best.poses is None or best.residuals is None or not drive.has_pictures:
        return dict(sets)
    poses = [best.poses.of_image(image) for image in drive.images]
    ground = None if best.surface is None else best.surface.seen_from(np.array(poses))
    footage = Footage(drive.images, poses, best.calibrations, ground)
    with context.timed("wear"):
        hd_map = _with_wear(best, footage, drive, earlier, context)
    if any(symbol.kind == TEXT for symbol in hd_map.symbols):
        with context.timed("words"):
            hd_map = _with_words(hd_map, footage, drive, context)
    heard = with_paint_of_added(best.heard, corrections, hd_map.markings)
    methods = {**last.methods, BEST: replace(best, hd_map=hd_map, heard=heard)}
    return {**sets, name: replace(last, methods=methods)}


def _with_wear(
    best: MethodResult, footage: Footage, drive: Drive, earlier: Base | None, context: Context
) -> HDMap:
    """The best map with the paint that is left of each marking."""
    before = None if earlier is None else earlier.hd_map
    assert best.residuals is not None
    index = {drive.name_of(image.path): k for k, image in enumerate(drive.images)}
    number_of_id = {
        number + 1 if marking.id is None else marking.id: number
        for number, marking in enumerate(best.hd_map.markings)
    }
    shown = {
        (index[image], number_of_id[marking_id])
        for image, marking_id in best.residuals.whole_views()
        if marking_id in number_of_id
    }
    # Nothing was detected of what a person added: every image may show it.
    unseen = [number for number, marking in enumerate(best.hd_map.markings) if not marking.sightings]
    shown |= {(image, number) for image in range(len(drive.images)) for number in unseen}
    return with_wear(best.hd_map, footage, _colours(drive), shown, before, context.threads)


def _with_words(hd_map: HDMap, footage: Footage, drive: Drive, context: Context) -> HDMap:
    """The map with what its words say, where the extra is installed that reads them."""
    from v2hdm.words.reading import with_readings
    from v2hdm.words.recogniser import MISSING, load_recogniser

    recogniser = load_recogniser(context.threads)
    if recogniser is None:
        _log.warning("%s", MISSING)
        return hd_map
    return with_readings(hd_map, footage, drive.cameras, _light(drive), recogniser, context.threads)


def _colours(drive: Drive) -> Callable[[Image], NDArray[np.uint8]]:
    """Reads the colours (H, W, 3) of an image."""
    return lambda image: read_image(image, drive.cameras[image.camera])


def _light(drive: Drive) -> Callable[[Image], NDArray[np.float32]]:
    """Reads the brightest of the three colours of each pixel: on pale concrete yellow paint has one."""

    def light(image: Image) -> NDArray[np.float32]:
        colours = read_image(image, drive.cameras[image.camera])
        return np.asarray(colours.max(axis=2), dtype=np.float32)

    return light
