"""The conditions under which the games of a league are played: which game it is, and how versions select actions.

A version with greedy actions takes the most likely ones, which its opponents can predict. From them they can infer what
they do not see. A version with sampled actions draws them from its distribution. In zero-sum games with hidden
information or simultaneous moves, usually only such mixed strategies are optimal.
"""

from typing import TYPE_CHECKING, Any, Literal, NamedTuple

if TYPE_CHECKING:
    from league.config.base import JSON
    from league.config.league import LeagueConfig
    from league.interface import Interface

ActionSelection = Literal["greedy", "sampled"]
"""Versions take the mode of their action distributions, or samples from them. Scripts do not depend on it."""

HIDDEN_INFORMATION = frozenset(
    (
        "gin_rummy_v4",
        "hanabi_v5",
        "leduc_holdem_v4",
        "rps_v2",
        "texas_holdem_v4",
        "texas_holdem_no_limit_v6",
    )
)
"""Names (`metadata["name"]`) of PettingZoo's environments in which observations hide cards or the opponent's move."""

VALUE_BASED = frozenset(("dqn", "qmix"))
"""Algorithms that learn action values. Their versions have no action distribution, and are always greedy."""


class Conditions(NamedTuple):
    """Results of games under different conditions are never combined."""

    game_digest: str
    """See `LeagueConfig.game`."""
    actions: ActionSelection

    @property
    def name(self) -> str:
        """A short name, unique within a league."""
        return f"{self.game_digest[:DIGITS]}-{self.actions}"


DIGITS = 12
"""Length of abbreviated digests."""


class GameChange(NamedTuple):
    """A part of the game that differs; None if the game does not have it."""

    name: str
    before: str | None
    now: str | None


def game_changes(before: "JSON", now: "JSON") -> tuple[GameChange, ...]:
    """Return how two games differ (`LeagueConfig.game`). Digests are abbreviated."""
    names = dict.fromkeys((*before, *now))
    changed = (name for name in names if before.get(name) != now.get(name))
    return tuple(GameChange(name, _short(before.get(name)), _short(now.get(name))) for name in changed)


def _short(value: Any) -> str | None:
    return None if value is None else str(value)[:DIGITS]


def action_selection(config: "LeagueConfig", interface: "Interface") -> ActionSelection:
    """Return `play.actions`, by default `default_selection`."""
    return config.play.actions or default_selection(
        interface.hidden_information or interface.simultaneous, len(interface.sides)
    )


def default_selection(is_unseen: bool, sides: int) -> ActionSelection:
    """Return `sampled` if information or moves are unseen by opponents. A single side has no opponents."""
    return "sampled" if is_unseen and sides > 1 else "greedy"


def describe_selection(config: "LeagueConfig", interface: "Interface") -> str:
    """Return a human-readable sentence: how versions select actions, and why."""
    selection, algorithm = action_selection(config, interface), config.training.algorithm
    if selection == "sampled" and algorithm in VALUE_BASED:
        return f"Versions play with greedy actions: those of {algorithm} have no action distribution."
    if config.play.actions is not None:
        return f"Versions play with {selection} actions, as play.actions says."
    if len(interface.sides) == 1:
        reason = "there is only one side"
    elif interface.hidden_information:
        reason = "the environment hides information from opponents"
    elif interface.simultaneous:
        reason = "opponents act at once, without seeing the other's action"
    else:
        reason = "the environment is not known to hide information"
    return f"Versions play with {selection} actions: {reason} (play.actions)."


def declares_information(env: Any) -> bool:
    """Return whether an environment says itself whether it hides information, also that it does not."""
    return "hidden_information" in (getattr(env, "metadata", None) or {})


def hides_information(env: Any) -> bool:
    """Return whether observations hide parts of the state, or opponents move simultaneously without seeing the move.

    Environments declare it by `metadata["hidden_information"]`, a boolean. Without it, the environments of
    HIDDEN_INFORMATION are recognised by their names, and games of OpenSpiel by their types.
    """
    metadata = getattr(env, "metadata", None) or {}
    if "hidden_information" in metadata:
        return bool(metadata["hidden_information"])
    game = getattr(getattr(env, "unwrapped", env), "game_type", None)  # of Shimmy's adapter, a pyspiel.GameType
    if game is not None and hasattr(game, "information"):
        return game.information.name != "PERFECT_INFORMATION" or game.dynamics.name == "SIMULTANEOUS"
    return metadata.get("name") in HIDDEN_INFORMATION
