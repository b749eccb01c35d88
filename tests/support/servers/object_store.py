"""An S3 server (moto) on loopback."""

from collections.abc import Iterator
from contextlib import contextmanager
from uuid import uuid4

import obstore
from obstore.store import S3Store

VARIABLES = {
    "AWS_ACCESS_KEY_ID": "test",
    "AWS_SECRET_ACCESS_KEY": "test",
    "AWS_REGION": "us-east-1",
    "AWS_ALLOW_HTTP": "true",
}


@contextmanager
def server(port: int = 0) -> Iterator[str]:
    """Run a server, by default on a free port; yields its URL. Its objects belong to this process and outlast it."""
    from moto.server import ThreadedMotoServer  # tests of object stores only: importing it takes a second

    running = ThreadedMotoServer(ip_address="127.0.0.1", port=port, verbose=False)
    running.start()
    host, port = running.get_host_and_port()
    listener = running._server
    assert listener is not None
    try:
        yield f"http://{host}:{port}"
    finally:
        running.stop()
        listener.server_close()


def variables(endpoint: str) -> dict[str, str]:
    """Environment variables with which obstore uses the server."""
    return VARIABLES | {"AWS_ENDPOINT_URL": endpoint}


@contextmanager
def refusing_credentials(endpoint: str) -> Iterator[None]:
    """Let the server check credentials, of which it knows none."""
    import httpx

    httpx.post(f"{endpoint}/moto-api/reset-auth", content=b"0").raise_for_status()
    try:
        yield
    finally:
        httpx.post(f"{endpoint}/moto-api/reset-auth", content=b"inf").raise_for_status()


def create_bucket(endpoint: str) -> str:
    """Create a bucket; returns the URL of a prefix in it."""
    import httpx

    name = f"bucket-{uuid4().hex}"
    httpx.put(f"{endpoint}/{name}").raise_for_status()
    return f"s3://{name}/prefix"


def put(url: str, key: str, content: bytes) -> None:
    """Replace an object."""
    obstore.put(S3Store.from_url(url), key, content)


def get(url: str, key: str) -> bytes:
    """The content of an object."""
    return bytes(obstore.get(S3Store.from_url(url), key).bytes())


def delete(url: str, key: str) -> None:
    """Delete an object."""
    obstore.delete(S3Store.from_url(url), key)


def keys(url: str) -> list[str]:
    """All keys below a URL."""
    return sorted(entry["path"] for page in obstore.list(S3Store.from_url(url)) for entry in page)
