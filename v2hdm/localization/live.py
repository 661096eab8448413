"""``v2hdm localize --live``: a process per camera detects, this one localises, image by image."""

from __future__ import annotations

import json
import math
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from v2hdm.errors import ConfigError, DriveError
from v2hdm.localization.antenna import Fix
from v2hdm.localization.localizer import Localizer
from v2hdm.localization.motion import Motion
from v2hdm.localization.pose import Pose
from v2hdm.localization.seeing import Look
from v2hdm.localization.stream import MotionLines, look_of

_QUIET_S = 0.5  # without an image, a pose comes after this time all the same
_POLL_S = 0.01  # a file that grows is looked at this often


class _Ended(NamedTuple):
    """A source that gives no more, and why."""

    source: str
    error: str | None


_Item = Look | Motion | Fix | _Ended
_Queue = queue.SimpleQueue[_Item]


def localize_live(
    localizer: Localizer,
    sources: Mapping[str, str],
    calibrations: Mapping[str, Path],
    motion: IO[str] | Path,
    lines: MotionLines,
    take: Callable[[Pose], None],
    delay_s: float = 0.0,
    limit: int | None = None,
) -> None:
    """Localise until the cameras end, ``limit`` images were taken, or Ctrl-C.

    Args:
        localizer: of the map.
        sources: by camera a folder that somebody writes images to, or a camera's index.
        calibrations: files by camera.
        motion: the odometry's lines, a stream or a file that grows.
        lines: reads them.
        take: called with each pose.
        delay_s: time from a picture to the stamp of its file, s.
        limit: stop after so many images.

    Raises:
        DriveError: a camera or the odometry ended in an error.
    """
    items: _Queue = queue.SimpleQueue()
    with ExitStack() as stack:
        cameras = {
            name: stack.enter_context(_camera(name, source, calibrations[name], items, delay_s))
            for name, source in sources.items()
        }
        threading.Thread(target=_follow_motion, args=(motion, lines, items), daemon=True).start()
        running = set(sources)
        images = 0
        written_s = -math.inf
        news = _News()
        untold: list[str] = []  # cameras that are to be told where to look
        while running and (limit is None or images < limit):
            _gather(_available(items, waits=not untold), news, running)
            # What comes between images waits for the next: a pose of it would only cost time.
            if news.looks or news.has_waited(written_s):
                pose = localizer.update(news.looks, news.motions, news.fixes)
                images += len(news.looks)
                written_s = pose.stamp_s
                take(pose)
                untold = list(dict.fromkeys([*untold, *(look.camera for look in news.looks)]))
                news = _News(second_looks=news.second_looks)
            # Another camera's image that waits goes first: the cameras were told of several images to come.
            elif untold:
                cameras[untold.pop(0)].point(localizer, time.time())
            # What was searched once there was time is judged once poses are written.
            elif news.second_looks:
                localizer.update(news.second_looks)
                news = _News(motions=news.motions, fixes=news.fixes)


@dataclass
class _News:
    """Looks, motions and positions that have come since the last pose."""

    looks: list[Look] = field(default_factory=list)
    second_looks: list[Look] = field(default_factory=list)
    motions: list[Motion] = field(default_factory=list)
    fixes: list[Fix] = field(default_factory=list)

    def has_waited(self, written_s: float) -> bool:
        """Whether motions or positions are well after the last pose, or before it: a clock may go back."""
        stamps_s = [motion.stamp_s for motion in self.motions[-1:]]
        stamps_s += [fix.stamp_s for fix in self.fixes[-1:]]
        return any(abs(stamp_s - written_s) > _QUIET_S for stamp_s in stamps_s)

    def add(self, item: Look | Motion | Fix) -> None:
        """Take an item."""
        if isinstance(item, Look):
            (self.second_looks if item.is_second else self.looks).append(item)
        elif isinstance(item, Motion):
            self.motions.append(item)
        else:
            self.fixes.append(item)


def _available(items: _Queue, waits: bool) -> Iterator[_Item]:
    """All that has come; if it ``waits``, at least one."""
    if waits:
        try:
            yield items.get(timeout=1.0)
        except queue.Empty:
            return
    while True:
        try:
            yield items.get_nowait()
        except queue.Empty:
            return


def _gather(items: Iterable[_Item], news: _News, running: set[str]) -> None:
    """Sort what has come into ``news``; a source that has ended is ``running`` no longer.

    Raises DriveError if it ended in an error.
    """
    for item in items:
        if isinstance(item, _Ended):
            running.discard(item.source)
            if item.error is not None:
                raise DriveError(item.error)
        else:
            news.add(item)


@dataclass(frozen=True)
class _Eye:
    """A camera's process, told where to look next."""

    camera: str
    stream: IO[str]
    delay_s: float  # from a picture to the stamp of its file

    def point(self, localizer: Localizer, now_s: float) -> None:
        """Say where to look in the images to come, after a look at the time ``now_s`` of a file."""
        lines = []
        for ahead in localizer.ahead(self.camera, now_s - self.delay_s):
            regions_px = None if ahead.regions_px is None else np.round(ahead.regions_px, 1).tolist()
            record = {"stamp_s": ahead.stamp_s + self.delay_s, "regions_px": regions_px}
            if ahead.is_all_later:
                record["all_later"] = True
            lines.append(json.dumps(record))
        try:
            self.stream.write("".join(f"{line}\n" for line in lines))
            self.stream.flush()
        except OSError:  # it has ended; what it says of that comes as its last item
            return


@contextmanager
def _camera(name: str, source: str, calibration: Path, items: _Queue, delay_s: float) -> Iterator[_Eye]:
    """A process that detects in the newest images of a camera, as ``v2hdm detect --live`` does."""
    command = [sys.executable, "-m", "v2hdm.detect", source, "--camera", str(calibration), "--live"]
    pipe = subprocess.PIPE
    with subprocess.Popen(
        [*command, "--regions"], stdin=pipe, stdout=pipe, stderr=pipe, text=True
    ) as process:
        assert process.stdin is not None
        arguments = (name, process, items, delay_s)
        reader = threading.Thread(target=_follow_camera, args=arguments, daemon=True)
        reader.start()
        try:
            yield _Eye(name, process.stdin, delay_s)
        finally:
            process.terminate()
            reader.join()


def _follow_camera(name: str, process: subprocess.Popen[str], items: _Queue, delay_s: float) -> None:
    assert process.stdout is not None
    assert process.stderr is not None
    for line in process.stdout:
        look = look_of(json.loads(line), name)
        items.put(replace(look, stamp_s=look.stamp_s - delay_s))
    said = process.stderr.read()
    error = next((line for line in said.splitlines() if line.startswith("error: ")), None)
    items.put(_Ended(name, None if error is None else f"camera {name}: {error.removeprefix('error: ')}"))


def _follow_motion(motion: IO[str] | Path, lines: MotionLines, items: _Queue) -> None:
    try:
        for line in _growing(motion) if isinstance(motion, Path) else motion:
            item = lines.read(line)
            if item is not None:
                items.put(item)
    except ConfigError as error:
        items.put(_Ended("motion", str(error)))
    except OSError as error:
        items.put(_Ended("motion", f"{motion}: cannot be read ({error.strerror}); check the path"))


def _growing(path: Path) -> Iterator[str]:
    """The lines of a file that somebody appends to; never ends."""
    line = ""
    with path.open(encoding="utf-8") as stream:
        while True:
            part = stream.readline()
            line += part
            if line.endswith("\n"):
                yield line
                line = ""
            elif not part:
                time.sleep(_POLL_S)
