"""One Ray of our own for all tests of a process."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest


@pytest.fixture(scope="session")
def ray() -> Iterator[Any]:
    pytest.importorskip("ray", reason="ray, the extra 'fleet', is not installed")
    from v2hdm.fleet.cluster import LOCAL, cluster

    with cluster(LOCAL, 2) as module:
        yield module
