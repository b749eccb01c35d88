"""What the service may be asked to play: a tournament of a league's versions, or the league's night."""

from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Discriminator, Field, RootModel, Tag, model_validator

MOST_CONTESTANTS = 256
MOST_BLOCKS = 100_000


class _Asked(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    reason: str | None = Field(default=None, min_length=1, max_length=2000, pattern=r"^[^\x00]+$")
    """Kept beside the evaluation, for people."""


class Tournament(_Asked):
    """Games for ratings: nothing is promoted. What its fields mean, `evaluation.tournament.evaluate` says."""

    kind: Literal["tournament"] = "tournament"
    schedule: Literal["round_robin", "gauntlet", "adaptive", "cross_play"] = "round_robin"
    contestants: tuple[str, ...] = Field(default=(), max_length=MOST_CONTESTANTS)
    """References to versions and scripts; if there are none, every version that was trained in the environment that the
    league has now."""
    against: tuple[str, ...] = Field(default=(), max_length=MOST_CONTESTANTS)
    """Whom each contestant meets in a gauntlet; if there is nobody, the champion and the baselines."""
    blocks: int | None = Field(default=None, ge=1, le=MOST_BLOCKS)
    """Matches of each pair; 32, or as many as the budget allows."""
    games: int | None = Field(default=None, ge=2)
    minutes: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    precision: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    """Of every rating's 95 % interval, ± Elo."""
    seed: int = Field(default=0, ge=0, lt=2**63)
    """Another one plays other games."""

    @model_validator(mode="after")
    def _go_together(self) -> Self:
        if self.against and self.schedule != "gauntlet":
            raise ValueError(f"against: only a gauntlet has opponents of its own, not {self.schedule}")
        if self.precision is not None and self.schedule == "cross_play":
            raise ValueError("precision: cross_play has no ratings that could be precise enough")
        return self


class Night(_Asked):
    """What `league nightly` does: new versions are judged, the best is promoted, everybody is rated."""

    kind: Literal["nightly"]


def _kind(value: Any) -> Any:
    return value.get("kind", "tournament") if isinstance(value, dict) else getattr(value, "kind", None)


class Asked(
    RootModel[
        Annotated[
            Annotated[Tournament, Tag("tournament")] | Annotated[Night, Tag("nightly")],
            Discriminator(
                _kind, custom_error_type="kind", custom_error_message="kind must be 'tournament' or 'nightly'"
            ),
        ]
    ]
):
    """Either, told apart by `kind`, which may be left out for a tournament."""
