"""A cached file is used only if its content has its digest, and the cache stays below its limit."""

import hashlib
import os
from pathlib import Path

from league.registry.storage.object_artifacts import DigestCache


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def test_a_file_is_fetched_once(tmp_path: Path) -> None:
    cache, fetched = DigestCache(tmp_path), iter([b"graph"])
    assert [cache.read(_digest(b"graph"), lambda: next(fetched)) for _ in range(2)] == [b"graph", b"graph"]


def test_a_damaged_file_is_fetched_again(tmp_path: Path) -> None:
    cache = DigestCache(tmp_path)
    cache.read(_digest(b"graph"), lambda: b"graph")
    (tmp_path / _digest(b"graph")).write_bytes(b"damaged")
    assert cache.read(_digest(b"graph"), lambda: b"graph") == b"graph"
    assert (tmp_path / _digest(b"graph")).read_bytes() == b"graph"


def test_content_with_another_digest_is_not_cached(tmp_path: Path) -> None:
    assert DigestCache(tmp_path).read(_digest(b"graph"), lambda: b"other") == b"other"
    assert list(tmp_path.iterdir()) == []


def test_the_oldest_files_are_removed_beyond_the_limit(tmp_path: Path) -> None:
    cache, contents = DigestCache(tmp_path, limit=20), [bytes([i]) * 10 for i in range(3)]
    for i, content in enumerate(contents[:2]):
        cache.read(_digest(content), lambda content=content: content)  # type: ignore[misc]
        os.utime(tmp_path / _digest(content), (i, i))
    cache.read(_digest(contents[2]), lambda: contents[2])
    assert {path.name for path in tmp_path.iterdir()} == {_digest(content) for content in contents[1:]}
