"""How fluently the report's map pans and zooms: frames a second over a site of many markings.

    python -m tests.benchmarks.report_map --markings 10000

A frame is what ``requestAnimationFrame`` counts while the mouse drags and the wheel turns; ``longest`` is the
longest wait for one. The page is also timed: first paint, and the map drawn.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from tests.report.page.browser import browser_path, opened
from tests.report.page.folder import make_site
from v2hdm.report.page.document import write_page

_COUNT = """() => {
    window.frames_ms = [];
    const step = (now) => { window.frames_ms.push(now); window.counting = requestAnimationFrame(step); };
    window.counting = requestAnimationFrame(step);
}"""
_STOP = "() => { cancelAnimationFrame(window.counting); return window.frames_ms; }"


def main() -> None:
    """Print one line a movement."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--markings", type=int, default=10_000)
    parser.add_argument("--trace", type=Path, help="where a playwright trace goes")
    parsed = parser.parse_args()
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        make_site(Path(folder) / "site", parsed.markings)
        path = write_page(Path(folder) / "site", None)
        browser = playwright.chromium.launch(executable_path=browser_path(), args=["--no-sandbox"])
        with opened(browser, path) as watched:
            page = watched.page
            paint_ms = page.evaluate("performance.getEntriesByName('first-contentful-paint')[0].startTime")
            drawn_ms = float(page.evaluate("document.getElementById('map').dataset.ready"))
            print(
                f"{parsed.markings} markings, {path.stat().st_size / 1e6:.1f} MB: first paint "
                f"{paint_ms:.0f} ms, map drawn {drawn_ms:.0f} ms"
            )
            page.locator("#map").scroll_into_view_if_needed()
            box = page.locator("#map").bounding_box()
            middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
            if parsed.trace:
                page.context.tracing.start(screenshots=True)
            for name, zoom in (("whole site", None), ("near", 4)):
                if zoom is not None:
                    page.evaluate(f"window.v2hdmMap.map.setZoom({zoom}, {{ animate: false }})")
                    page.wait_for_timeout(500)
                _report(f"pan, {name}", page, lambda: _pan(page, middle))
                _report(f"zoom, {name}", page, lambda: _zoom(page, middle))
            if parsed.trace:
                page.context.tracing.stop(path=parsed.trace)
        browser.close()


def _report(name: str, page: Any, move: Any) -> None:
    page.evaluate(_COUNT)
    begin_s = time.perf_counter()
    move()
    took_s = time.perf_counter() - begin_s
    waits_ms = np.diff(page.evaluate(_STOP))
    print(
        f"{name}: {1e3 / waits_ms.mean():.0f} frames/s over {took_s:.1f} s; between frames: median "
        f"{np.median(waits_ms):.0f} ms, 95 % {np.percentile(waits_ms, 95):.0f} ms, "
        f"longest {waits_ms.max():.0f} ms"
    )


def _pan(page: Any, middle: tuple[float, float]) -> None:
    for turn in range(4):
        page.mouse.move(*middle)
        page.mouse.down()
        side = 1 if turn % 2 else -1
        page.mouse.move(middle[0] + side * 180, middle[1] + side * 120, steps=30)
        page.mouse.up()
        page.wait_for_timeout(300)


def _zoom(page: Any, middle: tuple[float, float]) -> None:
    page.mouse.move(*middle)
    for amount in (-240, -240, 240, 240):
        page.mouse.wheel(0, amount)
        page.wait_for_timeout(600)


if __name__ == "__main__":
    main()
