"""Torch is as its quirks take it to be: a test that fails here asks whether a workaround is still needed."""

import inspect
import subprocess
import sys

import torch

from v2hdm.adjust.torch_quirks import bare_step

FIRST_OPTIMISER = """
import sys
import torch
{before}
torch.optim.LBFGS([torch.zeros(1)])
print("torch._dynamo" in sys.modules)
"""


def compiler_is_imported(before=""):
    """Whether a process that makes its first optimiser imports torch's compiler."""
    program = FIRST_OPTIMISER.format(before=before)
    process = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return process.stdout.strip() == "True"


def test_the_first_optimiser_imports_torchs_compiler_unless_it_is_left_out():
    leave_out = "from v2hdm.adjust.torch_quirks import leave_compiler_out\nleave_compiler_out()"
    assert compiler_is_imported()
    assert not compiler_is_imported(leave_out)


def minimised(step):
    """The end (2,) of three steps of LBFGS from (3, 4) on a narrow bowl."""
    point = torch.tensor([3.0, 4.0], dtype=torch.float64)
    optimiser = torch.optim.LBFGS([point], max_iter=1, line_search_fn="strong_wolfe")

    def closure():
        slope = torch.tensor([1.0, 9.0], dtype=torch.float64)
        point.grad = slope * point
        return float((slope * point.square()).sum() / 2)

    for _ in range(3):
        step(optimiser, closure)
    return point


def test_the_bare_step_of_lbfgs_is_its_step_without_the_hooks_around_it():
    step = bare_step()
    assert step is not torch.optim.LBFGS.step
    assert list(inspect.signature(step).parameters) == ["self", "closure"]
    assert torch.equal(minimised(step), minimised(torch.optim.LBFGS.step))
