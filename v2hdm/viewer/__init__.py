"""Viewers that show a run live and record it; each needs a package of its own, of the extra ``viewer``."""

from __future__ import annotations

from v2hdm.errors import ConfigError
from v2hdm.io.safe.texts import shown
from v2hdm.viewer.recording import FILE, RerunViewer

__all__ = ["FILE", "RerunViewer", "check_viewer"]

VIEWERS = ("none", "rerun")


def check_viewer(name: str) -> bool:
    """Whether a run is to be watched by :class:`RerunViewer`.

    Raises:
        ConfigError: there is no viewer of this name.
    """
    if name not in VIEWERS:
        raise ConfigError(f"viewer is {shown(name)}: choose {' or '.join(VIEWERS)}")
    return name != "none"
