"""The files of ``v2hdm detect``: JSON lines and drawings as images are looked at, latencies at the end."""

from __future__ import annotations

import argparse
import errno
import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

import cv2
import numpy as np

from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.road import as_record, draw_detections
from v2hdm.detection.stopwatch import TOTAL, Stopwatch
from v2hdm.detection.weights import unknown_network
from v2hdm.errors import ConfigError, DriveError
from v2hdm.pipeline.detect_images import Detected, detect_images
from v2hdm.store.files import forget_stdout, whole_file
from v2hdm.store.inputs import refuse_input
from v2hdm.store.results import GrowingFolder, growing_folder

_FIRST = b'{"source": '
"""The beginning of every line of detections."""

_STAGES = ("read", "net", "propose", "lanes", "fit", "judge")


def detect_to_files(parsed: argparse.Namespace) -> None:
    """Detect in every image of a source.

    A live camera is watched until Ctrl-C; for any other source that is raised on, and no file is written.

    Args:
        parsed: the arguments of :mod:`v2hdm.cli.detect`.

    Raises:
        V2hdmError: what a user got wrong.
    """
    cv2.setNumThreads(1)
    options = DetectorOptions(model=parsed.model, threads=parsed.threads)
    stopwatch, live = Stopwatch(), parsed.source.isdecimal()
    frames = detect_images(
        parsed.source,
        camera=parsed.camera,
        camera_name=parsed.camera_name,
        mounting=parsed.mounting,
        linear=parsed.linear,
        detector=options,
        limit=parsed.limit,
        stopwatch=stopwatch,
    )
    failure = None
    with _drawings(parsed.draw) as drawings, _lines(parsed.output) as stream:
        try:
            for found in frames:
                print(json.dumps(as_record(found.frame, found.camera, found.road)), file=stream)
                if live:
                    stream.flush()
                if drawings is not None:
                    _draw(drawings, found)
        except KeyboardInterrupt:
            if not live:
                raise
        except DriveError as error:
            if not (live and stopwatch.images):
                raise
            failure = error  # hours of a camera that was unplugged are kept
    _report(stopwatch)
    unknown = unknown_network(parsed.model) if parsed.model is not None else None
    if unknown is not None:
        print(unknown, file=sys.stderr)
    if failure:
        raise failure


@contextmanager
def _lines(output: Path | None) -> Iterator[TextIO]:
    """The stream of JSON lines; a file appears when it is complete."""
    if output is None:
        try:
            yield sys.stdout
            sys.stdout.flush()
        except BrokenPipeError:
            raise
        except OSError as error:
            forget_stdout()
            raise DriveError(
                f"standard output: cannot be written ({error.strerror}); give an --output with room for it"
            ) from error
        return
    try:
        if output.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        refuse_input(output)
        if output.is_file() and not _is_ours(output):
            raise ConfigError(f"{output}: is there already and holds no detections; give another --output")
        if output.exists() and not output.is_file():  # a pipe, or /dev/null
            with output.open("w", encoding="utf-8") as stream:
                yield stream
            return
        with whole_file(output) as partial, partial.open("w", encoding="utf-8") as stream:
            yield stream
    except OSError as error:
        raise DriveError(f"{output}: cannot write there ({error.strerror}); give another --output") from error


def _is_ours(output: Path) -> bool:
    """Whether a file holds JSON lines of ours, or nothing."""
    with output.open("rb") as stream:
        begin = stream.read(len(_FIRST))
    return begin in (b"", _FIRST)


@contextmanager
def _drawings(folder: Path | None) -> Iterator[GrowingFolder | None]:
    """The folder of the drawings, if any are wanted."""
    if folder is None:
        yield None
        return
    with growing_folder(folder, "--draw") as drawings:
        yield drawings


def _draw(drawings: GrowingFolder, found: Detected) -> None:
    """Write the frame with its detections drawn, at once or not at all."""
    road = found.road
    markings, lanes = [one.image for one in road.markings], [one.image for one in road.lanes]
    drawn = draw_detections(found.frame.pixels, markings, lanes)
    _, packed = cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, 92])
    drawings.write(f"{found.frame.name}.jpg", packed.tobytes())


def _report(stopwatch: Stopwatch) -> None:
    """How long it took, on stderr."""
    if not stopwatch.images:
        print("no images", file=sys.stderr)
        return
    print(f"{stopwatch.images} images{_peak_memory()}", file=sys.stderr)
    print(f"{'latency, ms':12s} {'p50':>7s} {'p90':>7s} {'p99':>7s}", file=sys.stderr)
    stages = [stage for stage in _STAGES if stage in stopwatch.stages]
    stages += [stage for stage in stopwatch.stages if stage not in _STAGES]
    times_s = {stage: stopwatch.times_s(stage) for stage in stages}
    times_s["other"] = stopwatch.times_s(TOTAL) - sum(times_s.values())
    times_s[TOTAL] = stopwatch.times_s(TOTAL)
    for stage, seconds in times_s.items():
        p50, p90, p99 = np.percentile(seconds, [50, 90, 99]) * 1e3
        print(f"{stage:12s} {p50:7.1f} {p90:7.1f} {p99:7.1f}", file=sys.stderr)


def _peak_memory() -> str:
    """The most memory that this process ever held, where the operating system counts it."""
    status = Path("/proc/self/status")
    if status.is_file():  # getrusage would count what the parent held when it started us
        peak = next((line for line in status.read_text().splitlines() if line.startswith("VmHWM")), "")
        return f", peak memory {int(peak.split()[1]) * 1024 / 1e6:.0f} MB" if peak else ""
    if sys.platform != "darwin":
        return ""
    import resource

    return f", peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.0f} MB"
