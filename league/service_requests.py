"""Requests to the evaluation service, and its responses: tournaments, nightly runs, recorded games and games of people.

Replicas of the policy server return the responses unchanged.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

from pydantic import Discriminator, Field, RootModel, Tag, model_validator

from league.frozen import FrozenModel

MOST_CONTESTANTS = 256
MOST_BLOCKS = 100_000
MOST_GAMES = 10_000_000
MOST_MINUTES = 365 * 24 * 60
MOST_SEED = 2**63 - 1
MOST_NUMBER = 2**31 - 1
"""Largest number of a game or a step."""


class _Request(FrozenModel, strict=True): ...


class _WithReason(_Request):
    reason: str | None = Field(
        default=None,
        min_length=1,
        max_length=2000,
        pattern=r"^[^\x00]+$",
        description="A note that is stored with the evaluation.",
    )


class TournamentRequest(_WithReason):
    """Games that update ratings and promote no version."""

    kind: Literal["tournament"] = "tournament"
    schedule: Literal["round_robin", "gauntlet", "adaptive", "cross_play"] = Field(
        default="round_robin",
        description="`round_robin`: all pairs. `gauntlet`: each contestant against those in `against`. `adaptive`:"
        " pairings depend on the results so far. `cross_play`: pairs play in one team.",
    )
    contestants: tuple[str, ...] = Field(
        default=(),
        max_length=MOST_CONTESTANTS,
        description="Versions, aliases and scripts: `connect_four@3`, `connect_four@champion`, `script:random`. Empty:"
        " every version trained in the league's current environment.",
    )
    against: tuple[str, ...] = Field(
        default=(),
        max_length=MOST_CONTESTANTS,
        description="For `gauntlet`: the opponents of each contestant. Empty: the champion and the baselines.",
    )
    blocks: int | None = Field(
        default=None,
        ge=1,
        le=MOST_BLOCKS,
        description="Matches of each pair. Null: 32, or as many as the budget allows.",
    )
    games: int | None = Field(default=None, ge=2, le=MOST_GAMES, description="Maximum number of games.")
    minutes: float | None = Field(default=None, gt=0, le=MOST_MINUTES, description="Maximum duration.")
    precision: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        description="Stop when the 95 % interval of every rating is within ± this many Elo.",
    )
    seed: int = Field(default=0, ge=0, le=MOST_SEED, description="The seed of the games.")

    @model_validator(mode="after")
    def _check_combination(self) -> Self:
        if self.against and self.schedule != "gauntlet":
            raise ValueError(f"against: only a gauntlet has separate opponents, not {self.schedule}")
        if self.precision is not None and self.schedule == "cross_play":
            raise ValueError("precision: cross_play computes no ratings")
        return self


class NightlyRequest(_WithReason):
    """A nightly run, like `league nightly`: test new versions, promote those that pass, and update the ratings."""

    kind: Literal["nightly"]


def _kind(value: Any) -> Any:
    return value.get("kind", "tournament") if isinstance(value, dict) else getattr(value, "kind", None)


class EvaluationRequest(
    RootModel[
        Annotated[
            Annotated[TournamentRequest, Tag("tournament")] | Annotated[NightlyRequest, Tag("nightly")],
            Discriminator(
                _kind, custom_error_type="kind", custom_error_message="kind must be 'tournament' or 'nightly'"
            ),
        ]
    ]
):
    """A tournament or a nightly run, distinguished by `kind`. The default kind is `tournament`."""


MOST_STEPS = 100
"""Steps per response. A rendered step may take tens of kilobytes."""
MOST_CHANCES = 32
"""Actions per move with probabilities."""
MOST_CHOICES = 10_000
"""Actions of a person in one game."""
MOST_ANALYSED = 1000
"""Simulations of a search version that evaluates each position of a game."""


class RecordingRequest(_Request):
    """Steps of a recorded game: every `every`-th one in [`first`, `end`), at most MOST_STEPS.

    The last step of the game is included if it lies in this range, whatever its number.
    """

    kind: Literal["recording"] = "recording"
    match: str
    game: int = Field(ge=0, le=MOST_NUMBER)
    first: int = Field(default=0, ge=0, le=MOST_NUMBER)
    end: int | None = Field(default=None, ge=0, le=MOST_NUMBER)
    every: int = Field(default=1, ge=1, le=MOST_NUMBER)
    analysis: int | None = Field(default=None, ge=1, le=MOST_NUMBER)
    """A search version that evaluates the positions, in place of the players."""

    def includes(self, step: int, is_last: bool) -> bool:
        """Whether the response contains a step."""
        end = self.first + (MOST_STEPS - 1) * self.every + 1
        if self.end is not None:
            end = min(end, self.end)
        return self.first <= step < end and (is_last or (step - self.first) % self.every == 0)


class VideoRequest(_Request):
    """A recorded game as a GIF."""

    kind: Literal["video"] = "video"
    match: str
    game: int = Field(ge=0, le=MOST_NUMBER)


class PlayabilityRequest(_Request):
    """Whether a person can play in the league, and which agents."""

    kind: Literal["playability"] = "playability"


class PlayBody(_Request):
    """A game of a person against policies, up to the person's next turn."""

    opponent: str = Field(
        description="The policies that control all other agents: `connect_four@4`, `connect_four@champion`,"
        " `script:one_ply`."
    )
    agent: str = Field(description="The agent that you play. The opponent plays all others.")
    seed: int = Field(default=0, ge=0, le=MOST_SEED, description="The seed of the environment and of the scripts.")
    actions: tuple[Annotated[int, Field(ge=-MOST_SEED - 1, le=MOST_SEED)], ...] = Field(
        default=(), max_length=MOST_CHOICES, description="Your actions so far."
    )
    chances: bool = Field(
        default=False,
        description="Return the probabilities of the opponent's actions, and those of the opponent in your position.",
    )
    analysis: int | None = Field(
        default=None,
        ge=1,
        le=MOST_NUMBER,
        description="A search version that evaluates your positions: `chances` are its probabilities there, and `value`"
        " is the return that it expects.",
    )


class HumanPlayRequest(PlayBody):
    """The same game, with the opponent resolved to a fixed version."""

    kind: Literal["human_play"] = "human_play"


GameOperation = RecordingRequest | VideoRequest | PlayabilityRequest | HumanPlayRequest


class GameRequest(_Request):
    """One operation on a league's games.

    conditions: name of the league's conditions, the game and how versions select actions. Equal requests therefore
    have equal responses.
    """

    league: str
    conditions: str
    operation: Annotated[GameOperation, Field(discriminator="kind")]

    @property
    def is_cacheable(self) -> bool:
        """Whether its response never changes."""
        return not isinstance(self.operation, PlayabilityRequest)


Chances = Annotated[
    tuple[tuple[int, Annotated[float, Field(ge=0, le=1)]], ...],
    Field(
        max_length=MOST_CHANCES,
        description="(action, probability) pairs, most probable first, without impossible actions. Empty if no policy"
        " selected the action.",
    ),
]
Returns = Annotated[Mapping[str, float | None], Field(description="Return by agent.")]
ActionNames = Annotated[dict[str, str], Field(description="Name by action, a number as text; empty without names.")]
Picture = Annotated[str | None, Field(description="The picture after the step: a PNG as a data URI, or null.")]


class RecordedMove(FrozenModel):
    """What an agent did in a step."""

    agent: str
    ref: str = Field(description="The player: a version, a script, or `person`.")
    action: bool | int | float | list[Any] = Field(description="A number, or nested lists of numbers.")
    chances: Chances
    value: float | None = Field(description="The return that the agent expects; null unless a search version says.")


class RecordedStep(FrozenModel):
    """A step of a game."""

    step: int = Field(ge=0)
    moves: tuple[RecordedMove, ...] = Field(
        description="The moves of all agents in this step; empty in step 0, the initial state."
    )
    picture: Picture
    opening: bool = Field(description="Whether the step is part of the random opening.")


class GameForfeit(FrozenModel):
    """An agent that returned no valid action; the game ends there."""

    agent: str
    ref: str
    reason: Literal["illegal_action", "not_finite", "malformed", "crashed"]


class RecordedGame(FrozenModel):
    """A recorded game. If it cannot be replayed, `fault` is set and there are no steps."""

    match: str
    game: int
    players: dict[str, str] = Field(description="Player by agent.")
    action_names: dict[str, ActionNames] = Field(
        description="`play.action_names` of the league by agent; without the agents that have none."
    )
    length: int = Field(description="Number of steps of the game, without the initial state.")
    every: int
    steps: tuple[RecordedStep, ...] = Field(max_length=MOST_STEPS)
    returns: Returns
    forfeits: tuple[GameForfeit, ...]
    fault: str | None = Field(description="The reason why the game cannot be replayed.")


class PlayableAgent(FrozenModel):
    """An agent that a person can control: its actions are the `actions` integers from `start`."""

    agent: str
    side: str
    actions: int = Field(description="Number of actions.")
    start: int = Field(description="The first action.")
    names: ActionNames
    keys: dict[str, int] = Field(
        description="Action by key, as `KeyboardEvent.key` names it: what the environment declares, and arrow keys and"
        " WASD for actions whose names contain a direction."
    )
    color: str | None = Field(
        description="Color of the agent in the pictures, if the environment declares it: a color name or `#rrggbb`."
    )


class Playability(FrozenModel):
    """The agents and opponents for a game with a person, or the reason why the league is not playable."""

    league: str
    playable: bool
    why: str | None = Field(description="The reason why the league is not playable.")
    agents: tuple[PlayableAgent, ...] = Field(description="Agents with a discrete action space.")
    opponents: tuple[str, ...] = Field(
        description="Mixtures with an alias, the 50 newest versions of the environment, newest first, then scripts, and"
        " the bots and remote models that the configuration names."
    )
    draws: bool = Field(description="Whether the environment renders pictures.")
    board: tuple[tuple[int | None, ...], ...] | None = Field(
        description="A grid of actions in rows over the picture, if the environment declares one; null where no action"
        " is."
    )
    board_area: tuple[float, float, float, float] = Field(
        description="Where the grid is: left, top, right and bottom, as shares of the picture's width and height."
    )
    reveals: bool = Field(
        description="Whether the pictures show what the environment hides from the agent, because it does not render"
        " the view of one agent."
    )


class PlayedGame(FrozenModel):
    """The game of a person so far, and the legal actions."""

    opponent: str = Field(description="The requested opponent; an alias is replaced by its version.")
    agent: str
    seed: int
    steps: tuple[RecordedStep, ...] = Field(description="All steps, without pictures.")
    picture: Picture
    legal: tuple[int, ...] = Field(description="The legal actions; empty once the game is over.")
    acting: tuple[str, ...] = Field(description="The agents that act in this step.")
    over: bool
    returns: Returns
    score: float | None = Field(
        description="Your score once the game is over: 1, ½ or 0. Null if the league does not compare opponents within"
        " a game."
    )
    chances: Chances
    value: float | None = Field(description="The return that you can expect; null unless a search version says.")
    forfeits: tuple[GameForfeit, ...]


@dataclass(frozen=True, slots=True)
class GameResponse:
    """Response of the evaluation service, which replicas return unchanged."""

    media_type: str
    content: bytes
