"""A process keeps the memory that it frees, until it gives it back."""

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


_SCATTERED = """
import numpy as np
from v2hdm.executor.memory import keep_freed_memory, release_freed_memory

def resident_mb():
    (line,) = [line for line in open("/proc/self/status") if line.startswith("VmRSS")]
    return int(line.split()[1]) / 1e3

keep_freed_memory()
# Small arrays in between stay, so that no large piece is free at the end.
arrays = [np.ones(125_000 if number % 2 else 1_000) for number in range(400)]
del arrays[1::2]
before = resident_mb()
release_freed_memory()
print(before - resident_mb())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc alone keeps what is freed and can be told not to")
def test_memory_that_was_freed_in_many_places_is_given_back() -> None:
    done = subprocess.run([sys.executable, "-c", _SCATTERED], check=True, stdout=subprocess.PIPE, text=True)
    assert float(done.stdout) > 150  # of 200 MB
