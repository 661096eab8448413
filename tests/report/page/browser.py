"""A page in the distribution's Chromium, watched."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


@dataclass
class Watched:
    """An open page, the errors on its console, and what it asked for."""

    page: Any
    said: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)


def browser_path() -> str:
    """Where Chromium is; the test is skipped where there is none, or no playwright."""
    pytest.importorskip("playwright", reason="no playwright: pip install playwright")
    path = next((executable for executable in map(shutil.which, BROWSERS) if executable), None)
    if path is None:
        pytest.skip(f"no browser: none of {', '.join(BROWSERS)} is installed")
    return path


@contextmanager
def opened(
    browser: Any, path: Path | str, width: int = 1280, height: int = 800, scheme: str = "light"
) -> Iterator[Watched]:
    """The page at ``path``, drawn."""
    context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme)
    watched = Watched(context.new_page())
    watched.page.on(
        "console", lambda message: watched.said.append(message.text) if message.type == "error" else None
    )
    watched.page.on("pageerror", lambda error: watched.said.append(str(error)))
    watched.page.on("request", lambda request: watched.requests.append(request.url))
    watched.page.goto(path if isinstance(path, str) else path.as_uri())
    yield watched
    context.close()
