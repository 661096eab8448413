"""Stores to test against: one in memory, and an S3 server on this machine where moto is installed."""

import logging
import secrets
from collections.abc import Iterator
from typing import Any

import fsspec
import pytest

from v2hdm.store.remote import RemoteFolder


@pytest.fixture
def memory() -> Iterator[RemoteFolder]:
    """An empty store in memory."""
    yield RemoteFolder.at(f"memory://{secrets.token_hex(4)}/place", "output=")
    fsspec.filesystem("memory").store.clear()


@pytest.fixture(scope="session")
def s3() -> Iterator[Any]:
    """An S3 server on this machine with an empty bucket; its client."""
    pytest.importorskip("s3fs", reason="s3fs is not installed")
    server = pytest.importorskip("moto.server", reason="moto, with flask and flask-cors, is not installed")
    import boto3
    import s3fs

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    running = server.ThreadedMotoServer("127.0.0.1", port=0, verbose=False)
    running.start()
    url = f"http://127.0.0.1:{running.get_host_and_port()[1]}"
    variables = {
        "AWS_ENDPOINT_URL": url, "AWS_ACCESS_KEY_ID": "us", "AWS_SECRET_ACCESS_KEY": "secret",
        "AWS_DEFAULT_REGION": "us-east-1",
    }  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        for name, value in variables.items():
            patch.setenv(name, value)
        s3fs.S3FileSystem.clear_instance_cache()
        client = boto3.client("s3")
        client.create_bucket(Bucket="bucket")
        yield client
        client.close()
    s3fs.S3FileSystem.clear_instance_cache()
    running.stop()
