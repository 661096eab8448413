"""The documentation's site builds without a warning, and asks no other machine for anything."""

import os
import re
import subprocess
import sys
import tomllib

import pytest

from tests.docs.blocks import ROOT, module_at
from tests.report.page.browser import browser_path, opened

_LOADED = re.compile(r"""<(?:script|link|img|iframe|source|video)\b[^>]*\b(?:src|href)=["']?(https?:|//)""")
_IMPORTED = re.compile(r"""(?:url\(|@import)\s*["']?(?:https?:|//)""")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    pytest.importorskip("zensical", reason="no zensical: pip install 'v2hdm[docs]'")
    folder = tmp_path_factory.mktemp("built") / "site"
    built = subprocess.run(
        [sys.executable, str(ROOT / "docs" / "tools" / "site.py"), str(folder)],
        cwd=ROOT, capture_output=True, text=True, timeout=120, env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert built.returncode == 0, built.stdout + built.stderr
    assert "No issues found" in built.stderr
    return folder


def test_every_page_is_built_and_in_the_navigation(site):
    listed = set(re.findall(r"[\w-]+\.md", (ROOT / "zensical.toml").read_text()))
    pages = {path.name for path in (ROOT / "docs").glob("*.md")}
    assert pages <= listed
    for page in listed:
        assert (site / page).with_suffix(".html").stat().st_size > 5000, page


def test_no_page_loads_anything_from_another_machine(site):
    for path in [*site.rglob("*.html"), *site.rglob("*.css"), *site.rglob("*.svg")]:
        text = path.read_text(encoding="utf-8")
        assert not _LOADED.search(text), path
        assert not _IMPORTED.search(text), path
    # The theme's script fetches these for what no page of ours may hold.
    for page in site.rglob("*.html"):
        assert 'class="mermaid"' not in page.read_text(encoding="utf-8"), page
    project = tomllib.loads((ROOT / "zensical.toml").read_text())["project"]
    assert not {"repo_url", "extra_javascript", "extra_css"} & set(project)
    assert "offline" not in project["plugins"]


def test_pages_of_the_repository_lead_to_each_other(site):
    assert 'href="contributing.html"' in (site / "design.html").read_text()
    assert 'href="your-drive.html"' in (site / "index.html").read_text()
    assert not list(site.rglob("*.py"))


def test_a_browser_draws_the_site_and_asks_for_nothing_outside(site):
    path = browser_path()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        for page in ("index.html", "design.html"):
            with opened(launched, site / page) as watched:
                assert all(url.startswith(("file:", "data:", "blob:")) for url in watched.requests)
                assert watched.page.locator("h1").count() == 1
        launched.close()


@pytest.fixture(scope="module")
def floors():
    return module_at(ROOT / "docs" / "tools" / "floors.py")


def test_the_drawn_floors_are_those_of_the_contracts(floors):
    assert (ROOT / "docs" / "floors.svg").read_text() == floors.draw(), (
        "the contracts have changed: python docs/tools/floors.py"
    )
    drawn = re.findall(r"<text[^>]*>([^<]+)</text>", floors.draw())
    parts = {path.stem for path in (ROOT / "v2hdm").iterdir() if path.suffix == ".py" or path.is_dir()}
    assert parts - {"__init__", "__pycache__", "conf"} <= {name.split(".")[0] for name in drawn}


def test_a_link_to_nowhere_stops_the_build():
    tool = module_at(ROOT / "docs" / "tools" / "site.py")
    text = tool.page_text("docs/check.md", "[a](check.md#x) [b](../pyproject.toml) [c](../README.md)")
    assert text == "[a](check.md#x) b [c](index.md)"
    with pytest.raises(tool.BrokenLinkError, match=r"docs/check\.md: links to gone\.md"):
        tool.page_text("docs/check.md", "[a](gone.md)")


def test_a_link_to_a_heading_that_is_gone_stops_the_build(tmp_path, monkeypatch):
    pytest.importorskip("zensical", reason="no zensical: pip install 'v2hdm[docs]'")
    tool = module_at(ROOT / "docs" / "tools" / "site.py")
    tool.write_project(tmp_path)
    page = tmp_path / "docs" / "check.md"
    page.write_text(page.read_text() + "\n[a](bags.md#no-such-heading)\n")
    assert tool.zensical_build(tmp_path).returncode != 0


def test_examples_in_docstrings_are_shown_as_code(site):
    assert '<span class="gp">&gt;&gt;&gt; </span>' in (site / "api.html").read_text()


def test_settings_are_listed_with_their_meaning_and_range(site):
    text = (site / "api.html").read_text()
    assert (
        "longest gap between poses to interpolate across; images in a longer one are dropped; more than 0."
        in text
    )
    assert "Annotated" not in text
