"""Fixtures of tests that read drives."""

import pytest

from tests.drive.example import make_drive


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The example drive as a folder."""
    root = tmp_path_factory.mktemp("folder")
    make_drive(root)
    return root


@pytest.fixture
def working_directory(tmp_path, monkeypatch):
    """The test's own folder as the working directory, so that nothing is cached beside the repository."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(autouse=True)
def unpictured(monkeypatch):
    """``v2hdm check`` draws nothing: its pictures, half of its time, are asserted in tests/verdict."""
    monkeypatch.setattr("v2hdm.verdict.check.draw_check", lambda *_: None)
