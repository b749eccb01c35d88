"""What a check of an environment finds."""

from dataclasses import dataclass, field
from typing import Literal

from league.environments.conformance.openings import OpeningMeasurement
from league.interface import Interface

CERTAIN_AGREEMENT = 0.95
"""Correlation of returns from which agents count as one team."""

Severity = Literal["fault", "note"]


@dataclass(frozen=True, slots=True)
class Finding:
    """A problem, with the expected behaviour, the affected agents, and an example of the first one."""

    severity: Severity
    text: str
    agents: list[str] = field(default_factory=list)
    example: str = ""

    def __str__(self) -> str:
        text = f"{self.text}; first: {self.example}" if self.example else self.text
        if not self.agents:
            return text
        first, *other_agents = self.agents
        return f"{first}{f' and {len(other_agents)} more' if other_agents else ''}: {text}"


@dataclass(frozen=True, slots=True)
class Vectorised:
    """A vectorised environment that reported the same as its stock environment.

    Attributes:
        steps: Environment steps that were compared.
        copies: Number of copies in the measurement of its speed.
        steps_per_second: Environment steps per second of all copies.
        stock_steps_per_second: The same of the stock environment.
    """

    steps: int
    copies: int
    steps_per_second: float
    stock_steps_per_second: float


@dataclass(slots=True)
class Examination:
    """Distinct findings, and what was measured."""

    findings: list[Finding] = field(default_factory=list)
    api: str = ""
    agents: int = 0
    lengths: list[int] = field(default_factory=list)
    """Environment steps of each episode."""
    actions_per_episode: int | None = None
    """The most actions of one agent in an episode; None if an episode was cut."""
    steps_per_second: float = 0.0
    agreement: float | None = None
    """Smallest correlation of the returns of two agents, 1 if all are equal; None if it was not measured."""
    state_size: int | None = None
    """Size of the global state; None without one."""
    implementation: str = ""
    """How copies of the environment are stepped, and why."""
    policies: str = ""
    """The policies with their agents."""
    actions: str = ""
    """How versions select actions, and why."""
    interface: Interface | None = None
    """Agents, policies and sides; None if the environment cannot be built."""
    openings: OpeningMeasurement | None = None
    """What random openings are worth; None if it was not measured."""
    vectorised: Vectorised | None = None
    """Comparison with the vectorised environment, if there is one."""

    @property
    def is_team(self) -> bool:
        """Whether the returns of all agents agree, as only those of a team do."""
        return self.agreement is not None and self.agreement >= CERTAIN_AGREEMENT

    @property
    def passed(self) -> bool:
        """Whether no fault was found."""
        return all(finding.severity == "note" for finding in self.findings)

    def add(self, severity: Severity, text: str, agent: str | None = None, example: str = "") -> None:
        """Add a finding, or an agent to an equal finding, which keeps its first example."""
        finding = next(
            (candidate for candidate in self.findings if (candidate.severity, candidate.text) == (severity, text)), None
        )
        if finding is None:
            finding = Finding(severity, text, example=example)
            self.findings.append(finding)
        if agent is not None and agent not in finding.agents:
            finding.agents.append(agent)
