"""A result that is served to a browser, or to requests."""

import threading
from contextlib import contextmanager

import pytest

from tests.report.page.folder import make_result
from v2hdm.report.view.server import server_of
from v2hdm.report.view.session import file_beside


@contextmanager
def serving(folder, drive):
    """The address of a result while it is served, the result, and its file of corrections."""
    server, address, _ = server_of(folder, drive, file_beside(folder))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield address, folder, file_beside(folder)
    server.shutdown()
    server.server_close()
    thread.join()


@pytest.fixture
def served(tmp_path):
    """The address of a result, the result, and its file of corrections."""
    with serving(tmp_path / "result", make_result(tmp_path)) as result:
        yield result
