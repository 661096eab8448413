"""The site's hook: pages of the repository outside of ``docs/`` are pages of the site, too.

A link is written as it works in the repository. Where its target is a page or a file of the site, it leads
there; of any other file of the repository the site shows the name.
"""

from __future__ import annotations

import os
import re
from pathlib import Path, PurePosixPath
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "CHANGELOG.md": "changelog.md",
    "train/README.md": "training.md",
    "models/README.md": "model-card.md",
}
"""Files of the repository, and which page of the site each is."""

_LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!https?:|mailto:|#)([^)#\s]+)(#[^)]*)?\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that lie outside of ``docs/``."""
    for source, page in PAGES.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text(encoding="utf-8")))
    return files


def on_page_markdown(markdown: str, page: Page, files: Files, **_: Any) -> str:
    """Lead the page's links to where the site has their targets.

    Raises:
        PluginError: the repository has no such file.
    """
    in_repository = {page: source for source, page in PAGES.items()}
    uri = page.file.src_uri
    source = PurePosixPath(in_repository.get(uri, f"docs/{uri}"))

    def led(link: re.Match[str]) -> str:
        image, text, target, anchor = link.groups()
        path = os.path.normpath(source.parent / target)
        if not (ROOT / path).exists():
            raise PluginError(f"{source}: links to {target}, which is not in the repository")
        place = PAGES.get(path, path.removeprefix("docs/"))
        if files.get_file_from_path(place) is None:
            return text
        return f"{image}[{text}]({os.path.relpath(place, PurePosixPath(uri).parent)}{anchor or ''})"

    return _LINK.sub(led, markdown)
