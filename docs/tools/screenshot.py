"""Draws the picture of docs/report.md: ``python docs/tools/screenshot.py REPORT PICTURE``; needs Chromium."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from playwright.sync_api import sync_playwright

_SIZE = {"width": 1180, "height": 1330}


def draw(report: Path, picture: Path) -> None:
    """The top of a report, with its verdict and map."""
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        page = chromium.new_page(viewport=_SIZE)
        page.goto(report.resolve().as_uri())
        page.wait_for_timeout(500)
        page.screenshot(path=picture, type="jpeg", quality=82)


if __name__ == "__main__":
    draw(Path(sys.argv[1]), Path(sys.argv[2]))
