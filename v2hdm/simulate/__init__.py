"""Rendered drives with ground truth: a scene, the cameras that look at it, the ports built from both."""

from v2hdm.simulate.port.config import PortConfig
from v2hdm.simulate.port.drive import render_drive, rendered_drive

__all__ = ["PortConfig", "render_drive", "rendered_drive"]
