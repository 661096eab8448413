"""One Ray of our own for all tests of a process."""

from functools import partial

import pytest

from tests.stores import s3 as s3
from v2hdm.simulate import PortConfig
from v2hdm.simulate.port.config import RouteConfig, YardConfig


@pytest.fixture(scope="session")
def ray():
    pytest.importorskip("ray", reason="ray, the extra 'fleet', is not installed")
    import ray

    from v2hdm.fleet.cluster import LOCAL, cluster

    with pytest.MonkeyPatch.context() as patch:
        # A GPU on Ray's books: what is counted there can be tested, what runs there cannot.
        patch.setattr(ray, "init", partial(ray.init, num_gpus=1))
        with cluster(LOCAL, 2) as module:
            yield module


@pytest.fixture(scope="session")
def drive(rendered):
    """Ten images of one camera on a straight."""
    route = RouteConfig(pieces=[[26.0, 0.0]], image_spacing_m=2.6)
    yard = YardConfig(parked_trucks=0, barriers=0, lamp_posts=0, moving_trucks=0, shadow_strips=0)
    port = PortConfig(name="tiny", seed=3, initial_ipm="calibrated", route=route, yard=yard)
    port.cameras = {"front": port.cameras["front"]}
    return rendered(port)
