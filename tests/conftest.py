"""Settings for all tests."""

from __future__ import annotations

from hypothesis import settings

# The same examples every time, and no deadline: a busy machine must not turn a passing test red.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")
