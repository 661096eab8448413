"""A result that is served to a browser, or to requests."""

import threading

import pytest

from tests.report.page.folder import make_result
from v2hdm.report.view.server import server_of
from v2hdm.report.view.session import file_beside


@pytest.fixture
def served(tmp_path):
    """The address of a result, the result, and its file of corrections."""
    drive = make_result(tmp_path)
    folder = tmp_path / "result"
    server, address, _ = server_of(folder, drive, file_beside(folder))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield address, folder, file_beside(folder)
    server.shutdown()
    server.server_close()
    thread.join()
