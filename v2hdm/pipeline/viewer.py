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

    def detected(self, folder: Path, drive: Drive, detections: Sequence[ImageDetections]) -> None:
        """The detections in a drive's images; ``folder`` takes what a viewer keeps of the run."""

    def mapped(self, cameras: str, methods: Mapping[str, MethodResult]) -> None:
        """The results by method of a set of cameras, ``front`` or ``both``; all cameras come last."""

    def close(self) -> None:
        """All has been mapped: whatever is kept in the folder must be whole now."""


class Unwatched:
    """A :class:`Viewer` that shows nothing."""

    def detected(self, folder: Path, drive: Drive, detections: Sequence[ImageDetections]) -> None:
        """Nothing."""

    def mapped(self, cameras: str, methods: Mapping[str, MethodResult]) -> None:
        """Nothing."""

    def close(self) -> None:
        """Nothing."""
