"""The workers of a fleet: actors that detect, tasks that map, and an actor that collects their progress."""

from __future__ import annotations

import logging
import os
import time
import traceback
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import cv2
import ray
from ray.exceptions import RayActorError, RayTaskError, WorkerCrashedError

from v2hdm.detection.batch import detect_image
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.errors import DriveError, WorkerError, describe
from v2hdm.executor import IN_PROCESS
from v2hdm.fleet.cluster import DETECTORS_A_GPU, RETRIES
from v2hdm.fleet.plan import Job, Row
from v2hdm.pipeline.config import RunConfig
from v2hdm.pipeline.context import Context
from v2hdm.pipeline.run import RunResult, made_of, map_and_save, take_or_make
from v2hdm.progress import Progress
from v2hdm.records import Drive, ImageDetections
from v2hdm.store.cache import Line, StageCache, log_again, recorded

_Result = TypeVar("_Result")

IMAGES_A_BATCH = 8  # images of one call: seconds of work against a millisecond of Ray's
_BATCHES_AHEAD = 2  # calls that wait at each actor, so that it is never idle between them
_DRIVES_KEPT = 4
_CORES_EACH = 0.5  # of a task: the other half is of an actor that detects, which has nothing to do meanwhile
_REPORT_EVERY_S = 0.5


class ProgressActor:
    """Collects how far the drives are until the head asks."""

    def __init__(self) -> None:
        self._reported: dict[tuple[str, str], tuple[int, int]] = {}

    def report(self, drive: str, stage: str, done: int, total: int) -> None:
        """Note how far a drive is."""
        self._reported[drive, stage] = done, total

    def take(self) -> list[tuple[str, str, int, int]]:
        """All reports since the last call."""
        reported, self._reported = self._reported, {}
        return [(*key, *value) for key, value in reported.items()]


def reported(actor: Any, drive: str) -> Progress:
    """Progress of one drive for the :class:`ProgressActor`, now and then and at the ends of its stages."""
    last_s = -_REPORT_EVERY_S

    def report(task: str, done: int, total: int) -> None:
        nonlocal last_s
        now_s = time.monotonic()
        if done >= total or now_s - last_s >= _REPORT_EVERY_S:
            last_s = now_s
            actor.report.remote(drive, task, done, total)

    return report


class DetectorActor:
    """Detects in images: the model and the last drives stay loaded. Relative paths begin at ``folder``."""

    def __init__(self, folder: str) -> None:
        os.chdir(folder)
        cv2.setNumThreads(1)
        self._detectors: dict[str, Detector] = {}
        self._drives: dict[str, Drive] = {}

    def process(self) -> int:
        """Its process's number."""
        return os.getpid()

    def detect(
        self, drive: Sequence[Any], options: DetectorOptions, images: Sequence[int]
    ) -> list[ImageDetections]:
        """Detections in some images of a drive, given by a reference within a list: it is fetched once."""
        (reference,) = drive
        key, known = reference.hex(), repr(options)
        if key not in self._drives:
            if len(self._drives) == _DRIVES_KEPT:
                self._drives.pop(next(iter(self._drives)))
            self._drives[key] = ray.get(reference)
            root = self._drives[key].root
            if not root.exists():
                raise DriveError(
                    f"{root}: is not on {os.uname().nodename}, which is to detect in its images; put drives, "
                    "and the cache for those that are copied, on a folder that all machines share"
                )
        if known not in self._detectors:
            self._detectors = {known: Detector.load(options=options)}
        return [detect_image(self._detectors[known], self._drives[key], index) for index in images]


def open_detectors(
    devices: Collection[str], cores: int, gpus: int, gpu_share: float, folder: str, retries: int
) -> dict[str, list[Any]]:
    """Actors that detect, for each device that is asked for: one per core, on GPUs some to each.

    ``cores`` and ``gpus`` are those of all machines; an actor on a GPU books ``gpu_share`` of it.
    """
    actor = ray.remote(DetectorActor)
    # A core has one actor that detects and one drive that is mapped: the one waits for the other by turns.
    # Actors on GPUs are counted there.
    places = {
        "cpu": (cores, {"num_cpus": 0.5}),
        "cuda": (min(cores, DETECTORS_A_GPU * gpus), {"num_cpus": 0, "num_gpus": gpu_share}),
    }
    opened = {}
    for device in devices:
        count, books = places[device]
        options = actor.options(max_restarts=-1, max_task_retries=retries, **books)
        opened[device] = [options.remote(folder) for _ in range(count)]
    return opened


def detect_by(
    detectors: Sequence[Any],
    drive: Drive,
    options: DetectorOptions,
    images: Sequence[int],
    workers: int,
    take: Callable[[ImageDetections], None],
) -> None:
    """:func:`v2hdm.detection.batch.detect_images` by actors, with the same detections and errors.

    Raises WorkerError where an actor died again and again.
    """
    reference = ray.put(drive)
    batches = [images[begin : begin + IMAGES_A_BATCH] for begin in range(0, len(images), IMAGES_A_BATCH)]
    found: dict[int, list[ImageDetections]] = {}
    waiting: dict[Any, tuple[int, Any]] = {}
    free = _BATCHES_AHEAD * list(detectors)
    left, taken = list(enumerate(batches))[::-1], 0
    while left or waiting:
        while left and free:
            number, batch = left.pop()
            actor = free.pop(0)
            waiting[actor.detect.remote([reference], options, batch)] = number, actor
        (done,), _ = ray.wait(list(waiting), num_returns=1)
        number, actor = waiting.pop(done)
        died = "a detection worker died again and again over the same images"
        found[number] = _result(done, died, ", or look at the images")
        free.append(actor)
        while taken in found:
            for one in found.pop(taken):
                take(one)
            taken += 1


class RayExecutor:
    """A :class:`v2hdm.executor.Executor` of a cluster's cores."""

    def __init__(self, cores: int, folder: str) -> None:
        """``cores`` are those of the cluster; ``folder`` is where relative paths begin."""
        self.workers, self._folder = cores, folder

    def begin(self, work: Callable[[], _Result]) -> Callable[[], _Result]:
        """Hand ``work`` to a task; one whose worker dies is begun anew."""
        level = logging.getLogger("v2hdm").getEffectiveLevel()
        task: Any = ray.remote(_done).options(num_cpus=_CORES_EACH, max_retries=RETRIES)
        reference = task.remote(work, level, self._folder)

        def result() -> _Result:
            died = "a worker process of a site died again and again"
            done: tuple[_Result, list[Line]] = _result(reference, died, "")
            log_again(done[1])
            return done[0]

        return result


def _done(work: Callable[[], _Result], level: int, folder: str) -> tuple[_Result, list[Line]]:
    """The result of ``work`` in the process of a task, and its log lines."""
    os.chdir(folder)
    logging.getLogger("v2hdm").setLevel(level)
    with recorded() as lines:
        result = work()
    return result, lines


def _result(reference: Any, died: str, else_do: str) -> Any:
    """The result of a call, its own error, or a WorkerError where its process died."""
    try:
        return ray.get(reference)
    except RayTaskError as failure:
        raise failure.cause from failure
    except (RayActorError, WorkerCrashedError):
        raise WorkerError(f"{died}, perhaps for want of memory; set fewer --workers{else_do}") from None


def map_drive(job: Job, detectors: Sequence[Any], progress: Any, folder: str) -> tuple[Row, str]:
    """Map one drive and write its results; its row, and the traceback where it met a bug of ours.

    ``progress`` is the :class:`ProgressActor`; relative paths begin at ``folder``.
    """
    os.chdir(folder)
    job.config.workers = 1
    try:
        report = reported(progress, job.name)
        mapped = partial(_mapped, job, detectors, report)
        result, kept = take_or_make(job.config, mapped, job.config.resume, report)
    except Exception as error:  # a drive that fails is a row, and the others go on
        line = describe(error)
        if line is not None:
            return Row.of_error(job.name, job.source, line), ""
        line = f"a bug of ours, {type(error).__name__}: {error}; its traceback is in the fleet's folder"
        return Row.of_error(job.name, job.source, line), traceback.format_exc()
    return Row.of_result(job.name, job.source, result.place, result.metrics, kept), ""


def _mapped(
    job: Job, detectors: Sequence[Any], report: Progress, config: RunConfig, cache: StageCache
) -> RunResult:
    several = len(config.drive.paths) > 1
    executor = RayExecutor(len(detectors), str(Path.cwd())) if several else IN_PROCESS
    context = Context(progress=report, detect=partial(detect_by, detectors), executor=executor)
    return map_and_save(config, cache, job.config_yaml, context, made_of(job.config))
