"""What a process pays for its first solve, and what it does without a place to keep kernels."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

SOLVE = """
import sys
import numpy as np
{before}
from tests.adjust.scene import make_scene
from v2hdm.adjust import SolveOptions, solve
solution = solve(make_scene(0, frames=30).problem, SolveOptions(pose_states=()))
{after}
print(repr(solution.cost))
"""


def cost_in_a_fresh_process(before="", after=""):
    """That of a small problem; ``before`` and ``after`` are run around its solve."""
    return float(said_by(SOLVE.format(before=before, after=after)))


def said_by(program):
    """What a program says on stdout, and that it says nothing else."""
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout.strip()


def test_torch_does_not_import_its_compiler():
    cost_in_a_fresh_process(after="assert 'torch._dynamo' not in sys.modules")


def test_where_torch_has_another_mark_its_compiler_is_imported_as_ever():
    """The mark is private: here it is one that cannot be set, as a later torch may have it."""
    before = """
import torch
from v2hdm.adjust import lbfgs
class Shut:
    __slots__ = ()
    def __call__(self, *arguments): raise AssertionError
torch.optim.Optimizer.shut = type("Wrapper", (), {"__wrapped__": Shut()})()
"""
    assert cost_in_a_fresh_process(before) == cost_in_a_fresh_process()


KERNEL = """
from pathlib import Path

import pytest
from v2hdm.adjust.engines.numba import build
build.PLACES = (Path({place!r}),)
import numpy as np
from v2hdm.adjust.engines.numba.engine import _gather
out = np.zeros((1, 1))
_gather(np.zeros(1, dtype=np.int32), np.ones((1, 1)), out)
print(out[0])
"""


@pytest.mark.slow
def test_kernels_are_kept_and_where_they_cannot_be_they_are_compiled(tmp_path):
    """In a folder that is a file, or from damaged files, a process compiles for itself and says nothing."""
    blocked, kept = tmp_path / "file", tmp_path / "kept"
    blocked.write_text("")
    assert said_by(KERNEL.format(place=str(blocked))) == "[1.]"
    program = KERNEL.format(place=str(kept))
    assert said_by(program) == "[1.]"
    stamps = {path: path.stat().st_mtime_ns for path in kept.rglob("*.nb?")}
    assert stamps
    assert said_by(program) == "[1.]"
    assert {path: path.stat().st_mtime_ns for path in kept.rglob("*.nb?")} == stamps
    for path in stamps:
        path.write_bytes(b"damaged")
    assert said_by(program) == "[1.]"
