"""One Ray of our own for all tests of a process."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import pytest

from tests.stores import quick as quick
from tests.stores import s3 as s3


@pytest.fixture(scope="session")
def ray() -> Iterator[Any]:
    pytest.importorskip("ray", reason="ray, the extra 'fleet', is not installed")
    import ray

    from v2hdm.fleet.cluster import LOCAL, cluster

    with pytest.MonkeyPatch.context() as patch:
        # A GPU on Ray's books: what is counted there can be tested, what runs there cannot.
        patch.setattr(ray, "init", partial(ray.init, num_gpus=1))
        with cluster(LOCAL, 2) as module:
            yield module
