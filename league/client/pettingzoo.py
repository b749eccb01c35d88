"""A PettingZoo environment, AEC or Parallel, played through the endpoint: one episode, step by step.

    from league.client import Client
    from league.client.pettingzoo import play

    with Client() as client:
        for step in play(environment, client, {"player_0": "connect_four", "player_1": "connect_four@3"}, seed=7):
            print(step.agent, step.action, step.reward)

The environment must be the league's own, with its wrappers: `league.environments.building` makes it. Nothing of
PettingZoo is imported here.
"""

from collections.abc import Callable, Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any

from league.client.answers import Answer
from league.client.client import Client
from league.client.episode import GONE, retired
from league.client.models import Model, parse_model
from league.errors import InvalidInput
from league.seeds import derive

Player = str | Callable[[Any], Any]
"""A model, `connect_four@3`, or a function from an observation to an action."""


@dataclass(frozen=True, slots=True)
class Step:
    """One agent's step: what it saw, what it did, and what came of that by its next turn or its end.

    reward: all that it was given since it acted. next_observation: the last one too, of an agent that is truncated.
    answer: of the server, with the version, the seed and the probabilities; None if a function has acted.
    """

    agent: str
    observation: Any
    action: Any
    reward: float
    next_observation: Any
    terminated: bool
    truncated: bool
    answer: Answer | None


def play(
    environment: Any,
    client: Client,
    players: Mapping[str, Player],
    *,
    seed: int | None = None,
    explore: bool = False,
    probabilities: bool = False,
) -> Iterator[Step]:
    """Play one episode. Each model stays at the version of its first answer, and each agent has its recurrent state.

    players: agent → model or function, for every possible agent.
    seed: of the reset and, if the policies explore, of their draws.
    probabilities: of all actions, in each step's answer.
    Raises InvalidInput, VersionRetired, or what `Client.act_batch` raises.
    """
    table = _Table(client, players, list(environment.possible_agents), seed, explore, probabilities)
    if hasattr(environment, "agent_iter"):
        return _turns(environment, table, seed)
    return _rounds(environment, table, seed)


@dataclass
class _Group:
    """The agents that one model plays."""

    model: Model
    states: dict[str, str | None] = field(default_factory=dict)
    steps: int = 0


class _Table:
    """Who plays whom. Agents that act at once by one model are answered in one call."""

    def __init__(
        self,
        client: Client,
        players: Mapping[str, Player],
        agents: list[str],
        seed: int | None,
        explore: bool,
        probabilities: bool,
    ) -> None:
        if missing := [agent for agent in agents if agent not in players]:
            raise InvalidInput(f"nobody plays {', '.join(missing)}: name a model for each of {', '.join(agents)}")
        self._client = client
        self._players = players
        self._numbers = {agent: number for number, agent in enumerate(agents)}
        self._groups = {name: _Group(parse_model(name)) for name in players.values() if isinstance(name, str)}
        self._seed = seed
        self._explore = explore
        self._probabilities = probabilities
        self._time = 0

    def act(self, observations: Mapping[str, Any]) -> dict[str, tuple[Any, Answer | None]]:
        """agent → its action, and the answer that it stands in."""
        acted: dict[str, tuple[Any, Answer | None]] = {}
        asked: dict[str, dict[str, Any]] = {}
        for agent, observation in observations.items():
            player = self._players[agent]
            if isinstance(player, str):
                asked.setdefault(player, {})[agent] = observation
            else:
                acted[agent] = player(observation), None
        for name, of_group in asked.items():
            acted |= self._ask(self._groups[name], of_group)
        self._time += 1
        return acted

    def _ask(self, group: _Group, observations: dict[str, Any]) -> dict[str, tuple[Any, Answer | None]]:
        agents = list(observations)
        states = [group.states.get(agent) for agent in agents]
        seeds = None if self._seed is None else [derive(self._seed, self._numbers[a], self._time) for a in agents]
        try:
            batch = self._client.act_batch(
                str(group.model),
                list(observations.values()),
                explore=self._explore,
                seed=seeds,
                probabilities=self._probabilities,
                state=states if any(states) else None,
            )
        except GONE as error:
            if not group.steps:
                raise
            raise retired(group.model, group.steps, error) from error
        group.model, group.steps = group.model.at(batch.version), group.steps + 1
        answers = [batch.answer(row) for row in range(len(agents))]
        group.states |= {agent: answer.state for agent, answer in zip(agents, answers, strict=True)}
        return {agent: (answer.action, answer) for agent, answer in zip(agents, answers, strict=True)}


def _turns(environment: Any, table: _Table, seed: int | None) -> Iterator[Step]:
    """An AEC environment: an agent's step ends at its own next turn."""
    environment.reset(seed=seed)
    begun: dict[str, tuple[Any, Any, Answer | None]] = {}
    for agent in environment.agent_iter():
        observation, reward, terminated, truncated, _ = environment.last()
        observation = deepcopy(observation)  # some environments write the next one into the same array
        if agent in begun:
            before, action, answer = begun.pop(agent)
            yield Step(agent, before, action, float(reward), observation, terminated, truncated, answer)
        action = None
        if not (terminated or truncated):
            action, answer = table.act({agent: observation})[agent]
            begun[agent] = observation, action, answer
        environment.step(action)


def _rounds(environment: Any, table: _Table, seed: int | None) -> Iterator[Step]:
    """A Parallel environment: all agents act at once."""
    observations, _ = environment.reset(seed=seed)
    while environment.agents:
        before = deepcopy({agent: observations[agent] for agent in environment.agents})
        acted = table.act(before)
        observations, rewards, terminations, truncations, _ = environment.step(
            {agent: action for agent, (action, _) in acted.items()}
        )
        for agent, (action, answer) in acted.items():
            yield Step(
                agent,
                before[agent],
                action,
                float(rewards[agent]),
                deepcopy(observations[agent]),
                bool(terminations[agent]),
                bool(truncations[agent]),
                answer,
            )
