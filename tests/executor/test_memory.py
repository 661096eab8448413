"""A process keeps the memory that it frees."""

import os
import subprocess
import sys

import pytest

_FAULTS = """
import resource
import numpy as np
from v2hdm.executor.memory import keep_freed_memory
if {keeps}:
    keep_freed_memory()
for number in range(20):
    # More is freed at once than glibc keeps by itself, in arrays too small for huge pages.
    arrays = [np.ones(375_000) for _ in range(16)]
    del arrays
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt)
"""


def _faults(keeps: bool) -> int:
    command = [sys.executable, "-c", _FAULTS.format(keeps=keeps)]
    # Workers of Dask get such variables, and tests in the same process may have started some.
    variables = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    return int(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=variables).stdout)


@pytest.mark.skipif(sys.platform != "linux", reason="glibc alone hands memory back and can be told not to")
def test_arrays_of_a_loop_lie_where_the_last_ones_did() -> None:
    pages = 16 * 375_000 * 8 // 4096
    assert _faults(keeps=False) - _faults(keeps=True) > 5 * pages
