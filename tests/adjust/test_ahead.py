"""Kernels compiled ahead of the adjustment that needs them."""

import importlib
import pkgutil
import subprocess
import sys

import pytest

from v2hdm.adjust import ahead, kernels


def test_the_small_problem_calls_every_kernel_of_the_engine(monkeypatch):
    called, every = set(), set()
    for listed in pkgutil.iter_modules(kernels.__path__):
        module = importlib.import_module(f"{kernels.__name__}.{listed.name}")
        for name, function in vars(module).copy().items():
            if getattr(function, "__module__", "") == module.__name__ and getattr(
                function, "is_kernel", False
            ):
                every.add(f"{listed.name}.{name}")

                def watched(*arguments, function=function, key=f"{listed.name}.{name}"):
                    called.add(key)
                    return function(*arguments)

                monkeypatch.setattr(module, name, watched)
    ahead.use_kernels()
    assert len(every) > 10
    assert every == called


@pytest.fixture
def new_folder(tmp_path, monkeypatch):
    """A folder where no kernel is kept yet, and the program of the process that compiles."""
    monkeypatch.setattr(ahead, "kept_in", lambda: tmp_path)
    return tmp_path


def test_a_block_ends_when_the_process_that_compiles_has_ended(new_folder, monkeypatch):
    monkeypatch.setattr(
        ahead, "_PROGRAM", f"import time; time.sleep(.3); open({str(new_folder / 'all')!r}, 'w')"
    )
    with ahead.compiled_meanwhile("cpu"):
        assert not (new_folder / "all").exists()
    assert (new_folder / "all").exists()


def test_no_process_compiles_what_is_kept_or_what_another_device_needs_not(new_folder, monkeypatch):
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: pytest.fail("a process was started"))
    with ahead.compiled_meanwhile("cuda"):
        pass
    (new_folder / "all").touch()
    with ahead.compiled_meanwhile("cpu"):
        pass


def test_an_error_in_the_block_does_not_wait_for_the_process_that_compiles(new_folder, monkeypatch):
    monkeypatch.setattr(ahead, "_PROGRAM", "import time; time.sleep(100)")
    with pytest.raises(ValueError, match="damaged"), ahead.compiled_meanwhile("cpu"):
        raise ValueError("damaged")


def test_the_process_that_compiles_ends_with_the_one_that_asked(new_folder):
    program = "from v2hdm.adjust import ahead\nahead.use_kernels = lambda: __import__('time').sleep(100)\n"
    command = [sys.executable, "-c", program + "ahead.compile_kernels()"]
    process = subprocess.Popen(command, stdin=subprocess.PIPE)
    process.stdin.close()
    assert process.wait(60) == 1
