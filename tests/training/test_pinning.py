from pathlib import Path

import pytest

from league.config import LeagueConfig
from league.errors import InvalidReference, LeagueError, UnknownVersion
from tests.evaluation import examples
from training.pinning import pin, with_pins


def with_opponents(*refs: str) -> LeagueConfig:
    return examples.config().with_training(opponents=[{"ref": ref, "share": 0.3} for ref in refs])


def test_references_mean_what_they_meant_when_training_began(tmp_path: Path) -> None:
    registry = examples.registry(tmp_path)
    for _ in range(2):
        examples.publish(registry, examples.graph())
    registry.set_alias("tictactoe", "champion", 1, expected=None, actor="me", reason="first")
    league = with_opponents("@champion", "tictactoe@2", "script:random")
    pins = pin(league, registry, registry.league("tictactoe").interface)
    assert pins == {"@champion": "tictactoe@1", "tictactoe@2": "tictactoe@2", "script:random": "script:random"}
    opponents = with_pins(league, pins).training.opponents
    assert [opponent.ref for opponent in opponents] == ["tictactoe@1", "tictactoe@2", "script:random"]
    assert [opponent.share for opponent in opponents] == [0.3, 0.3, 0.3]


@pytest.mark.parametrize(
    ("ref", "error"),
    [("@3", UnknownVersion), ("champion", InvalidReference), ("script:stockfish", LeagueError)],
)
def test_opponents_that_do_not_exist_are_refused(tmp_path: Path, ref: str, error: type[LeagueError]) -> None:
    registry = examples.registry(tmp_path)
    with pytest.raises(error, match=ref.strip("@").removeprefix("script:")):
        pin(with_opponents(ref), registry, registry.league("tictactoe").interface)
