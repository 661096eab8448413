"""The commands: a list of them, their versions, and one line for Ctrl-C or a missing library."""

import errno
import io
import os
import re
import resource
import signal
import subprocess
import sys
import time
import tomllib
from contextlib import suppress
from dataclasses import replace
from importlib import metadata
from pathlib import Path

import pytest
import yaml

from tests.docs.processes import python_in
from v2hdm import __version__
from v2hdm.cli.main import all_commands, command_of, run, version_line
from v2hdm.progress import patient

ROOT = Path(__file__).parents[1]
COMMANDS = all_commands()
PRESSED_TWICE = """
import os, signal, time
try:
    os.kill(os.getpid(), signal.{signal})
    time.sleep(9)
finally:
    os.kill(os.getpid(), signal.{signal})
    time.sleep(0.01)
"""


def run_command(folder, *arguments, **variables):
    """A command that finds modules of ``folder`` in place of those of the same name."""
    environment = os.environ | {"PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"} | variables
    command = [sys.executable, "-m", *arguments]
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=60, check=False
    )


NEEDED = {
    "v2hdm map +run=port2": ("map", "torch", "kornia"),
    "v2hdm experiment": ("map", "torch", "matplotlib"),
    "v2hdm simulate +run=port2": ("map", "omegaconf", "omegaconf"),
    "v2hdm check drive": ("map", "cv2", "matplotlib"),
    "v2hdm calibrate points points.csv --intrinsics a.yaml": ("map", "torch", "kornia"),
    "v2hdm mosaic outputs/port2": ("map", "cv2", "jinja2"),
    "v2hdm report results": ("map", "cv2", "jinja2"),
    "v2hdm fleet drive.yaml": ("map", "omegaconf", "omegaconf"),
    "v2hdm detect images": ("", "cv2", ""),
    "v2hdm export map.geojson --format csv": ("", "cv2", ""),
    "train": ("train", "torch", "tensorboard"),
    "train.areas": ("train", "torch", "torch"),
    "train.score": ("train", "torch", "torch"),
    "train.ship runs/gpu": ("train", "onnx", "onnx"),
    "export checkpoint=a output=b": ("train", "onnx", "onnx"),
}
"""By command line: the extra that it needs, a library that it loads, and one that the base install lacks."""


@pytest.mark.parametrize("number", range(len(NEEDED)))
def test_an_interruption_while_libraries_are_loaded_is_one_line(number, tmp_path):
    line, (_, slow, _) = list(NEEDED.items())[number]
    signal = "SIGINT" if number % 2 else "SIGTERM"
    (tmp_path / f"{slow}.py").write_text(PRESSED_TWICE.format(signal=signal))
    process = run_command(tmp_path, *line.split())
    assert process.returncode == 2, process.stderr
    assert process.stderr.startswith("error: interrupted")
    assert process.stderr.count("\n") == 1


@pytest.fixture(scope="module")
def quick_python(tmp_path_factory):
    """A Python that has loaded what a command needs but its modules, which takes a second a command."""
    with python_in(tmp_path_factory.mktemp("python")) as programs:
        yield programs / "python"


WITHOUT = """
import runpy, sys
missing, module, *words = sys.argv[1:]
for name in list(sys.modules):
    if name.split(".")[0] in ("v2hdm", "train", "export") or missing in name.split("."):
        del sys.modules[name]
sys.path.insert(0, "")
sys.argv = [module, *words]
runpy.run_module(module, run_name="__main__", alter_sys=True)
"""
"""Runs a module as a new process does, in whose working directory lies what takes a library's place."""


@pytest.mark.parametrize("line", [line for line, (extra, *_) in NEEDED.items() if extra])
def test_a_library_that_is_not_installed_is_one_line_that_names_the_extra(line, quick_python, tmp_path):
    extra, _, missing = NEEDED[line]
    text = f'raise ModuleNotFoundError("not installed", name="{missing}")'
    (tmp_path / f"{missing}.py").write_text(text)
    command = [quick_python, "-c", WITHOUT, missing, *line.split()]
    process = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
    assert process.returncode == 2, process.stderr
    of_command = [f"v2hdm {name}" for name in COMMANDS if line.startswith(f"v2hdm {name}")]
    (called,) = of_command or [f"python -m {line.split()[0]}"]
    assert process.stderr.startswith(f"error: {called} needs {missing}: install the {extra} extra")
    assert process.stderr.count("\n") == 1


@pytest.mark.parametrize(
    "arguments", [("v2hdm.map", "--help"), ("v2hdm", "detect", "--help"), ("v2hdm", "--help")]
)
def test_help_that_nobody_reads_to_its_end_is_no_error(arguments):
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as closed:
        process = subprocess.run(
            [sys.executable, "-m", *arguments], cwd=ROOT, stdout=closed, stderr=subprocess.PIPE, timeout=60
        )
    assert (process.returncode, process.stderr) == (0, b"")


def test_a_warning_is_one_line_whatever_name_of_a_file_is_in_it(tmp_path):
    program = "main(['--version']); logging.warning('%s: cut off', 'a\\x1b[2J\\nerror: b.avi')"
    command = [sys.executable, "-c", f"import logging; from v2hdm.cli.main import main; {program}"]
    process = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert process.stderr == "WARNING:root:a?[2J error: b.avi: cut off\n"


@pytest.mark.parametrize(
    ("dies", "says"),
    [
        (
            "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)",
            "ended by signal 11 under ulimit -v; not enough memory",
        ),
        ("raise ImportError('a.so: failed to map segment from shared object')", "not enough memory"),
        ("raise RuntimeError('std::bad_alloc')", "not enough memory"),
    ],
)
def test_libraries_that_die_for_want_of_memory_are_one_line_and_exit_code_2(dies, says, tmp_path):
    (tmp_path / "cv2.py").write_text(dies)
    _, most = resource.getrlimit(resource.RLIMIT_AS)
    process = subprocess.run(
        [sys.executable, "-m", "v2hdm", "detect", "a.jpg"],
        env=os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (2**40, most)),
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert (process.returncode, process.stderr.count("\n")) == (2, 1), process.stderr
    assert process.stderr.startswith(f"error: {says}")


WAITS = """
import os, pathlib, signal, time
{}
pathlib.Path("told").write_text(str(os.getpid()))
while True:
    time.sleep(1)
"""


@pytest.mark.parametrize("first", ["", "signal.signal(signal.SIGTERM, signal.SIG_IGN)"], ids=["tidy", "deaf"])
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGHUP, signal.SIGQUIT, signal.SIGTERM])
def test_a_command_under_a_limit_of_memory_ends_with_whoever_started_it(number, first, tmp_path):
    if first and number != signal.SIGKILL:
        pytest.skip("is the same whatever the signal")
    (tmp_path / "cv2.py").write_text(WAITS.format(first))
    _, most = resource.getrlimit(resource.RLIMIT_AS)

    def limit_and_listen() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (2**40, most))
        if number != signal.SIGKILL:
            signal.signal(number, signal.SIG_DFL)  # tests that run under nohup ignore some

    parent = subprocess.Popen(
        [sys.executable, "-m", "v2hdm", "detect", "a.jpg"],
        env=os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"}, cwd=tmp_path,
        preexec_fn=limit_and_listen,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    process_file = tmp_path / "told"
    wait_until(lambda: process_file.is_file() and process_file.read_text())
    child = Path("/proc", process_file.read_text())
    assert int(process_file.read_text()) != parent.pid
    parent.send_signal(number)
    assert parent.wait(30) in (-number, 2)
    wait_until(lambda: not child.exists() or ") Z " in (child / "stat").read_text())


def wait_until(is_so):
    end_s = time.monotonic() + 60
    while not is_so():
        assert time.monotonic() < end_s
        time.sleep(0.02)


class FullDisk(io.StringIO):
    def write(self, text):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_terminal_that_fails_stops_no_work_and_is_reported_at_its_end(monkeypatch, capsys):
    finished = []

    def work():
        out, error = patient(sys.stdout), patient(sys.stderr)
        for stream in (out, error):
            for _ in range(3):
                print("progress", file=stream, flush=True)
        finished.append("all of it")

    command = replace(COMMANDS["map"], run=lambda _: work())
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", FullDisk())
        assert command(()) == 2
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", FullDisk())
        assert command(()) == 0
    assert finished == ["all of it"] * 2
    assert "error: standard output, when all files were written: No space left" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("variable", "default"), [("OMP_WAIT_POLICY", "passive"), ("OPENBLAS_NUM_THREADS", "1")]
)
@pytest.mark.parametrize("setting", [None, "3"])
def test_waiting_threads_do_not_spin_unless_the_user_says_so(
    variable, default, setting, tmp_path, monkeypatch
):
    monkeypatch.delenv(variable, raising=False)
    for library in ("numpy", "torch"):  # whichever is loaded first, reads the variables
        (tmp_path / f"{library}.py").write_text(f"import os; raise SystemExit(os.environ[{variable!r}])")
    environment = {} if setting is None else {variable: setting}
    line = run_command(tmp_path, "v2hdm.map", "+run=port2", **environment).stderr.strip()
    assert line == (setting or default)


@pytest.mark.parametrize("number", ["-1.3e-05", "-2E3", "-.5", "-7", "-4."])
def test_a_negative_number_is_a_value_and_no_option_in_whatever_form(number):
    parser = command_of("localize").parser()
    parser.add_argument("--start", type=float, nargs=2)
    assert parser.parse_args(["--start", number, "1"]).start == [float(number), 1.0]


def test_the_list_has_a_sentence_for_each_command_and_each_file_declares_its_own(capsys):
    assert run([]) == 0
    lines = capsys.readouterr().out.splitlines()[2:]
    assert {line.split("  ")[1].strip() for line in lines} == set(COMMANDS)
    assert all(line.endswith(".") for line in lines)
    assert run(["calibrate"]) == 0
    assert capsys.readouterr().out.count("\n  calibrate ") == 3
    assert [command.name for command in COMMANDS.values()] == [f"v2hdm {name}" for name in COMMANDS]
    assert run(["calibrate", "pints"]) == 2
    assert (
        capsys.readouterr().err
        == "error: v2hdm calibrate pints: no such command; did you mean calibrate points? "
        "v2hdm --help lists them\n"
    )


@pytest.mark.parametrize("name", COMMANDS)
def test_help_explains_each_command_and_names_it(name, capsys):
    with suppress(SystemExit):  # of argparse
        assert run([*name.split(), "--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert f"v2hdm {name} " in text
    assert COMMANDS[name].says in text


@pytest.mark.parametrize("name", [name for name in COMMANDS if name not in ("map", "experiment", "simulate")])
@pytest.mark.parametrize("arguments", ["", "--no\x1b[2Jsuch"])
def test_arguments_that_are_missing_or_unknown_are_one_line_that_names_the_help(name, arguments, capsys):
    with pytest.raises(SystemExit, match="2"):
        run([*name.split(), *arguments.split()])
    error = capsys.readouterr().err
    assert re.fullmatch(rf"error: [ -~]+; see v2hdm {name} --help\n", error)


def test_help_says_what_a_key_is_without_its_name(capsys):
    assert run(["map", "--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "map.base (text or null, null) the map.geojson that the drive brings up to date." in text
    assert "drive.path (any, null) the drive's folder or bag, or a list of drives through one site, " in text


IMPORTS = """
import importlib, pkgutil, sys
from pathlib import Path
def loaded(*names): return set(names) & {name for name, module in sys.modules.items() if module}
import v2hdm
assert not loaded("numpy", "cv2", "torch", "scipy", "yaml", "v2hdm.errors"), "the library"
from v2hdm.cli.main import run
run([])
assert not loaded("numpy", "cv2", "torch", "hydra", "yaml"), "the list of commands"
missing = ["torch", "kornia", "hydra", "omegaconf", "scipy", "msgspec", "fsspec", "filelock"]
sys.modules.update(dict.fromkeys(missing))
import v2hdm.detect, v2hdm.detection.batch, v2hdm.detection.road, v2hdm.store
for one in pkgutil.iter_modules(v2hdm.store.__path__, "v2hdm.store."):
    importlib.import_module(one.name)
with v2hdm.store.results.growing_folder(Path("drawn"), "--draw") as add:
    add("a.jpg", b"a")
try: v2hdm.store.cache.StageCache(Path("cache")).key(1)
except v2hdm.errors.ConfigError as error: assert "install the map extra, pip" in str(error)
else: raise AssertionError("the cache needs msgspec")
for name in missing[4:]: del sys.modules[name]
import v2hdm.verdict.check
"""


def test_what_must_be_light_loads_nothing_heavy_and_the_base_install_is_enough_on_a_vehicle(tmp_path):
    """The library, help, the detector, the store and the checks, in one process from light to heavy."""
    (tmp_path / "probe.py").write_text(IMPORTS)
    process = run_command(tmp_path, "probe")
    assert process.returncode == 0, process.stderr
    assert (tmp_path / "drawn" / "a.jpg").is_file()


LOADED = """
import sys
import v2hdm.pipeline.map_drive
print(*sys.modules)
"""


def test_mapping_loads_no_writer_no_page_no_mosaic_no_renderer_and_no_statistics():
    process = subprocess.run(
        [sys.executable, "-c", LOADED], cwd=ROOT, capture_output=True, text=True, timeout=60, check=True
    )
    modules = process.stdout.split()
    unneeded = "io.maps.formats io.calibration.writing io.importers.bag report.page report.photos mosaic"
    for name in (*unneeded.split(), "simulate.render"):
        assert not [module for module in modules if f"{module}.".startswith(f"v2hdm.{name}.")], name
    assert "scipy.stats" not in modules


@pytest.mark.parametrize(
    "how", [["v2hdm"], ["v2hdm", "map"], ["v2hdm.map"], ["v2hdm", "calibrate", "ground"]]
)
def test_every_command_reports_the_version(how, tmp_path):
    line = f"v2hdm {re.escape(__version__)}, (torch|no torch).*, (onnxruntime|no onnx).*, (numba|no numba).*"
    version = run_command(tmp_path, *how, "--version").stdout
    assert re.fullmatch(
        line + ", weights [0-9a-f]{8}, kernels (compiled|in numpy and numba \\(.+\\))\n", version
    )


def test_a_version_is_told_where_libraries_are_missing(monkeypatch):
    def absent(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", absent)
    assert version_line().startswith(f"v2hdm {__version__}, no torch, no onnxruntime, no numba, weights ")


def test_every_file_that_states_the_version_states_the_same():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert "version" in project["dynamic"]  # the build takes it from v2hdm/__init__.py
    assert str(citation["version"]) == __version__
    assert f"\n## [{__version__}]" in (ROOT / "CHANGELOG.md").read_text()
    # The wheel holds a library of another licence; what one cites is ours.
    assert citation["license"] == project["license"].split(" AND ")[0]


def test_an_error_is_one_line_whatever_name_the_user_gave(capsys):
    assert run(["check", "\x1b[2Jno\nsuch\u202edrive"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert error.rstrip("\n").isprintable()
