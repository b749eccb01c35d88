"""Requests to the evaluation service: tournaments, nightly runs, recorded games and games against policies."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Discriminator, Field, RootModel, Tag, model_validator

MOST_CONTESTANTS = 256
MOST_BLOCKS = 100_000
MOST_GAMES = 10_000_000
MOST_MINUTES = 365 * 24 * 60
MOST_NUMBER = 2**31 - 1
"""Largest number of a game or a step."""


class _Request(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class _WithReason(_Request):
    reason: str | None = Field(default=None, min_length=1, max_length=2000, pattern=r"^[^\x00]+$")
    """A note that is stored with the evaluation."""


class TournamentRequest(_WithReason):
    """Games that update ratings and promote no version. The fields are arguments of `tournament.evaluate`."""

    kind: Literal["tournament"] = "tournament"
    schedule: Literal["round_robin", "gauntlet", "adaptive", "cross_play"] = "round_robin"
    contestants: tuple[str, ...] = Field(default=(), max_length=MOST_CONTESTANTS)
    """References to versions and scripts. Empty: every version trained in the league's current environment."""
    against: tuple[str, ...] = Field(default=(), max_length=MOST_CONTESTANTS)
    """Opponents of each contestant in a gauntlet. Empty: the champion and the baselines."""
    blocks: int | None = Field(default=None, ge=1, le=MOST_BLOCKS)
    """Matches of each pair. None: 32, or as many as the budget allows."""
    games: int | None = Field(default=None, ge=2, le=MOST_GAMES)
    minutes: float | None = Field(default=None, gt=0, le=MOST_MINUTES)
    precision: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    """Target half-width of every rating's 95 % interval, in Elo."""
    seed: int = Field(default=0, ge=0, lt=2**63)
    """Another seed plays other games."""

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
MOST_CHOICES = 10_000
"""Actions of a person in one game."""


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
    """A game of a person against policies, up to the person's next turn.

    opponent: reference of the policies that control all other agents. actions: the person's actions so far.
    seed: seed of the environment and of stochastic policies. chances: include the opponent's action probabilities,
    also for the person's observations.
    """

    opponent: str
    agent: str
    seed: int = Field(default=0, ge=0, lt=2**63)
    actions: tuple[Annotated[int, Field(ge=-(2**63), lt=2**63)], ...] = Field(default=(), max_length=MOST_CHOICES)
    chances: bool = False


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


@dataclass(frozen=True, slots=True)
class GameResponse:
    """Response of the evaluation service, which replicas return unchanged."""

    media_type: str
    content: bytes
