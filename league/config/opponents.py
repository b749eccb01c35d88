"""The `opponents` section of `training`: fixed opponents, and opponents from the league."""

from typing import Any, Literal, Self

from pydantic import Field, model_validator

from league.config.base import ContestantRef, Part


class OpponentConfig(Part):
    """A policy that controls the other sides in a fraction of the episodes and does not learn."""

    ref: ContestantRef
    """A script (`script:random`), a bot (`script:my_package.module:name`), a version (`connect_four@3`), or an alias,
    which is resolved when training starts. `@3` and `@champion` refer to the league itself."""
    share: float = Field(gt=0, le=1)
    """Fraction of the episodes. The remaining episodes are self-play."""

    @model_validator(mode="before")
    @classmethod
    def _from_yaml(cls, value: Any) -> Any:
        return {"ref": value, "share": 1.0} if isinstance(value, str) else value


Sampling = Literal["latest", "uniform", "pfsp", "nash", "alpha_rank"]
Weighting = Literal["power", "variance", "linear_capped"]


class LeagueOpponentsConfig(Part):
    """Opponents drawn from the versions of the league, which include those that the run publishes."""

    share: float = Field(default=0.5, gt=0, le=1)
    """Fraction of the episodes. Without a version, these episodes are self-play, too."""
    sampling: Sampling = "pfsp"
    """How opponents are drawn. latest: the newest version that is not an exploiter. uniform: all candidates alike.
    pfsp: by the probability x that the learner beats them. nash, alpha_rank: by their shares in the payoff matrix of
    the candidates."""
    weighting: Weighting = "power"
    """With pfsp, the weight of an opponent. power: (1 - x)^power. variance: x(1 - x). linear_capped: min(½, 1 - x)."""
    power: float = Field(default=2.0, gt=0)
    """The exponent of weighting `power`: the higher it is, the more often the strongest opponents are drawn."""
    window: int = Field(default=10, ge=1)
    """Number of newest versions that are candidates, exploiters not counted."""
    champions: bool = True
    """Whether all champions, past and present, are candidates."""
    exploiters: bool = True
    """Whether the newest exploiter of each champion, past and present, is a candidate."""
    active: int = Field(default=4, ge=1)
    """Maximum number of opponents that episodes start with between two updates."""
    forgotten: float = Field(default=0.15, ge=0, le=1)
    """Fraction of the draws that is uniform over the opponents with x < 0.7, if there are any."""


class OpponentsConfig(Part):
    """Opponents in training. A list is short for `fixed`."""

    fixed: tuple[OpponentConfig, ...] = ()
    """Opponents with constant shares."""
    league: LeagueOpponentsConfig | None = None
    """Opponents from the league."""

    @model_validator(mode="before")
    @classmethod
    def _from_list(cls, value: Any) -> Any:
        return {"fixed": value} if isinstance(value, list | tuple) else value

    @model_validator(mode="after")
    def _shares_fit(self) -> Self:
        if self.share > 1 + 1e-9:
            raise ValueError(f"the shares of opponents must sum to at most 1, got {self.share:g}")
        return self

    @property
    def share(self) -> float:
        """Fraction of the episodes with any opponent."""
        return sum(opponent.share for opponent in self.fixed) + (self.league.share if self.league else 0.0)

    @property
    def any(self) -> bool:
        """Whether there are episodes with opponents."""
        return bool(self.fixed) or self.league is not None
