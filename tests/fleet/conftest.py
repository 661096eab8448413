"""A drive of a fleet."""

from dataclasses import replace

import pytest

from tests.fleet.runs import written
from tests.stores import s3 as s3
from v2hdm.fleet import plan
from v2hdm.pipeline.run import run
from v2hdm.simulate.port.config import PortConfig, RouteConfig, YardConfig


@pytest.fixture(scope="session")
def drive(rendered):
    """Ten images of one camera on a straight."""
    route = RouteConfig(pieces=[[26.0, 0.0]], image_spacing_m=2.6)
    yard = YardConfig(parked_trucks=0, barriers=0, lamp_posts=0, moving_trucks=0, shadow_strips=0)
    front = replace(PortConfig().cameras["front"], width=640, height=360, focal_px=450.0)
    port = PortConfig(name="tiny", seed=3, initial_ipm="calibrated", route=route, yard=yard)
    return rendered(replace(port, cameras={"front": front}))


@pytest.fixture(scope="session")
def alone(drive, tmp_path_factory):
    """The result of the drive by the mapping door, in one process, of one thread as a fleet's are."""
    folder = tmp_path_factory.mktemp("alone")
    settings = [f"output={folder / 'out'}", f"cache={folder / 'cache'}", "workers=1"]
    (job,) = plan([written(folder, "good", drive)], settings).jobs
    return run(job.config, job.config_yaml).folder
