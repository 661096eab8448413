"""Build the documentation's site: python docs/tools/site.py FOLDER.

Pages are those of ``docs/`` and some of the repository outside of it. A link is written as it works in the
repository. Where its target is a page or a file of the site, it leads there; of any other file of the
repository the site shows the name.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).parents[2]
PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "CHANGELOG.md": "changelog.md",
    "train/README.md": "training.md",
    "models/README.md": "model-card.md",
}
"""Files of the repository outside of ``docs/``, and which page of the site each is."""

_PICTURES = (".jpg", ".svg", ".ipynb")
"""Suffixes of the files in ``docs/`` that the site has besides its pages."""

_LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!https?:|mailto:|#)([^)#\s]+)(#[^)]*)?\)")


class BrokenLinkError(Exception):
    """A page links to a file that the repository does not have."""


def site_files() -> dict[str, str]:
    """Paths in the repository of all pages and pictures, and their names in the site."""
    files = {f"docs/{path.name}": path.name for path in (ROOT / "docs").iterdir()}
    shown = (".md", *_PICTURES)
    return {path: name for path, name in files.items() if path.endswith(shown)} | PAGES


def page_text(source: str, markdown: str) -> str:
    """A page's text, its links leading to where the site has their targets.

    ``source`` is the page's path in the repository. Raises BrokenLinkError.
    """
    files = site_files()

    def redirected(link: re.Match[str]) -> str:
        image, text, target, anchor = link.groups()
        path = os.path.normpath(PurePosixPath(source).parent / target)
        if not (ROOT / path).exists():
            raise BrokenLinkError(f"{source}: links to {target}, which is not in the repository")
        return f"{image}[{text}]({files[path]}{anchor or ''})" if path in files else text

    return _LINK.sub(redirected, markdown)


def write_project(folder: Path) -> None:
    """Write pages, pictures and settings into an empty folder, for zensical."""
    (folder / "docs").mkdir()
    for source, name in site_files().items():
        if name.endswith(".md"):
            text = page_text(source, (ROOT / source).read_text(encoding="utf-8"))
            (folder / "docs" / name).write_text(text, encoding="utf-8")
        else:
            shutil.copy(ROOT / source, folder / "docs" / name)
    for settings in (ROOT / "zensical.toml", ROOT / "docs" / "tools" / "api_pages.py"):
        shutil.copy(settings, folder)


def zensical_build(project: Path) -> subprocess.CompletedProcess[bytes]:
    """Build the site of a project into its folder ``site``; links to nowhere and other warnings fail."""
    return subprocess.run([sys.executable, "-m", "zensical", "build", "--strict"], cwd=project)


def build(target: Path) -> int:
    """Build the site into a folder that is replaced; returns zensical's exit code, 0 without any warning."""
    with tempfile.TemporaryDirectory() as name:
        project = Path(name)
        write_project(project)
        built = zensical_build(project)
        if built.returncode == 0:
            shutil.rmtree(target, ignore_errors=True)
            shutil.move(project / "site", target)
    return built.returncode


if __name__ == "__main__":
    try:
        sys.exit(build(Path(sys.argv[1]).resolve()))
    except BrokenLinkError as broken:
        sys.exit(str(broken))
