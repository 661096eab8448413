"""Compiles kernels into the wheel, where a compiler is there; without one numpy and numba do the work.

``python hatch_build.py`` compiles them in place.
"""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
import sysconfig
import tempfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

_ROOT = Path(__file__).resolve().parent
_PACKAGE = _ROOT / "v2hdm" / "native"
_NAME = "_kernels"

# From this version on one file serves all later ones: nanobind needs parts of its stable interface.
_STABLE = (3, 12)
_IS_STABLE = sys.version_info >= _STABLE and not sysconfig.get_config_var("Py_GIL_DISABLED")

_LONGEST_REASON = 300  # characters of what a compiler said that are told

_UNIX = [
    "-std=c++17", "-O3", "-fvisibility=hidden", "-fno-strict-aliasing", "-g0", "-w",
    # Sums may be taken in any order; not-a-number and infinity stay what they are.
    "-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros", "-fassociative-math",
]  # fmt: skip
_WINDOWS = ["/std:c++17", "/O2", "/EHsc", "/w"]


class KernelBuild(BuildHookInterface):  # type: ignore[type-arg]
    """Adds the compiled file to a wheel, and sets the wheel's tag; an editable install finds it in place."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile; what goes wrong is told in a line, and the wheel is one for any machine."""
        del version
        try:
            compiled = compile_kernels()
        except (Exception, SystemExit) as error:  # setuptools ends the process where it finds no compiler
            reason = " ".join(str(error).split())[:_LONGEST_REASON] or type(error).__name__
            self.app.display_warning(f"v2hdm: detection will run in numpy, nothing was compiled: {reason}")
            return
        build_data["artifacts"].append(compiled.relative_to(_ROOT).as_posix())
        build_data["pure_python"] = False
        if _IS_STABLE:
            platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
            build_data["tag"] = f"cp{_STABLE[0]}{_STABLE[1]}-abi3-{platform}"
        else:
            build_data["infer_tag"] = True


def compile_kernels() -> Path:
    """The file with the kernels, beside their sources, made anew if they changed; raises what goes wrong."""
    sources = runpy.run_path(str(_PACKAGE / "sources.py"))["digest"](_PACKAGE / "src")
    place = _PACKAGE / (_NAME + _suffix())
    if place.exists() and _sources_of(place) == sources:
        return place
    with tempfile.TemporaryDirectory() as folder:
        made = _made(sources, folder)
        if _sources_of(made) != sources:
            raise ImportError(f"{made.name} was made but cannot be loaded")
        # In one step: another process may be about to load it.
        beside = place.with_name(f"{place.name}.{os.getpid()}")
        beside.write_bytes(made.read_bytes())
        beside.replace(place)
    return place


def _suffix() -> str:
    suffix = str(sysconfig.get_config_var("EXT_SUFFIX"))
    if not _IS_STABLE:
        return suffix
    return Path(suffix).suffix if sys.platform == "win32" else ".abi3.so"


def _sources_of(file: Path) -> str:
    """The digest of the sources that a file was made of, "" where it cannot be loaded."""
    # The folder by name: pipx sets PYTHONSAFEPATH, under which the working directory is not looked at.
    program = f"import sys; sys.path.insert(0, sys.argv[1]); import {_NAME}; print({_NAME}.SOURCES)"
    command = [sys.executable, "-c", program, str(file.parent)]
    done = subprocess.run(command, capture_output=True, text=True)
    return done.stdout.strip()


def _made(sources: str, folder: str) -> Path:
    """The file with the kernels, compiled in a folder."""
    import nanobind
    from setuptools import Distribution, Extension

    library = Path(nanobind.source_dir())
    macros: list[tuple[str, str | None]] = [("V2HDM_SOURCES", f'"{sources}"'), ("NDEBUG", None)]
    if _IS_STABLE:
        macros.append(("Py_LIMITED_API", f"0x{_STABLE[0]:02x}{_STABLE[1]:02x}0000"))
    extension = Extension(
        _NAME,
        [*map(str, sorted((_PACKAGE / "src").glob("*.cpp"))), str(library / "nb_combined.cpp")],
        include_dirs=[nanobind.include_dir(), str(library.parent / "ext" / "robin_map" / "include")],
        define_macros=macros,
        extra_compile_args=_WINDOWS if sys.platform == "win32" else _UNIX,
        language="c++",
        py_limited_api=_IS_STABLE,
    )
    distribution = Distribution(
        {"name": "v2hdm", "ext_modules": [extension], "cmdclass": {"build_ext": _build_ext()}}
    )
    command = distribution.get_command_obj("build_ext")
    command.build_lib = command.build_temp = folder
    with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere):
        command.ensure_finalized()
        command.run()
    return Path(command.get_ext_fullpath(_NAME))


def _build_ext() -> type[Any]:
    """A command of setuptools that compiles as many sources of an extension at once as there are cores."""
    from setuptools.command.build_ext import build_ext

    class BuildExt(build_ext):
        def build_extensions(self) -> None:
            compile_in_turn = self.compiler.compile

            def compile_at_once(sources: list[str], **options: Any) -> list[str]:
                with ThreadPoolExecutor(os.cpu_count()) as pool:
                    compiled = pool.map(lambda source: compile_in_turn([source], **options), sources)
                    return [path for paths in compiled for path in paths]

            self.compiler.compile = compile_at_once
            super().build_extensions()

    return BuildExt


if __name__ == "__main__":
    print(compile_kernels())
