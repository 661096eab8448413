"""The small site that the tests of the benchmark share."""

import pytest

from tests.benchmark.hand import site


@pytest.fixture(scope="session")
def reference():
    return site()
