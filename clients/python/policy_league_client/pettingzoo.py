"""Plays one episode of a PettingZoo environment, AEC or Parallel, with policies of a server.

    from policy_league_client import Client
    from policy_league_client.pettingzoo import play

    with Client() as client:
        for step in play(environment, client, {"player_0": "connect_four", "player_1": "connect_four@3"}, seed=7):
            print(step.agent, step.action, step.reward)

The environment must be the one of the league with its wrappers, as built by `league.environments.building`. This module
does not import PettingZoo.
"""

from collections.abc import Callable, Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any

from policy_league_client import Client
from policy_league_client.errors import InvalidInput
from policy_league_client.responses import VERSION_GONE, ActionResponse, Model, episode_interrupted, parse_model
from policy_league_client.seeds import derive

Player = str | Callable[[Any], Any]
"""A model, `connect_four@3`, or a function from an observation to an action."""


@dataclass(frozen=True, slots=True)
class Step:
    """A step of one agent, from its action to its next turn or its end.

    Attributes:
        agent: Name of the agent.
        observation: The observation before the action.
        action: The action.
        reward: Sum of the rewards since the action.
        next_observation: The observation at the agent's next turn or end, also for a truncated agent.
        terminated: Whether the agent has terminated.
        truncated: Whether the agent was truncated.
        response: The server's response; None if a function chose the action.
    """

    agent: str
    observation: Any
    action: Any
    reward: float
    next_observation: Any
    terminated: bool
    truncated: bool
    response: ActionResponse | None


def play(
    environment: Any,
    client: Client,
    players: Mapping[str, Player],
    *,
    seed: int | None = None,
    explore: bool | None = None,
    probabilities: bool = False,
) -> Iterator[Step]:
    """Play one episode. The version of each model is fixed by its first response.

    Args:
        environment: A PettingZoo environment.
        client: Client of the server.
        players: Model or function for every possible agent. Each agent has its own recurrent state.
        seed: Seed of the environment's reset and of sampled actions.
        explore: See `Client.act`.
        probabilities: Include the action probabilities in each step's response.

    Yields:
        The steps, in the order in which they end.

    Raises:
        InvalidInput: An agent has no player.
        VersionRetired: The version of a model is not available any more.
        LeagueError: See `Client`.
    """
    actors = _Actors(client, players, list(environment.possible_agents), seed, explore, probabilities)
    if hasattr(environment, "agent_iter"):
        return _play_aec(environment, actors, seed)
    return _play_parallel(environment, actors, seed)


@dataclass
class _ModelState:
    """A model and the recurrent states of the agents that it controls."""

    model: Model
    states: dict[str, str | None] = field(default_factory=dict)
    steps: int = 0


class _Actors:
    """Chooses the actions of all agents. Agents that act simultaneously with one model share a request."""

    def __init__(
        self,
        client: Client,
        players: Mapping[str, Player],
        agents: list[str],
        seed: int | None,
        explore: bool | None,
        probabilities: bool,
    ) -> None:
        if missing := [agent for agent in agents if agent not in players]:
            raise InvalidInput(
                f"no player for {', '.join(map(str, missing))}: specify one for each of {', '.join(map(str, agents))}"
            )
        self._client = client
        self._players = players
        self._indices = {agent: index for index, agent in enumerate(agents)}
        self._models = {name: _ModelState(parse_model(name)) for name in players.values() if isinstance(name, str)}
        self._seed = seed
        self._explore = explore
        self._probabilities = probabilities
        self._time = 0

    def act(self, observations: Mapping[str, Any]) -> dict[str, tuple[Any, ActionResponse | None]]:
        """Return the action of each agent, with the server's response."""
        actions: dict[str, tuple[Any, ActionResponse | None]] = {}
        requested: dict[str, dict[str, Any]] = {}
        for agent, observation in observations.items():
            player = self._players[agent]
            if isinstance(player, str):
                requested.setdefault(player, {})[agent] = observation
            else:
                actions[agent] = player(observation), None
        for name, of_model in requested.items():
            actions |= self._request(self._models[name], of_model)
        self._time += 1
        return actions

    def _request(
        self, controlled: _ModelState, observations: dict[str, Any]
    ) -> dict[str, tuple[Any, ActionResponse | None]]:
        agents = list(observations)
        states = [controlled.states.get(agent) for agent in agents]
        seeds = None if self._seed is None else [derive(self._seed, self._indices[a], self._time) for a in agents]
        try:
            batch = self._client.act_batch(
                str(controlled.model),
                list(observations.values()),
                explore=self._explore,
                seed=seeds,
                probabilities=self._probabilities,
                state=states if any(states) else None,
            )
        except VERSION_GONE as error:
            if not controlled.steps:
                raise
            raise episode_interrupted(controlled.model, controlled.steps, error) from error
        controlled.model, controlled.steps = controlled.model.at(batch.version), controlled.steps + 1
        responses = [batch.response(row) for row in range(len(agents))]
        controlled.states |= {agent: response.state for agent, response in zip(agents, responses, strict=True)}
        return {agent: (response.action, response) for agent, response in zip(agents, responses, strict=True)}


def _play_aec(environment: Any, actors: _Actors, seed: int | None) -> Iterator[Step]:
    """An agent's step ends at its next turn."""
    environment.reset(seed=seed)
    pending: dict[str, tuple[Any, Any, ActionResponse | None]] = {}
    for agent in environment.agent_iter():
        observation, reward, terminated, truncated, _ = environment.last()
        observation = deepcopy(observation)  # some environments reuse the array
        if agent in pending:
            before, action, response = pending.pop(agent)
            yield Step(agent, before, action, float(reward), observation, terminated, truncated, response)
        action = None
        if not (terminated or truncated):
            action, response = actors.act({agent: observation})[agent]
            pending[agent] = observation, action, response
        environment.step(action)


def _play_parallel(environment: Any, actors: _Actors, seed: int | None) -> Iterator[Step]:
    """All agents act simultaneously."""
    observations, _ = environment.reset(seed=seed)
    while environment.agents:
        before = deepcopy({agent: observations[agent] for agent in environment.agents})
        actions = actors.act(before)
        observations, rewards, terminations, truncations, _ = environment.step(
            {agent: action for agent, (action, _) in actions.items()}
        )
        for agent, (action, response) in actions.items():
            yield Step(
                agent,
                before[agent],
                action,
                float(rewards[agent]),
                deepcopy(observations[agent]),
                bool(terminations[agent]),
                bool(truncations[agent]),
                response,
            )
