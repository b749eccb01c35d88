"""Episodes as they were reported."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from league.environments.adapters import Observation, Report


@dataclass(slots=True)
class Recording:
    """An episode.

    Attributes:
        seed: Seed of the episode.
        turns: The reports of `reset` and of each step so far.
        is_whole: Whether it ended, and was not cut.
    """

    seed: int
    turns: list[Sequence[Report]] = field(default_factory=list)
    is_whole: bool = False

    @property
    def steps(self) -> int:
        """Environment steps, in which several agents may act."""
        return len(self.turns) - 1

    @property
    def reports(self) -> list[Report]:
        """All reports, in order."""
        return [report for turn in self.turns for report in turn]

    @property
    def actions(self) -> int:
        """Number of actions of the agent with the most, if the episode is whole."""
        counts = Counter(agent for agent, _, _, *flags in self.reports if not any(flags))
        return max(counts.values(), default=0)

    @property
    def place(self) -> str:
        """Where an exception was raised, if the episode was interrupted by it."""
        place = f"step {len(self.turns)} of the episode" if self.turns else "reset"
        return f"{place} with seed {self.seed}"

    def returns(self, agents: int) -> list[float]:
        """The return of each agent. agents: their number."""
        returns = [0.0] * agents
        for agent, _, reward, *_ in self.reports:
            returns[agent] += reward
        return returns


def joined(observation: Observation) -> bytes:
    """Return the values of an observation as bytes. Those of 0 and -0 are equal."""
    return b"".join((array + 0).tobytes() for array in observation.values())
