"""Calls that wait together are searched together, and an error of one does not concern the others."""

import asyncio
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from evaluation.service.search_service import SearchService
from league.registry.storage.rows import VersionRow
from league.search.policies import publish_search
from league.spaces import ACTION_MASK, OBSERVATION
from tests.support.leagues import tictactoe
from tests.support.policies.graphs import masked_mlp

pytestmark = pytest.mark.anyio
WAIT = 600.0
"""Seconds for which callers wait."""


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture
def version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[VersionRow]:
    monkeypatch.setenv("LEAGUE_HOME", str(tmp_path))
    registry = tictactoe.registry(tmp_path)
    base = tictactoe.publish(registry, masked_mlp((3, 3, 2), 9), value=masked_mlp((3, 3, 2), 9, has_value=True))
    league = registry.leagues.get(tictactoe.LEAGUE)
    yield publish_search(registry, base, league.config.environment, league.interface, "puct", 64)
    registry.close()


def board(first: int | None) -> dict[str, NDArray]:
    """The empty board, or that after the first move."""
    planes, mask = np.zeros((1, 9, 2), dtype=np.int8), np.ones((1, 9), dtype=np.int8)
    if first is not None:
        planes[0, first, 1], mask[0, first] = 1, 0
    return {OBSERVATION: planes.reshape(1, 3, 3, 2), ACTION_MASK: mask}


async def test_concurrent_calls_have_the_results_of_single_ones(version: VersionRow) -> None:
    service, key = SearchService(), (version.league, version.number, version.sha256)
    boards = [board(first) for first in (None, *range(9))]
    alone = [await service.search(*key, "shared", observations, None, WAIT, True) for observations in boards]
    full = board(None) | {OBSERVATION: np.ones((1, 3, 3, 2), dtype=np.int8)}
    calls = [service.search(*key, "shared", observations, None, WAIT, True) for observations in [*boards, full]]
    limited = service.search(*key, "shared", boards[0], 0.0, WAIT, False)
    *together, refused, early = await asyncio.gather(*calls, limited)
    for result, expected in zip(together, alone, strict=True):
        for name in ("actions", "visits", "lines"):
            assert np.array_equal(result[name], expected[name]), name
        assert np.allclose(result["values"], expected["values"])
    assert refused["code"] == "invalid_observation"
    assert 0 < early["visits"].sum() < 64


async def test_a_cancelled_call_does_not_delay_others(version: VersionRow) -> None:
    service, key = SearchService(), (version.league, version.number, version.sha256)
    calls = [asyncio.ensure_future(service.search(*key, "shared", board(i), None, WAIT, False)) for i in range(4)]
    await asyncio.sleep(0)
    calls[1].cancel()
    results = await asyncio.gather(*calls, return_exceptions=True)
    assert isinstance(results[1], asyncio.CancelledError)
    assert [result["visits"].sum() for result in (results[0], *results[2:])] == [64, 64, 64]


async def test_a_search_for_which_nobody_waits_ends(version: VersionRow) -> None:
    service, key = SearchService(), (version.league, version.number, version.sha256)
    result = await service.search(*key, "shared", board(None), None, 0.0, False)
    assert 0 < result["visits"].sum() < 64
