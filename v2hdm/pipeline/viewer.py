"""What the pipeline tells whoever watches a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from v2hdm.records import Drive, ImageDetections

if TYPE_CHECKING:  # loads torch, which a finished run does without
    from v2hdm.mapping.results import MethodResult


class Viewer(Protocol):
    """Shows a run while it goes on."""

    def begun(self, folder: Path, drive: Drive) -> None:
        """Detection in a drive's images has begun; ``folder`` takes what a viewer keeps of the run."""

    def detected(self, detections: Sequence[ImageDetections]) -> None:
        """What was found in some more of its images, in any order."""

    def mapped(self, cameras: str, methods: Mapping[str, MethodResult]) -> None:
        """The results by method of a set of cameras, ``front`` or ``both``; all cameras come last."""

    def close(self) -> None:
        """All has been mapped, or nothing more will be: whatever is kept in the folder must be whole now."""


class Unwatched:
    """A :class:`Viewer` that shows nothing."""

    def begun(self, folder: Path, drive: Drive) -> None:
        """Nothing."""

    def detected(self, detections: Sequence[ImageDetections]) -> None:
        """Nothing."""

    def mapped(self, cameras: str, methods: Mapping[str, MethodResult]) -> None:
        """Nothing."""

    def close(self) -> None:
        """Nothing."""
