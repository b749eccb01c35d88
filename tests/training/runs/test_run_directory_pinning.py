from pathlib import Path

import pytest

from league.config.league import LeagueConfig
from league.config.ppo import PPOConfig
from league.errors import ConfigError, InvalidInput, LeagueError, UnknownVersion
from league.registry.registry import Registry
from tests.support.leagues import tictactoe
from training.runs.run_directory import pin_opponents, with_pins
from training.sampling.opponents import without_mixtures


def with_opponents(*refs: str) -> LeagueConfig:
    return tictactoe.config().with_training(opponents=[{"ref": ref, "share": 0.3} for ref in refs])


def test_references_are_pinned_when_training_starts(tmp_path: Path) -> None:
    registry = tictactoe.registry(tmp_path)
    for _ in range(2):
        tictactoe.publish(registry, tictactoe.graph())
    registry.aliases.set("tictactoe", "champion", 1, expected=None, actor="me", reason="first")
    league = with_opponents("@champion", "tictactoe@2", "script:random")
    pins = pin_opponents(league, registry, registry.leagues.get("tictactoe").interface)
    assert pins == {"@champion": "tictactoe@1", "tictactoe@2": "tictactoe@2", "script:random": "script:random"}
    opponents = with_pins(league, pins).training.opponents.fixed
    assert [opponent.ref for opponent in opponents] == ["tictactoe@1", "tictactoe@2", "script:random"]
    assert [opponent.share for opponent in opponents] == [0.3, 0.3, 0.3]


def test_the_magnet_is_pinned_too(tmp_path: Path) -> None:
    registry = tictactoe.registry(tmp_path)
    tictactoe.publish(registry, tictactoe.graph())
    registry.aliases.set("tictactoe", "champion", 1, expected=None, actor="me", reason="first")
    spaces = registry.leagues.get("tictactoe").interface
    for ref, pinned in (("@champion", {"@champion": "tictactoe@1"}), ("uniform", {})):
        league = tictactoe.config().with_training(magnet={"ref": ref, "weight": 0.1})
        assert pin_opponents(league, registry, spaces) == pinned
        settings = with_pins(league, pinned).training
        assert isinstance(settings, PPOConfig)
        assert settings.magnet is not None
        assert settings.magnet.ref == pinned.get(ref, ref)


def mixed_champion(home: Path) -> Registry:
    """The champion is a mixture, @3, of two versions."""
    registry = tictactoe.registry(home)
    for _ in range(2):
        tictactoe.publish(registry, tictactoe.graph())
    number = registry.publisher.publish_mixture("tictactoe", {1: 0.25, 2: 0.75}).number
    registry.aliases.set("tictactoe", "champion", number, expected=None, actor="me", reason="first")
    return registry


def test_a_mixture_is_pinned_as_one_and_played_by_its_members(tmp_path: Path) -> None:
    registry = mixed_champion(tmp_path)
    spaces = registry.leagues.get("tictactoe").interface
    league = with_opponents("@champion", "script:random")
    pins = pin_opponents(league, registry, spaces)
    assert pins == {"@champion": "tictactoe@3", "script:random": "script:random"}
    fixed = with_pins(league, pins).training.opponents.fixed
    played = without_mixtures(fixed, registry.storage)
    assert [each.ref for each in played] == ["tictactoe@1", "tictactoe@2", "script:random"]
    assert [each.share for each in played] == pytest.approx([0.075, 0.225, 0.3])
    magnet = tictactoe.config().with_training(magnet={"ref": "@champion", "weight": 0.1})
    with pytest.raises(
        InvalidInput, match=r"tictactoe@3 is a mixture \(@1 25.0 %, @2 75.0 %\): name one of its members"
    ):
        pin_opponents(magnet, registry, spaces)


def test_in_training_a_search_version_plays_without_its_search(tmp_path: Path) -> None:
    registry = tictactoe.registry(tmp_path)
    tictactoe.publish(registry, tictactoe.graph())
    registry.publisher.publish_search("tictactoe", 1, "puct", 8, 1.0)
    league = with_opponents("@2").with_training(teacher={"ref": "@2", "weight": 1})
    assert pin_opponents(league, registry, registry.leagues.get("tictactoe").interface) == {"@2": "tictactoe@1"}


def test_the_references_of_a_sweeps_trials_are_pinned_too(tmp_path: Path) -> None:
    registry = mixed_champion(tmp_path)
    spaces = registry.leagues.get("tictactoe").interface
    trials = [with_opponents("@champion"), tictactoe.config().with_training(teacher={"ref": "@2", "weight": 1})]
    pins = pin_opponents(with_opponents("script:random"), registry, spaces, trials)
    assert pins == {"script:random": "script:random", "@champion": "tictactoe@3", "@2": "tictactoe@2"}
    trials += [tictactoe.config().with_training(teacher={"ref": "@champion", "weight": 1})]
    with pytest.raises(InvalidInput, match=r"tictactoe@3 is a mixture"):
        pin_opponents(with_opponents("script:random"), registry, spaces, trials)


@pytest.mark.parametrize(
    ("ref", "error"),
    [("@3", UnknownVersion), ("champion", ConfigError), ("script:stockfish", LeagueError)],
)
def test_unknown_opponents_are_rejected(tmp_path: Path, ref: str, error: type[LeagueError]) -> None:
    registry = tictactoe.registry(tmp_path)
    with pytest.raises(error, match=ref.strip("@").removeprefix("script:")):
        pin_opponents(with_opponents(ref), registry, registry.leagues.get("tictactoe").interface)
