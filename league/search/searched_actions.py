"""Actions that a search chose, with what it expects. Imports no environment, since replicas import it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

from numpy.typing import NDArray

from league.policies.actions import to_environment
from league.policies.draws import Generators, UniformNumbers, sample
from league.policies.policy import Actions
from league.spaces import Space

MOVES = 12
"""Expected moves that an analysis has, at most."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchedActions(Actions):
    """Actions from a search of k positions. `dist_inputs` are the logits of its improved policy.

    Attributes:
        visits: Simulations through each action, (k, actions) int64.
        values: Mean value for the agent that must act, (k,) float32.
        lines: The moves that the search expects in each position, the best action first; empty unless requested.
        ns: Processor time, in nanoseconds; 0 if it was not measured.
    """

    visits: NDArray
    values: NDArray
    lines: list[list[int]]
    ns: int = 0

    @classmethod
    def of(
        cls, result: Mapping[str, Any], action: Space, explore: bool, rng: Generators | UniformNumbers | None
    ) -> Self:
        """Choose actions.

        Args:
            result: The fields of a `league.search.search.SearchResult`, and optionally `ns`.
            action: The action space.
            explore: Whether to sample from the improved policy instead of taking the best actions.
            rng: See `Policy.act`.
        """
        raw = sample(result["logits"], action, rng) if explore else result["actions"]
        return cls(
            actions=to_environment(raw, action),
            dist_inputs=result["logits"],
            visits=result["visits"],
            values=result["values"],
            lines=[to_environment(line[line >= 0], action).tolist() for line in result["lines"]],
            ns=result.get("ns", 0),
        )

    def simulations(self) -> list[int]:
        """Simulations in each position."""
        simulations: list[int] = self.visits.sum(axis=1).tolist()
        return simulations

    def analyses(self) -> list[dict[str, Any]]:
        """What the search expects in each position, as documents."""
        columns = (self.values.tolist(), self.visits.tolist(), self.lines)
        return [{"value": value, "visits": visits, "line": line} for value, visits, line in zip(*columns, strict=True)]
