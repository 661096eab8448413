"""Settings for all tests."""

from hypothesis import settings

from tests.ports import rendered as rendered
from tests.ports import short_drive as short_drive
from tests.ports import small_drive as small_drive
from tests.ports import small_mapped as small_mapped
from tests.ports import tiny_drive as tiny_drive

# The same examples every time, and no deadline: a busy machine must not turn a passing test red.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")
