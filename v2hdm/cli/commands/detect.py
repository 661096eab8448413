"""``v2hdm detect SOURCE`` (docs/detect.md), for which the base install is enough."""

from __future__ import annotations

import argparse
import gc
import json
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING

from v2hdm.cli.command import Command
from v2hdm.errors import ConfigError, DriveError

if TYPE_CHECKING:
    from v2hdm.detection.frames import Frame
    from v2hdm.detection.pointing import Pointed
    from v2hdm.detection.road import Road
    from v2hdm.detection.stopwatch import Stopwatch
    from v2hdm.pipeline.detect_images import Detected
    from v2hdm.store.results import WriteFile

_FIRST = b'{"source": '  # the beginning of every line of detections
_STAGES = ("read", "horizon", "net", "propose", "lanes", "fit", "judge")


@dataclass
class _Delays:
    """How old live images were when their detections were written, and how many were dropped."""

    age_s: deque[float]
    dropped: int = 0

    def add(self, frame: Frame) -> None:
        """Count an image whose detections have just been written."""
        self.dropped += frame.dropped
        self.age_s.append(time.time() - (frame.stamp_s or 0.0))


def _run(arguments: Sequence[str]) -> None:
    """Detect in every image of a source."""
    parser = COMMAND.parser()
    parser.add_argument("source", help="an image, a folder, a drive, a video, or a camera's index")
    calibration = "the camera's calibration, for metres; or its intrinsics from Kalibr, OpenCV, ROS or COLMAP"
    parser.add_argument("--camera", type=Path, metavar="FILE", help=calibration)
    parser.add_argument("--camera-name", metavar="NAME", help="the camera to use if the file has several")
    rough = "without a calibration: approximate camera height, downward pitch and horizontal field of view "
    rough += "(default: 1.6 5 60; the images correct the pitch); intrinsics from --camera override the latter"
    values = ("HEIGHT_M", "PITCH_DEG", "FOV_DEG")
    parser.add_argument("--mounting", type=float, nargs=3, metavar=values, help=rough)
    parser.add_argument("--linear", action="store_true", help="grey values proportional to light, not sRGB")
    parser.add_argument("--model", metavar="FILE", help="the network, ONNX (default: the shipped one)")
    parser.add_argument(
        "--threads", type=int, default=1, metavar="N", help="threads of the network (default: 1)"
    )
    parser.add_argument("--limit", type=int, metavar="N", help="stop after N images")
    newest = "process the newest image of a camera or growing folder, and drop older ones"
    parser.add_argument("--live", action="store_true", help=newest)
    where = "with --live: read where to look next from standard input, JSON lines (docs/detect.md)"
    parser.add_argument("--regions", action="store_true", help=where)
    parser.add_argument(
        "--output", type=Path, metavar="FILE", help="file for the JSON lines (default: stdout)"
    )
    parser.add_argument("--draw", type=Path, metavar="DIR", help="folder for images with detections drawn")
    _detect(parser.parse_args(arguments))


def _detect(parsed: argparse.Namespace) -> None:
    """Detect; a live source runs until Ctrl-C, which interrupts any other source without writing a file."""
    import cv2

    from v2hdm.detection.options import DetectorOptions
    from v2hdm.detection.stopwatch import KEPT, Stopwatch
    from v2hdm.pipeline.detect_images import detect_images
    from v2hdm.store.lines import lines_to
    from v2hdm.store.results import growing_folder

    if parsed.regions and not parsed.live:
        raise ConfigError("--regions: says where to look in the next image of --live; add --live")
    cv2.setNumThreads(1)
    stopwatch = Stopwatch()
    live = parsed.live or parsed.source.isdecimal()
    delays = _Delays(deque(maxlen=KEPT))
    detections = detect_images(
        parsed.source,
        camera=parsed.camera,
        camera_name=parsed.camera_name,
        mounting=parsed.mounting,
        linear=parsed.linear,
        detector=DetectorOptions(model=parsed.model, threads=parsed.threads),
        limit=parsed.limit,
        live=parsed.live,
        stopwatch=stopwatch,
        regions=_regions_from(sys.stdin) if parsed.regions else None,
    )
    gc.freeze()  # modules and networks outlive every image: no collection need look at them again
    failure = None
    maker = f"v2hdm detect of {parsed.source if live else Path(parsed.source).resolve()}"
    folder = nullcontext() if parsed.draw is None else growing_folder(parsed.draw, "--draw", maker)
    with folder as write_drawing, lines_to(parsed.output, _FIRST, "detections", grows=live) as stream:
        try:
            _write(detections, stream, write_drawing, live, delays if parsed.live else None)
        except KeyboardInterrupt:
            if not live:
                raise
        except DriveError as error:
            if not (live and stopwatch.images):
                raise
            failure = error  # hours of a camera that was unplugged are kept
    _report(stopwatch, delays.age_s)
    if parsed.live and stopwatch.images:
        print(f"{delays.dropped} images dropped for newer ones", file=sys.stderr)
    if parsed.model is not None:
        _warn_of_unknown(parsed.model)
    if failure:
        raise failure


def _write(
    detections: Iterable[Detected],
    stream: IO[str],
    write_drawing: WriteFile | None,
    live: bool,
    delays: _Delays | None,
) -> None:
    """Write a line for each image, and its drawing; ``delays`` takes the age of new images."""
    from v2hdm.detection.road import as_record

    drawn_as = set[str]()
    for frame, camera, road in detections:
        record = as_record(frame, camera, road)
        is_new = not road.is_second
        if delays is not None and is_new:
            record["dropped"] = frame.dropped
        print(json.dumps(record), file=stream, flush=live)
        if delays is not None and is_new:
            delays.add(frame)
        if write_drawing is not None and is_new:
            write_drawing(f"{_new_name(frame.name, drawn_as)}.jpg", _drawing(frame, road))


def _warn_of_unknown(model: Path) -> None:
    """Warn on stderr if the judge was not fitted to the network."""
    from v2hdm.detection.weights import unknown_network

    unknown = unknown_network(model)
    if unknown is not None:
        print(unknown, file=sys.stderr)


def _regions_from(stream: IO[str]) -> Callable[[Frame], Pointed | None]:
    """The regions of a frame, from the latest line of a stream if that line has the frame's time."""
    from v2hdm.detection.pointing import Pointer

    pointer = Pointer()
    threading.Thread(target=pointer.follow, args=(stream,), name="v2hdm-regions", daemon=True).start()
    return lambda frame: pointer.at(frame.stamp_s)


def _new_name(name: str, in_use: set[str]) -> str:
    """A new unique name, now taken: images of several folders or formats may share one."""
    while name.casefold() in in_use:
        name += "_"
    in_use.add(name.casefold())
    return name


def _drawing(frame: Frame, road: Road) -> bytes:
    import cv2

    from v2hdm.detection.road import draw_detections

    markings = [marking.image for marking in road.markings]
    lanes = [lane.image for lane in road.lanes]
    drawn = draw_detections(frame.pixels, markings, lanes)
    return cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, 92])[1].tobytes()


def _report(stopwatch: Stopwatch, age_s: Sequence[float]) -> None:
    import numpy as np

    from v2hdm.detection.stopwatch import TOTAL

    if not stopwatch.images:
        print("no images", file=sys.stderr)
        return
    print(f"{stopwatch.images} image{'s' * (stopwatch.images != 1)}{_peak_memory()}", file=sys.stderr)
    print(f"{'latency, ms':12s} {'p50':>7s} {'p90':>7s} {'p99':>7s}", file=sys.stderr)
    first = [stage for stage in _STAGES if stage in stopwatch.stages]
    times_s = {stage: stopwatch.times_s(stage) for stage in dict.fromkeys([*first, *stopwatch.stages])}
    times_s["other"] = stopwatch.times_s(TOTAL) - sum(times_s.values())
    times_s[TOTAL] = stopwatch.times_s(TOTAL)
    if age_s:  # from when a live image came to when its detections were written
        times_s["age"] = np.array(age_s)
    for stage, seconds in times_s.items():
        p50, p90, p99 = np.percentile(seconds, [50, 90, 99]) * 1e3
        print(f"{stage:12s} {p50:7.1f} {p90:7.1f} {p99:7.1f}", file=sys.stderr)


def _peak_memory() -> str:
    """This process's peak memory, where Linux reports it."""
    status = Path("/proc/self/status")  # getrusage would count what the parent held when it started us
    lines = status.read_text().splitlines() if status.is_file() else []
    peak_kb = next((int(line.split()[1]) for line in lines if line.startswith("VmHWM")), None)
    return "" if peak_kb is None else f", peak memory {peak_kb * 1024 / 1e6:.0f} MB"


COMMAND = Command(
    "v2hdm detect",
    "Find markings and lanes in images, one JSON object per image.",
    _run,
    extra=None,
    interrupted="interrupted before the last image; no --output was written",
)
