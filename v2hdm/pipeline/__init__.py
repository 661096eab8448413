"""The whole job as one call: :func:`run` maps a drive and writes its results."""

from v2hdm.pipeline.config import DriveConfig, MapConfig, RunConfig
from v2hdm.pipeline.finished import RunResult
from v2hdm.pipeline.run import run
from v2hdm.pipeline.telling import Progress, silent
from v2hdm.pipeline.viewer import Viewer

__all__ = ["DriveConfig", "MapConfig", "Progress", "RunConfig", "RunResult", "Viewer", "run", "silent"]
