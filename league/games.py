"""What the service may ask of its studio about the games of a league: to be shown one, or to be played against."""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

MOST_STEPS = 100
"""Of one answer: a picture of each may be tens of kilobytes."""
MOST_CHOICES = 10_000
"""Of a person in one game."""


class _Asked(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class Recording(_Asked):
    """Some steps of a recorded game: each `every`-th from `first` on, at most MOST_STEPS, and before `end`.

    The last step of the game is told as well if it is among those, whatever its number.
    """

    kind: Literal["recording"] = "recording"
    match: str
    game: int = Field(ge=0)
    first: int = Field(default=0, ge=0)
    end: int | None = Field(default=None, ge=0)
    every: int = Field(default=1, ge=1)

    def wants(self, step: int, is_last: bool) -> bool:
        """Whether a step is to be told."""
        end = self.first + (MOST_STEPS - 1) * self.every + 1
        if self.end is not None:
            end = min(end, self.end)
        return self.first <= step < end and (is_last or (step - self.first) % self.every == 0)


class Film(_Asked):
    """A recorded game as a GIF."""

    kind: Literal["film"] = "film"
    match: str
    game: int = Field(ge=0)


class Table(_Asked):
    """Whether a person can play in the league, and as whom."""

    kind: Literal["table"] = "table"


class Play(_Asked):
    """A game of a person, who has chosen `actions` so far, up to the next choice.

    opponent: who plays all other agents. seed: of the environment, and of what scripts draw. chances: tell how likely
    the opponent's actions are, also in the person's place.
    """

    opponent: str
    agent: str
    seed: int = Field(default=0, ge=0, lt=2**63)
    actions: tuple[Annotated[int, Field(ge=-(2**63), lt=2**63)], ...] = Field(default=(), max_length=MOST_CHOICES)
    chances: bool = False


class Sitting(Play):
    """The same as the studio is asked it: with an opponent that stays the same."""

    kind: Literal["sitting"] = "sitting"


class Order(_Asked):
    """One question. environment: the digest of the league's, so that the same question has the same answer."""

    league: str
    environment: str
    asked: Annotated[Recording | Film | Table | Sitting, Field(discriminator="kind")]

    @property
    def has_one_answer(self) -> bool:
        """Whether it will be the same for ever."""
        return not isinstance(self.asked, Table)
