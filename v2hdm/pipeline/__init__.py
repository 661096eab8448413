"""The whole job as one call: :func:`run` maps a drive and writes its results."""

from v2hdm.pipeline.run import DriveConfig, Progress, RunConfig, RunResult, run, silent
from v2hdm.pipeline.viewer import Viewer

__all__ = ["DriveConfig", "Progress", "RunConfig", "RunResult", "Viewer", "run", "silent"]
