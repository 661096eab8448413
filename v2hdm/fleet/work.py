"""What runs on the workers: detection in batches by actors that keep the model, and one drive's mapping."""

from __future__ import annotations

import os
import time
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import cv2
import ray
from ray.exceptions import RayActorError, RayTaskError

from v2hdm import pipeline
from v2hdm.detection.batch import detect_image, with_own_vehicle
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.door import told
from v2hdm.errors import WorkerError
from v2hdm.fleet.finished import finish, metrics_of
from v2hdm.fleet.plan import Job
from v2hdm.fleet.rows import Row
from v2hdm.records import Drive, ImageDetections

IMAGES_A_BATCH = 8
"""Images that an actor looks at in one call: seconds of work against a millisecond of Ray's."""

_BATCHES_AHEAD = 2
"""Calls that wait at each actor, so that it is never idle between them."""

_DRIVES_KEPT = 4
_TELL_EVERY_S = 0.5


class Eyes:
    """An actor that detects: its model stays loaded, and so do the drives that it has seen last."""

    def __init__(self, folder: str) -> None:
        """``folder`` is where relative paths begin."""
        os.chdir(folder)
        cv2.setNumThreads(1)
        self._detectors: dict[str, Detector] = {}
        self._drives: dict[str, Drive] = {}

    def detect(
        self, drive: Sequence[Any], options: DetectorOptions, images: Sequence[int]
    ) -> list[ImageDetections]:
        """What is in some ``images`` of a drive, given by a reference within a list: it is fetched once."""
        (reference,) = drive
        key = reference.hex()
        if key not in self._drives:
            while len(self._drives) >= _DRIVES_KEPT:
                self._drives.pop(next(iter(self._drives)))
            self._drives[key] = ray.get(reference)
        known = repr(options)
        if known not in self._detectors:
            self._detectors = {known: Detector.load(options=options)}
        return [detect_image(self._detectors[known], self._drives[key], index) for index in images]


class Board:
    """An actor that takes what the drives tell of their progress."""

    def __init__(self) -> None:
        self._told: dict[tuple[str, str], tuple[int, int]] = {}

    def tell(self, drive: str, stage: str, done: int, total: int) -> None:
        """Note how far a drive is."""
        self._told[drive, stage] = done, total

    def take(self) -> list[tuple[str, str, int, int]]:
        """What has been told since the last call."""
        told, self._told = self._told, {}
        return [(*key, *value) for key, value in told.items()]


def detect_by(
    eyes: Sequence[Any],
    drive: Drive,
    options: DetectorOptions,
    workers: int,
    progress: Callable[[int, int], None],
) -> list[ImageDetections]:
    """:func:`v2hdm.detection.batch.detect_all` by actors; the result is the same.

    Raises:
        V2hdmError: as there.
        WorkerError: an actor died again and again.
    """
    drive = with_own_vehicle(drive, Detector.load(options=options))
    total, reference = len(drive.images), ray.put(drive)
    batches = [range(begin, min(begin + IMAGES_A_BATCH, total)) for begin in range(0, total, IMAGES_A_BATCH)]
    found: dict[int, list[ImageDetections]] = {}
    waiting: dict[Any, tuple[int, Any]] = {}
    free = _BATCHES_AHEAD * list(eyes)
    left, seen = list(enumerate(batches))[::-1], 0
    while left or waiting:
        while left and free:
            number, images = left.pop()
            actor = free.pop(0)
            waiting[actor.detect.remote([reference], options, images)] = number, actor
        (done,), _ = ray.wait(list(waiting), num_returns=1)
        number, actor = waiting.pop(done)
        found[number] = _result(done)
        free.append(actor)
        seen += len(found[number])
        progress(seen, total)
    return [one for number in range(len(batches)) for one in found[number]]


def _result(reference: Any) -> list[ImageDetections]:
    try:
        result: list[ImageDetections] = ray.get(reference)
    except RayTaskError as failure:
        raise failure.cause from None
    except RayActorError:
        raise WorkerError(
            "a detection worker died again and again over the same images, perhaps for want of memory; set "
            "fewer --workers, or look at the images"
        ) from None
    return result


def map_drive(job: Job, eyes: Sequence[Any], board: Any, folder: str) -> tuple[Row, str]:
    """Map one drive and write its results; its row, and the traceback where it met a bug of ours.

    Args:
        job: what to map.
        eyes: the actors that detect.
        board: the actor that is told of the progress.
        folder: where relative paths begin.
    """
    os.chdir(folder)
    job.config.workers = 1
    try:
        result = pipeline.run(
            job.config, job.config_yaml, _Telling(board, job.name), partial(detect_by, eyes)
        )
        finish(job)
    except Exception as error:  # a drive that fails is a row, and the others go on
        line = told(error)
        if line is not None:
            return Row.of_error(job.name, job.source, line), ""
        line = f"a bug of ours, {type(error).__name__}: {error}; its traceback is in the fleet's folder"
        return Row.of_error(job.name, job.source, line), traceback.format_exc()
    return Row.of_result(job.name, job.source, result.folder, metrics_of(result.folder), kept=False), ""


class _Telling:
    """Tells the board how far a drive is, now and then and at the ends of its stages."""

    def __init__(self, board: Any, drive: str) -> None:
        self._board, self._drive, self._told_s = board, drive, -_TELL_EVERY_S

    def __call__(self, task: str, done: int, total: int) -> None:
        now_s = time.monotonic()
        if done < total and now_s - self._told_s < _TELL_EVERY_S:
            return
        self._told_s = now_s
        self._board.tell.remote(self._drive, task, done, total)
