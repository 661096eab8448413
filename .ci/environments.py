"""Environments with some of the packages that this one has, made in a second: the packages are linked.

pip has installed this environment by the same constraints, so that another one has the same versions. What a
distribution needs is read of its metadata, as pip reads it; no other package can be imported there.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterable
from dataclasses import dataclass, field
from importlib.metadata import Distribution, distribution, distributions
from pathlib import Path

from packaging.requirements import Requirement


@dataclass
class Environment:
    """A Python with some packages: in its folder, or in folders of packages on top of another."""

    python: Path
    needed: dict[str, Distribution]
    packages: list[Path] = field(default_factory=list)

    @classmethod
    def new(cls, folder: Path, wheel: Path, *extras: str) -> Environment:
        """An environment with a wheel, what it needs, and no pip: that of this Python installs the wheel."""
        subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
        python = folder / "bin" / "python"
        pip = [sys.executable, "-m", "pip", "--python", python, "--quiet", "--disable-pip-version-check"]
        subprocess.run([*pip, "install", "--no-deps", "--no-compile", wheel], check=True)
        site = Path(sysconfig.get_path("purelib", "venv", {"base": str(folder), "platbase": str(folder)}))
        (installed,) = distributions(name="v2hdm", path=[str(site)])
        needed = closure(requirements(installed, ("", *extras)))
        link(needed.values(), site)
        subprocess.run([*pip, "check"], check=True)
        return cls(python, needed)

    def beside(self, folder: Path, *asked: str) -> Environment:
        """This environment with packages beside those that it has."""
        all_asked = closure(map(Requirement, asked))
        more = {name: all_asked[name] for name in all_asked.keys() - self.needed.keys()}
        assert more, f"{', '.join(asked)}: no more than the environment has"
        link(more.values(), folder)
        return Environment(self.python, self.needed | more, [folder])

    def run(self, line: str, here: Path) -> subprocess.CompletedProcess[str]:
        """Run a line of shell in which ``v2hdm`` and ``python`` are this environment's."""
        path = f"{self.python.parent}:/usr/bin:/bin"
        variables = {"PATH": path, "HOME": str(here), "OMP_NUM_THREADS": "1", "MPLBACKEND": "agg"}
        variables |= {"PYTHONPATH": os.pathsep.join(map(str, self.packages))} if self.packages else {}
        return subprocess.run(["bash", "-c", line], cwd=here, env=variables, capture_output=True, text=True)


def requirements(of: Distribution, extras: Iterable[str]) -> list[Requirement]:
    """A distribution's requirements on this machine, with extras; the extra "" is the distribution alone."""
    listed = [Requirement(text) for text in of.requires or ()]
    return [
        requirement
        for requirement in listed
        if requirement.marker is None
        or any(requirement.marker.evaluate({"extra": extra}) for extra in extras)
    ]


def closure(asked: Iterable[Requirement]) -> dict[str, Distribution]:
    """The distributions of this environment that requirements ask for, with all that these need, by name."""
    needed: dict[str, Distribution] = {}
    looked_at: set[str] = set()
    waiting = list(asked)
    while waiting:
        requirement = waiting.pop()
        if str(requirement) in looked_at:
            continue
        looked_at.add(str(requirement))
        installed = distribution(requirement.name)
        version = installed.version
        assert requirement.specifier.contains(version, prereleases=True), f"{requirement}: {version}"
        needed[installed.metadata["Name"]] = installed
        waiting += requirements(installed, ("", *requirement.extras))
    return needed


def link(linked: Iterable[Distribution], folder: Path) -> None:
    """Link what distributions have installed, but for their programs, into a folder."""
    for package in linked:
        assert package.files, f"{package.metadata['Name']}: pip has kept no list of its files"
        for file in package.files:
            if ".." not in file.parts:
                source = Path(str(package.locate_file(file)))
                _link(source, folder / file)
                # What this Python has compiled of the file holds for the link, which has the same time.
                if source.suffix == ".py" and ".dist-info" not in file.parts[0]:
                    compiled = Path(importlib.util.cache_from_source(str(source)))
                    _link(compiled, folder / file.parent / "__pycache__" / compiled.name)


def _link(source: Path, target: Path) -> None:
    if not source.is_file() or target.exists():
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:  # another disk
        shutil.copy2(source, target)
