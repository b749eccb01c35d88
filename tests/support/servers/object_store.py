"""An S3 server (moto) on loopback."""

from collections.abc import Iterator
from contextlib import contextmanager
from uuid import uuid4

import obstore
from moto.server import ThreadedMotoServer
from obstore.store import S3Store

VARIABLES = {
    "AWS_ACCESS_KEY_ID": "test",
    "AWS_SECRET_ACCESS_KEY": "test",
    "AWS_REGION": "us-east-1",
    "AWS_ALLOW_HTTP": "true",
}


@contextmanager
def server() -> Iterator[str]:
    """Run a server; yields its URL."""
    running = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    running.start()
    host, port = running.get_host_and_port()
    try:
        yield f"http://{host}:{port}"
    finally:
        running.stop()


def variables(endpoint: str) -> dict[str, str]:
    """Environment variables with which obstore uses the server."""
    return VARIABLES | {"AWS_ENDPOINT_URL": endpoint}


def create_bucket(endpoint: str) -> str:
    """Create a bucket; returns the URL of a prefix in it."""
    import httpx

    name = f"bucket-{uuid4().hex}"
    httpx.put(f"{endpoint}/{name}").raise_for_status()
    return f"s3://{name}/prefix"


def put(url: str, key: str, content: bytes) -> None:
    """Replace an object."""
    obstore.put(S3Store.from_url(url), key, content)


def delete(url: str, key: str) -> None:
    """Delete an object."""
    obstore.delete(S3Store.from_url(url), key)


def keys(url: str) -> list[str]:
    """All keys below a URL."""
    return sorted(each["path"] for page in obstore.list(S3Store.from_url(url)) for each in page)
