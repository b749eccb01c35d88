"""The `play` section: matches."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from league.config.base import JSON, Part

LONGEST_NAME = 40


def _check_names(names: tuple[str, ...]) -> tuple[str, ...]:
    if not names:
        raise ValueError("expected at least one name")
    for name in names:
        if not name.strip() or len(name) > LONGEST_NAME:
            raise ValueError(f"{name[:LONGEST_NAME]!r}: expected 1 to {LONGEST_NAME} characters")
    if doubled := [name for name in dict.fromkeys(names) if names.count(name) > 1]:
        raise ValueError(f"{doubled[0]!r} is the name of several actions")
    return names


ActionNames = Annotated[tuple[str, ...], AfterValidator(_check_names)]


class PlayConfig(Part):
    """Settings of matches."""

    opening_plies: int = Field(default=0, ge=0)
    """Random legal steps at the start of each game. Without them, greedy policies repeat one game of a deterministic
    environment."""
    actions: Literal["greedy", "sampled"] | None = None
    """greedy: versions take the most likely actions. sampled: versions sample actions from their distributions. By
    default `sampled` if the environment hides information from opponents, or they take discrete actions at once, else
    `greedy`; see league/conditions.py.
    Versions of value-based algorithms have no distribution, and are always greedy."""
    scoring: Literal["game", "side"] | None = None
    """What a contestant's return is compared with. game: the returns of its opponents in the same game. side: the
    return of the other contestant on the same side in the block's other game. By default `game` if there are several
    equivalent sides, else `side`."""
    num_envs: Annotated[int, Field(ge=1)] | Literal["auto"] = "auto"
    """Games stepped in parallel in one worker. auto: 512 in a vectorised environment, else 32. Does not influence
    results."""
    max_moves: int = Field(default=10_000, ge=1)
    """Environment steps after which a game counts as hung and its match fails. Simultaneous actions of several agents
    are one step."""
    game_seconds: float = Field(default=600.0, gt=0, allow_inf_nan=False)
    """Seconds of environment time (resets and steps of this game alone) after which a game counts as hung."""

    action_names: ActionNames | dict[str, ActionNames] | None = None
    """Display names of Discrete actions, in the order of the actions: of all policies, or policy id → names. They
    do not influence results."""

    def names_for(self, policy: str) -> tuple[str, ...]:
        """Return the names of a policy's actions; empty without names."""
        names = self.action_names or ()
        return names.get(policy, ()) if isinstance(names, dict) else names

    def rules(self) -> JSON:
        """Return the settings that decide results: all but those of speed, of hung processes and for display.

        `actions` is not part of the game, because its default depends on the interface; see `league.conditions`.
        """
        return self.model_dump(mode="json", exclude={"num_envs", "game_seconds", "actions", "action_names"})
