"""Settings for all tests."""

import gc
import os

from hypothesis import settings

from tests.ports import coarse_mosaics as coarse_mosaics
from tests.ports import rendered as rendered
from tests.ports import short_drive as short_drive
from tests.ports import small_drive as small_drive
from tests.ports import small_mapped as small_mapped
from tests.ports import survey as survey
from tests.ports import tiny_drive as tiny_drive
from v2hdm.native import SWITCH, _loaded, kernels

# The same examples every time, and no deadline: a busy machine must not turn a passing test red.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")

# Where nothing could be compiled, whichever test detects first would be told so.
if kernels() is None:
    os.environ[SWITCH] = "0"
    _loaded.cache_clear()


def pytest_collection_finish() -> None:
    """Leave out what is loaded by now, for good, whenever garbage is collected."""
    gc.freeze()
