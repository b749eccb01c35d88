"""One game for people to watch: any policies, near or behind HTTP, one move at a time. Nothing is recorded."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from league.config import LeagueConfig
from league.environments.lockstep import stepping
from league.environments.building import build
from league.environments.stepping import Episode
from league.errors import UnknownPolicy
from league.interface import Interface
from league.policies.policy import Policy
from league.seeds import generator


@dataclass(frozen=True, slots=True)
class Moment:
    """What an agent saw, and what it did; action None and a reward once it is out of the game.

    observation: ONNX input name → array, as that agent sees it.
    """

    agent: str
    observation: dict[str, NDArray]
    action: Any
    reward: float


def exhibit(config: LeagueConfig, players: Mapping[str, Policy], seed: int) -> Iterator[Moment]:
    """Play one game, agent → policy, and yield it moment by moment. Checkpoints play greedily."""
    environment = stepping(config.environment, copies=1)
    episodes = iter([Episode(seed, environment.agents)])
    draws = {agent: generator(seed, agent) for agent in environment.agents}
    try:
        turn = environment.start(lambda _: next(episodes, None))
        while turn.batches:
            actions = {}
            for agent, batch in turn.batches.items():
                name = str(agent)
                actions[agent] = players[name].act(batch.observations, rng=[draws[name]]).actions
                seen = {key: array[0] for key, array in batch.observations.items()}
                yield Moment(name, seen, actions[agent][0].tolist(), batch.rewards[0])
            turn = environment.step(actions)
            for ending in turn.endings:
                yield Moment(environment.agents[ending.agent], ending.observation, None, ending.reward)
    finally:
        environment.close()


def first_observation(config: LeagueConfig, interface: Interface, policy: str | None, seed: int = 0) -> Any:
    """What `policy` (None: whoever begins) sees first in a fresh episode, as nested lists: the body of a request.

    Raises UnknownPolicy if no agent of that policy ever has the first turn.
    """
    env = build(config.environment)
    try:
        env.reset(seed=seed)
        agent = env.agent_selection
        if policy is not None and interface.policies[agent] != policy:
            raise UnknownPolicy(
                f"{policy!r} does not begin an episode of {config.league} ({interface.policies[agent]!r} does):"
                " give an observation"
            )
        return _lists(env.observe(agent))
    finally:
        env.close()


def _lists(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _lists(part) for key, part in value.items()}
    return value.tolist() if hasattr(value, "tolist") else value
