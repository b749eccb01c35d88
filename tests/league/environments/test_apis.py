"""Environments as people write them: agents of any type, spaces in any place, several APIs."""

import itertools
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils.conversions import parallel_to_aec_wrapper
from ray.rllib.env.multi_agent_env import MultiAgentEnv

from league.config.league import LeagueConfig
from league.environments.apis import RLlibEnv, with_api
from league.environments.building import build, describe
from league.environments.conformance.examination import examine
from league.environments.implementation import stepping
from league.environments.stepping import each_agent_alone
from league.errors import ConfigError, EnvironmentMismatch

SEEN, TAKEN = spaces.Box(-1, 1, (2,), np.float32), spaces.Discrete(3)


class Rounds(ParallelEnv):
    """Five rounds; an agent's reward is its action if its observation is positive. agents: their ids.

    late: the spaces, and with `late="agents"` the agents, exist only after a reset.
    """

    metadata = {"name": "rounds"}  # noqa: RUF012

    def __init__(self, agents: tuple = ("ann", "bob"), late: str = "") -> None:
        self._ids, self._spaces = list(agents), None if late else (SEEN, TAKEN)
        self.possible_agents = [] if late == "agents" else list(agents)

    def observation_space(self, agent: Any) -> Any:
        assert agent in self._ids
        return self._spaces and self._spaces[0]

    def action_space(self, agent: Any) -> Any:
        assert agent in self._ids
        return self._spaces and self._spaces[1]

    def reset(self, seed: int | None = None, options: dict | None = None) -> Any:
        self._spaces, self.possible_agents = (SEEN, TAKEN), list(self._ids)
        self._random, self._round = np.random.default_rng(seed), 0
        self.agents = list(self._ids)
        return self._observed(), {agent: {} for agent in self.agents}

    def _observed(self) -> dict:
        return {agent: self._random.uniform(-1, 1, 2).astype(np.float32) for agent in self.agents}

    def step(self, actions: dict) -> Any:
        assert set(actions) == set(self.agents)
        self._round += 1
        rewards = {agent: float(action) for agent, action in actions.items()}
        over = dict.fromkeys(self.agents, self._round == 5)
        answer = self._observed(), rewards, over, dict.fromkeys(self.agents, False), {agent: {} for agent in over}
        if self._round == 5:
            self.agents = []
        return answer

    def render_for(self, agent: Any) -> Any:
        return np.full((2, 2, 3), self._ids.index(agent), np.uint8)


class Masked(Rounds):
    """`Rounds` with masks in its first infos."""

    def reset(self, seed: int | None = None, options: dict | None = None) -> Any:
        observations, infos = super().reset(seed, options)
        return observations, {agent: {"action_mask": np.ones(3, np.int8)} for agent in infos}


class Group(MultiAgentEnv):
    """`Rounds` with RLlib's API. spaces: where its spaces are."""

    def __init__(self, agents: tuple = ("ann", "bob"), late: str = "", where: str = "dict") -> None:
        self._rounds = Rounds(agents)
        self.possible_agents = [] if late == "agents" else list(agents)
        self._where = where
        if not late:
            self._set_spaces()

    def _set_spaces(self) -> None:
        agents = self._rounds.possible_agents
        if self._where == "dict":
            self.observation_spaces, self.action_spaces = dict.fromkeys(agents, SEEN), dict.fromkeys(agents, TAKEN)
        elif self._where == "Dict":
            self.observation_spaces = spaces.Dict(dict.fromkeys(agents, SEEN))
            self.action_spaces = spaces.Dict(dict.fromkeys(agents, TAKEN))
        elif self._where == "common":
            self.observation_space, self.action_space = SEEN, TAKEN
        elif self._where == "common Dict":
            self.observation_space = spaces.Dict(dict.fromkeys(agents, SEEN))
            self.action_space = spaces.Dict(dict.fromkeys(agents, TAKEN))

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> Any:
        self.possible_agents = self._rounds.possible_agents
        self._set_spaces()
        return self._rounds.reset(seed)

    def step(self, actions: dict) -> Any:
        observations, rewards, terminated, truncated, infos = self._rounds.step(actions)
        return observations, rewards, terminated | {"__all__": all(terminated.values())}, truncated, infos

    def close(self) -> None: ...


class Overriding(Group):
    """Spaces are only returned by methods, as in RLlib's corridor of two rows."""

    def __init__(self, agents: tuple = ("ann", "bob")) -> None:
        super().__init__(agents, where="nowhere")

    def get_observation_space(self, agent: Any) -> Any:
        return SEEN

    def get_action_space(self, agent: Any) -> Any:
        return TAKEN


class Both(Rounds, Group):
    """Parallel, and RLlib's API: the episode ends by `__all__` only."""

    def __init__(self) -> None:
        Rounds.__init__(self)

    def step(self, actions: dict) -> Any:
        observations, rewards, terminated, truncated, infos = super().step(actions)
        return observations, rewards, {"__all__": all(terminated.values())}, truncated, infos


def league(entry_point: str, api: str | None = None, **kwargs: Any) -> LeagueConfig:
    environment = {"entry_point": f"{__name__}:{entry_point}", "kwargs": kwargs, "api": api}
    return LeagueConfig.from_mapping({"league": "x", "environment": environment})


def test_agents_from_an_unordered_set_are_sorted() -> None:
    """RLlib infers the list from a set, whose order differs between processes."""
    env = Group()
    env._agent_ids = {"d", "a", "c", "b"}
    env.possible_agents = list(env._agent_ids)
    assert RLlibEnv(env).possible_agents == ["a", "b", "c", "d"]
    env.possible_agents = ["b", "a"]
    assert RLlibEnv(env).possible_agents == ["b", "a"]


def turns(agents: tuple = ("ann", "bob"), late: str = "") -> AECEnv:
    """`Rounds` in turns."""
    return Turns(Rounds(agents, late))


class Turns(parallel_to_aec_wrapper):
    """PettingZoo's conversion, which would copy the spaces at once."""

    def __init__(self, env: Rounds) -> None:
        AECEnv.__init__(self)
        self.env, self.metadata, self.possible_agents = env, {"name": "turns"}, list(env._ids)

    def observation_space(self, agent: Any) -> Any:
        return self.env.observation_space(agent)

    def action_space(self, agent: Any) -> Any:
        return self.env.action_space(agent)


def rewards(config: LeagueConfig) -> dict[str, float]:
    """The return of each agent that always takes action 2."""
    batched = stepping(config.environment, 1)
    turn = batched.start(each_agent_alone([3], len(batched.agents)))
    total = dict.fromkeys(batched.agents, 0.0)
    while turn.batches:
        turn = batched.step({group: np.full(len(batch), 2) for group, batch in turn.batches.items()})
        for group, batch in turn.batches.items():
            total[batched.agents[group]] += float(batch.rewards[0])
        for ending in turn.each_ending():
            total[batched.agents[ending.agent]] += ending.reward
    batched.close()
    return total


@pytest.mark.parametrize("entry_point", ["Rounds", "turns", "Group", "Overriding"])
def test_agents_of_any_type_have_names_in_results_and_keep_their_ids_in_the_environment(
    entry_point: str, subtests: pytest.Subtests
) -> None:
    for agents in ((0, 1), (("car", 0), ("car", 1)), ("ann", "bob")):
        with subtests.test(agents=agents):
            config = league(entry_point, agents=agents)
            examination = examine(config)
            assert not [str(finding) for finding in examination.findings if finding.severity == "fault"]
            assert examination.interface is not None
            assert list(examination.interface.agents) == list(map(str, agents))
            assert rewards(config) == dict.fromkeys(map(str, agents), 10.0)


def test_the_environments_own_agents_have_different_names() -> None:
    for entry_point in ("Rounds", "Masked"):
        batched = stepping(league(entry_point, agents=(5, 7)).environment, 1)
        batched.start(each_agent_alone([0], 2))
        assert batched.render(0, "7").max() == 1, "a view is requested for its own agent"
    with pytest.raises(EnvironmentMismatch, match=r"agents 1 and '1' have the same name"):
        build(league("Rounds", agents=(1, "1")).environment)


def test_spaces_and_agents_may_exist_only_after_a_reset(subtests: pytest.Subtests) -> None:
    for entry_point, late in itertools.product(("Rounds", "turns", "Group"), ("spaces", "agents")):
        with subtests.test(entry_point=entry_point, late=late):
            config = league(entry_point, late=late)
            examination = examine(config)
            assert examination.passed, examination.findings
            assert rewards(config) == {"ann": 10.0, "bob": 10.0}


def test_rllib_spaces_are_found_in_each_form() -> None:
    for where, agents in itertools.product(("dict", "Dict", "common", "common Dict"), (("ann", "bob"), (0, 1))):
        described = describe(build(league("Group", where=where, agents=agents).environment), league("Group"))
        assert {spaces.action.n for spaces in described.agents.values()} == {3}  # type: ignore[union-attr]
    with pytest.raises(EnvironmentMismatch, match="Group has no observation_space for agent 'ann'"):
        describe(build(league("Group", where="nowhere").environment), league("Group"))


def test_an_environment_with_two_apis_is_stepped_by_the_configured_one() -> None:
    for api, expected in ((None, "Parallel"), ("parallel", "Parallel"), ("rllib", "MultiAgentEnv")):
        examination = examine(league("Both", api=api))
        assert examination.api == expected
        # Its flags fit RLlib's API only.
        assert examination.passed == (api == "rllib"), examination.findings
    with pytest.raises(ConfigError, match="returned a Rounds, expected an RLlib MultiAgentEnv"):
        build(league("Rounds", api="rllib").environment)
    env = Rounds()
    assert with_api(env, "parallel") is env, "strings cost nothing"
