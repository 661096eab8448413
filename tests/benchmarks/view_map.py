"""How fast ``v2hdm view`` is over a site of many markings, and how long its corrections wait.

    python -m tests.benchmarks.view_map --markings 20000

First paint, the map's, and all ready count from the request for the page; ``prepared`` is the server's time
to read the result and draw the document before that. A frame is what ``requestAnimationFrame`` counts while
the mouse drags. Ten corrections are made by keys; each waits until the page says that it is saved. With
``--axe FILE`` (axe.min.js of npm's axe-core) it lists what axe finds.
"""

from __future__ import annotations

import argparse
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.benchmarks.report_map import _COUNT, _STOP
from tests.report.page.browser import browser_path, opened
from tests.report.page.folder import make_site
from v2hdm.report.view.server import server_of
from v2hdm.report.view.session import file_beside

_STEPS = 90  # movements of the mouse in a measurement: some seconds


def main() -> None:
    """Print one line a figure."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--markings", type=int, default=20_000)
    parser.add_argument("--axe", type=Path)
    parsed = parser.parse_args()
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        site = Path(folder) / "site"
        make_site(site, parsed.markings)
        started_s = time.process_time()
        server, address, _ = server_of(site, None, file_beside(site))
        server.prepare()
        print(f"{parsed.markings} markings: prepared in {time.process_time() - started_s:.2f} s of CPU")
        threading.Thread(target=server.serve_forever, daemon=True).start()
        browser = playwright.chromium.launch(executable_path=browser_path(), args=["--no-sandbox"])
        with opened(browser, address) as watched:
            _measure(watched.page, parsed.axe)
            print(f"console errors: {watched.said}")
        server.shutdown()


def _measure(page: Any, axe: Path | None) -> None:
    page.wait_for_selector("html[data-ready]")
    paint_ms = page.evaluate("performance.getEntriesByName('first-contentful-paint')[0].startTime")
    drawn_ms = float(page.evaluate("document.documentElement.dataset.ready"))
    map_ms = float(page.evaluate("document.getElementById('map').dataset.first"))
    print(f"first paint {paint_ms:.0f} ms, of the map {map_ms:.0f} ms, all ready {drawn_ms:.0f} ms")
    box = page.locator("#map").bounding_box()
    middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    _frames("pan, whole site", page, lambda: _drag(page, middle))
    page.keyboard.press("n")
    page.evaluate("window.v2hdmView.show(window.v2hdmView.model.features[10050])")
    page.wait_for_timeout(300)
    _frames("drag a marking, near", page, lambda: _drag(page, middle))
    page.evaluate("{ const { view, drawing } = window.v2hdmView; view.scale = 6; drawing.change(); }")
    page.wait_for_timeout(300)
    _frames("drag a marking among thousands", page, lambda: _drag(page, middle))
    page.keyboard.press("Escape")
    page.evaluate("window.v2hdmView.select(null)")
    _frames("pan, thousands in view", page, lambda: _drag(page, middle))
    page.locator("#map").focus()
    waits_s = []
    for key in ("a", "Delete", "r", "Shift+R", "ArrowUp", "Shift+ArrowUp", "1", "i", "z", "y"):
        number = len(waits_s)
        page.evaluate(f"window.v2hdmView.show(window.v2hdmView.model.features[{100 + number}])")
        page.locator("#map").focus()
        started_s = time.perf_counter()
        page.keyboard.press(key)
        if key in ("1", "i"):
            page.keyboard.press("ArrowUp" if key == "1" else "Enter")
        page.locator("#saved", has_text="all saved").wait_for()
        waits_s.append(time.perf_counter() - started_s)
    print("ten corrections, s each until saved:", ", ".join(f"{wait_s:.2f}" for wait_s in waits_s))
    if axe is not None:
        page.evaluate(axe.read_text())
        for state in ("selected", "with keys"):
            result = page.evaluate("axe.run()")
            violations = [(rule["id"], rule["impact"], len(rule["nodes"])) for rule in result["violations"]]
            print(f"axe, {state}: {len(result['passes'])} rules pass, violations {violations}")
            page.keyboard.press("?")


def _drag(page: Any, middle: tuple[float, float]) -> None:
    page.mouse.move(*middle)
    page.mouse.down()
    for step in range(_STEPS):
        angle = 2 * np.pi * step / _STEPS
        page.mouse.move(middle[0] + 150 * np.sin(angle), middle[1] + 100 * (1 - np.cos(angle)))
    page.mouse.up()


def _frames(name: str, page: Any, act: Callable[[], None]) -> None:
    page.evaluate(_COUNT)
    act()
    frames_ms = np.array(page.evaluate(_STOP))
    waits_ms = np.diff(frames_ms)
    print(f"{name}: {1e3 / waits_ms.mean():.0f} frames a second, longest wait {waits_ms.max():.0f} ms")


if __name__ == "__main__":
    main()
