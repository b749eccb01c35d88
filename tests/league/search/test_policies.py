"""A version that searches beats the same version without a search, plays by the seed, and can be promoted."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import onnx
import pytest

from evaluation.matches.tournament import evaluate
from evaluation.matches.worker import MatchWorker
from evaluation.schedules.builders import round_robin
from league.config.play import PlayConfig
from league.environments.vector.tictactoe import TicTacToe
from league.errors import ArtifactCorrupt, Conflict, InvalidInput
from league.policies.loading import eligible, load
from league.refs import CheckpointRef
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.storage.manifest import SEARCH, SearchRule
from league.registry.storage.rows import Portion, VersionRow
from league.search.policies import SearchPolicy, publish_search
from league.spaces import Discrete
from tests.support.leagues import tictactoe
from tests.support.leagues.tictactoe import LEAGUE
from tests.support.policies.graphs import masked_mlp


def searching(registry: Registry, number: int, rule: SearchRule = "puct", simulations: int = 50) -> VersionRow:
    league, base = registry.leagues.get(LEAGUE), registry.versions.get(LEAGUE, number)
    return publish_search(registry, base, league.config.environment, league.interface, rule, simulations)


@pytest.fixture
def registry(tmp_path: Path) -> Registry:
    """Version 2 searches with version 1, whose network has random weights."""
    opened = tictactoe.registry(tmp_path, gate={"max_blocks": 4})
    value = masked_mlp((3, 3, 2), 9, has_value=True)
    tictactoe.publish(opened, masked_mlp((3, 3, 2), 9), value=value)
    searching(opened, 1)
    return opened


def test_a_search_is_a_version(registry: Registry) -> None:
    base, version = registry.versions.all(LEAGUE)
    assert (version.ref, version.role) == ("tictactoe@2", SEARCH)
    assert str(version.search).startswith("@1, 50 simulations, puct, ")
    assert version.search is not None
    assert version.search.sha256 == base.sha256
    assert searching(registry, 1) == version
    assert searching(registry, 1, "gumbel").number == 3
    assert [row.number for row in eligible(registry, LEAGUE)] == [1, 2, 3]


def test_it_beats_the_version_without_a_search(registry: Registry) -> None:
    searching(registry, 1, "gumbel")
    result = evaluate(LEAGUE, ["tictactoe@1", "tictactoe@2", "tictactoe@3"], registry=registry, blocks=12)
    scores = {standing.ref: standing.score for standing in result.leaderboard}
    assert min(scores["tictactoe@2"], scores["tictactoe@3"]) > scores["tictactoe@1"] + 0.2


@pytest.mark.parametrize("name", ["wv", "w1"])
def test_a_network_that_returns_nan_is_corrupt(name: str) -> None:
    model = onnx.load_from_string(masked_mlp((3, 3, 2), 9, has_value=True))
    (weights,) = (weights for weights in model.graph.initializer if weights.name == name)
    weights.CopyFrom(onnx.numpy_helper.from_array(np.full(weights.dims, np.nan, np.float32), name))
    policy = SearchPolicy(TicTacToe, model.SerializeToString(), Discrete(n=9), "puct", 8)
    with pytest.raises(ArtifactCorrupt, match="the value graph returns NaN or infinity"):
        policy.search({"observation": np.zeros((1, 3, 3, 2), np.int8), "action_mask": np.ones((1, 9), np.int8)})


@pytest.mark.parametrize("actions", ["greedy", "sampled"])
def test_games_depend_on_their_seeds_only(registry: Registry, actions: str) -> None:
    league = registry.leagues.get(LEAGUE)
    config = league.config.model_copy(update={"play": PlayConfig(actions=actions, opening_plies=2, num_envs=16)})
    schedule = round_robin(config, league.interface, ["tictactoe@1", "tictactoe@2"], 4, 0)
    together = MatchWorker(config, registry).play(schedule, range(schedule.length))
    alone = config.model_copy(update={"play": config.play.model_copy(update={"num_envs": 1})})
    assert MatchWorker(alone, registry).play(schedule, range(schedule.length)) == together


def test_it_is_promoted_and_rolled_back_like_others(registry: Registry) -> None:
    def champion() -> int:
        return registry.versions.resolve(CheckpointRef(LEAGUE, "champion")).number

    def promote(number: int) -> None:
        registry.aliases.set(LEAGUE, "champion", number, expected=ANY, actor="test", reason="test")

    promote(1)
    promote(2)
    registry.traffic.set(LEAGUE, shadow=Portion(1, 0.1), actor="test", reason="test")
    assert champion() == 2
    promote(1)
    registry.aliases.rollback(LEAGUE, actor="test", reason="test")
    assert champion() == 2


def test_a_version_without_a_value_and_a_search_version_cannot_be_searched(registry: Registry) -> None:
    number = tictactoe.publish(registry, tictactoe.graph()).number
    with pytest.raises(InvalidInput, match=f"tictactoe@{number} has no value graph"):
        searching(registry, number)
    for use in (lambda: searching(registry, 2), lambda: load("tictactoe@2", registry=registry)):
        with pytest.raises(InvalidInput, match=r"tictactoe@2 searches \(.*\): name @1 instead"):
            use()
    with pytest.raises(InvalidInput, match="name @1 instead"):
        registry.publisher.publish_mixture(LEAGUE, {1: 0.5, 2: 0.5})


def test_the_version_that_it_plays_is_kept(registry: Registry) -> None:
    registry.retention.retire(LEAGUE, keep=0, before=datetime.now(UTC))
    assert registry.versions.numbers(LEAGUE) == {LEAGUE: [1, 2]}
    with pytest.raises(Conflict, match="tictactoe@1 is a part of tictactoe@2"):
        registry.removal.remove_version(CheckpointRef(LEAGUE, 1), force=True)
