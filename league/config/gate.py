"""The `gate` section: the statistical test for promotions."""

from math import log10
from typing import Any, Literal, Self

from pydantic import Field, model_validator

from league.config.base import ContestantRef, Part
from league.refs import CheckpointRef, of_league, parse_ref

AnchorMode = Literal["no_worse", "at_least"]
"""What a test against an anchor compares the candidate with: the champion's results against it, or the anchor."""

MAX_NORMALIZED_ELO = 190
"""Bound for hypotheses with a usable test; see evaluation/statistics/sequential.py."""

EXPLOITER_MARGIN = 0.1
"""Default of `exploiter_margin`: a tenth of all points."""


class AnchorConfig(Part):
    """An opponent for a non-inferiority test of a candidate."""

    ref: ContestantRef
    """A script (`script:one_ply`), a bot (`script:my_package.module:name`), a version (`connect_four@3`), or an alias,
    which is resolved when the verdict is opened. `@3` and `@gold` refer to the league itself."""
    mode: AnchorMode | None = None
    """`no_worse`: the candidate does not do worse against the anchor than the champion, from common seeds. `at_least`:
    it is not weaker than the anchor. Null: `at_least` for versions and anchors with a margin, otherwise `no_worse`."""
    margin: float | None = Field(default=None, gt=0)
    """Non-inferiority margin. Default: the gate's `margin` with `at_least`, its `exploiter_margin` with `no_worse`."""

    @model_validator(mode="before")
    @classmethod
    def _from_yaml(cls, value: Any) -> Any:
        return {"ref": value} if isinstance(value, str) else value

    @property
    def tested_mode(self) -> AnchorMode:
        """`mode` or its default.

        A margin alone was Elo before there were modes, and still is.
        """
        if self.mode is not None:
            return self.mode
        is_version = isinstance(parse_ref(of_league(self.ref, "league")), CheckpointRef)
        return "at_least" if is_version or self.margin is not None else "no_worse"


class ExploitersConfig(Part):
    """Exploiters that are trained for the test of a candidate's exploitability."""

    count: int = Field(default=0, ge=0)
    """Exploiters of the candidate, and as many of the champion. 0: no test."""
    budget: float = Field(default=0.15, gt=0, le=1)
    """Training budget of each, in steps and minutes, as a fraction of the candidate's run."""
    blocks: int = Field(default=200, ge=2)
    """Matches of each exploiter from which its score is estimated: in the gate, whose test may take fewer or more, in a
    night of training, and by `league exploitability`."""
    improvement: float = Field(default=0.0, ge=0)
    """By how much less exploitable than the champion a candidate must be, in the unit of `exploiter_margin`. 0: it may
    be more exploitable by up to `exploiter_margin`."""

    @model_validator(mode="after")
    def _improvement_is_tested(self) -> Self:
        if self.improvement and not self.count:
            raise ValueError("exploiters.improvement requires exploiters.count, the number of exploiters to train")
        return self


class GateConfig(Part):
    """The statistical test for promotions. See docs/statistics.md."""

    model: Literal["logistic", "normalized", "returns"] = "normalized"
    """The observed quantity of a block: its score in logistic or normalized Elo (GSPRT), or its difference of returns
    (test by betting)."""
    elo0: float = 0.0
    """H0: strength of the candidate relative to the champion, in Elo of `model`."""
    elo1: float = 30.0
    """H1: strength of the candidate relative to the champion."""
    return0: float = 0.0
    """H0 of the model `returns`: upper bound of the mean difference of returns."""
    return1: float = 0.0
    """H1 of the model `returns`: lower bound of the mean difference of returns."""
    return_bound: float | None = Field(default=None, gt=0)
    """Maximum absolute difference of returns in a block. Required by the model `returns`."""
    alpha: float = Field(default=0.05, gt=0, lt=0.5)
    """Probability of promoting at least one candidate under H0 in a year of nightly runs."""
    nights: int | None = Field(default=365, ge=1)
    """Nightly runs per year, among which alpha is divided equally; the candidates of a run share its part. Null: each
    verdict uses the full alpha."""
    beta: float = Field(default=0.05, gt=0, lt=0.5)
    """Probability of rejecting a candidate under H1."""
    max_blocks: int = Field(default=4000, ge=1)
    """Blocks after which a test ends as `inconclusive` and the champion stays."""
    anchors: tuple[AnchorConfig, ...] = ()
    """Opponents of non-inferiority tests, in addition to previous champions."""
    earlier_champions: int = Field(default=2, ge=0)
    """Number of previous champions that are anchors."""
    margin: float = Field(default=50.0, gt=0)
    """Non-inferiority margin, in Elo of `model` or in returns."""
    exploited_champions: int = Field(default=2, ge=0)
    """Number of champions, the current one and previous ones, whose newest exploiters a candidate is tested against."""
    exploiter_margin: float | None = Field(default=None, gt=0)
    """How much less than the champion a candidate may score against an exploiter or an anchor with `no_worse`, and how
    much more exploitable it may be, as a share of all points (default 0.1), or in returns with the model `returns`
    (default: `margin`)."""
    exploiters: ExploitersConfig = ExploitersConfig()
    """Exploiters trained against a candidate that passed all other tests, and against the champion."""
    confirmation_blocks: int = Field(default=200, ge=0)
    """Blocks against the previous champion after a promotion, for an unbiased estimate of the improvement."""
    forfeits: bool = False
    """Whether a candidate that forfeited a game (illegal action or crash) may be promoted."""
    shadow_agreement: float | None = Field(default=None, ge=0, le=1)
    """Minimum fraction of mirrored observations for which candidate and champion choose the same action; null for no
    minimum. Like `latency_ms`, it applies only if the league has a champion."""
    latency_ms: float | None = Field(default=None, gt=0)
    """Maximum of the 95th percentile of the candidate's CPU time per mirrored request, in milliseconds."""
    shadow_observations: int = Field(default=1000, ge=1)
    """Minimum number of mirrored observations for these two settings."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        margins = [self.margin, *self._anchor_margins("at_least").values()]
        if self.model == "returns":
            if self.return_bound is None:
                raise ValueError("model: returns requires return_bound, the maximum difference of returns in a block")
            if not -self.return_bound < self.return0 <= self.return1 < self.return_bound:
                raise ValueError(
                    f"return0 and return1 must lie within ±{self.return_bound:g} (return_bound), return0 first,"
                    f" got {self.return0:g} and {self.return1:g}"
                )
            if max(margins) >= self.return_bound:
                raise ValueError(
                    f"margin, which is a return with model: returns, must be smaller than return_bound"
                    f" ({self.return_bound:g}), got {max(margins):g}"
                )
            return self
        if not self.elo0 < self.elo1:
            raise ValueError(f"elo1 must be greater than elo0 ({self.elo0:g})")
        if self.model == "normalized" and max(-self.elo0, self.elo1, *margins) > MAX_NORMALIZED_ELO:
            raise ValueError(
                f"elo0, elo1 and margins must lie within ±{MAX_NORMALIZED_ELO} (normalized Elo),"
                f" got {self.elo0:g}, {self.elo1:g} and {max(margins):g}"
            )
        return self

    @model_validator(mode="after")
    def _margins_are_possible(self) -> Self:
        largest = 2 * (self.return_bound or 0) if self.model == "returns" else 1.0
        margins = {
            "exploiter_margin": self.margin_against_exploiters,
            "exploiters.improvement": self.exploiters.improvement,
            **self._anchor_margins("no_worse"),
        }
        for setting, margin in margins.items():
            if margin >= largest:
                name = "twice return_bound" if self.model == "returns" else "all points"
                raise ValueError(f"{setting} must be smaller than {largest:g} ({name}), got {margin:g}")
        return self

    def _anchor_margins(self, mode: AnchorMode) -> dict[str, float]:
        """Return setting → margin, of the anchors with this mode that have one."""
        return {
            f"anchors[{i}].margin": anchor.margin
            for i, anchor in enumerate(self.anchors)
            if anchor.margin is not None and anchor.tested_mode == mode
        }

    @property
    def requires_gain(self) -> bool:
        """Whether a candidate must be stronger than the champion; otherwise it must not be inferior."""
        return (self.return0 if self.model == "returns" else self.elo0) >= 0

    def against_baseline(self) -> Self:
        """Return the settings of the first test without a champion, which shows a gain over a script in any case.

        If H0 is that the candidate is weaker by a margin, it becomes equal strength, and H1 at least that margin.
        """
        if self.requires_gain:
            return self
        if self.model == "returns":
            return self.model_copy(update={"return0": 0.0, "return1": max(self.return1, -self.return0)})
        return self.model_copy(update={"elo0": 0.0, "elo1": max(self.elo1, -self.elo0)})

    def margin_of(self, anchor: AnchorConfig) -> float:
        """Return the margin of an anchor or its default, in the unit of its mode."""
        if anchor.margin is not None:
            return anchor.margin
        return self.margin if anchor.tested_mode == "at_least" else self.margin_against_exploiters

    def against_anchor(self, margin: float) -> Self:
        """Return the settings of a test of the mode `at_least`. H0: weaker by the margin; H1: equally strong."""
        below = -margin
        zero = {"return0": below, "return1": 0.0} if self.model == "returns" else {"elo0": below, "elo1": 0.0}
        return self.model_copy(update=zero)

    @property
    def margin_against_exploiters(self) -> float:
        """`exploiter_margin` or its default."""
        if self.exploiter_margin is not None:
            return self.exploiter_margin
        return self.margin if self.model == "returns" else EXPLOITER_MARGIN

    def compared_with_champion(self, margin: float) -> Self:
        """Return the settings of a paired test against an exploiter or an anchor, which observes half of the difference
        between candidate and champion. H0: the candidate is worse by the margin; H1: it is as good.
        """
        return self._of_pairs(-margin, 0.0)

    def of_exploitability(self, margin: float, improvement: float = 0.0) -> Self:
        """Return the settings of the test of exploitability, which observes half of the difference between the results
        of candidate and champion against their own exploiters.

        H0: the candidate is more exploitable by the margin; H1: it is as exploitable. With an improvement, H0: it is as
        exploitable; H1: it is less exploitable by the improvement.
        """
        return self._of_pairs(0.0, improvement) if improvement else self._of_pairs(-margin, 0.0)

    def _of_pairs(self, low: float, high: float) -> Self:
        """Return the settings of a test of half of a difference between candidate and champion. H0: it is `low`; H1: it
        is `high`.

        A score of ½ + difference/2 is expressed in Elo of the model `logistic`, whose hypotheses are mean scores. Those
        of `normalized` would depend on how alike the games of candidate and champion are.
        """
        if self.model == "returns":
            return self.model_copy(update={"return0": low / 2, "return1": high / 2})
        elo0, elo1 = (400 * log10((1 + difference) / (1 - difference)) for difference in (low, high))
        return self.model_copy(update={"model": "logistic", "elo0": elo0, "elo1": elo1})

    def of_one_verdict(self, alpha: float) -> Self:
        """Return the settings of one verdict with error probability `alpha`."""
        return self.model_copy(update={"alpha": alpha, "nights": None})
