"""From a drive to a map and a calibration: :func:`run` is the whole product as one call.

It needs no terminal and knows nothing of Hydra. What a run is made of is looked at first: where a finished
result of just that lies in its place, nothing else is loaded or done.
"""

from __future__ import annotations

from v2hdm.pipeline.config import RunConfig
from v2hdm.pipeline.context import Progress, Viewer, silent
from v2hdm.pipeline.finished import RunResult
from v2hdm.pipeline.places import in_place
from v2hdm.store.cache.store import Store


def run(
    config: RunConfig, config_yaml: str = "", progress: Progress = silent, viewer: Viewer | None = None
) -> RunResult:
    """Map one drive, or several together, and write the results to ``<output>/<name>/``, whole or not at all.

    Args:
        config: what to do.
        config_yaml: the configuration as text, kept beside the results.
        progress: told how far the long steps are.
        viewer: shown images, detections and maps as they come, also where nothing has changed since.

    Raises:
        V2hdmError: The configuration, the drive or the detector is at fault, or no map can be made.
    """

    def work(config: RunConfig, store: Store) -> RunResult:
        # Loads torch and much else, which takes seconds.
        from v2hdm.detection.network import check_device
        from v2hdm.pipeline.map_drive import map_drives

        check_device(config.detector.device)

        return map_drives(config, store, config_yaml, progress, viewer)

    return in_place(config, work, config.resume and viewer is None, progress)[0]
