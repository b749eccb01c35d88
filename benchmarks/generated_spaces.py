"""Environments with generated spaces, and everything that happens to an environment after `league check-env`.

Every type and nesting of Gymnasium, odd names of keys, action masks, agents with different spaces, all three APIs. What
`check-env` accepts is trained for one update, exported, compared with its module, published, and served to requests of
both protocols by a replica in this process. What fails then is a fault.
"""

import functools
import json
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import AECEnv, ParallelEnv
from ray.rllib.core.learner.training_data import TrainingData
from ray.rllib.env.multi_agent_env import MultiAgentEnv
from starlette.testclient import TestClient
from torch.onnx._internal.exporter._registration import ONNXRegistry

from league.config.league import LeagueConfig
from league.environments.building import interface
from league.environments.conformance.examination import examine
from league.errors import one_line, raised_at
from league.interface import Interface
from league.registry.registry import Registry
from league.settings import Storage
from league.spaces import ACTION_MASK, inputs
from league.spaces.arrays import mask_size, tensors
from league.spaces.conversion import from_gymnasium, to_gymnasium
from serve_app.app import Replica
from serve_app.openapi.document import observation as example
from serve_app.settings import ServeSettings
from training.algorithms.rllib_config import algorithm_config
from training.export import parity
from training.export.publish import MODULES, Checkpoint, publish
from training.learners.ppo import PPOLearner
from training.sampling.env_runner import BatchedEnvRunner

AGENTS = ("player_0", "player_1")
KEYS = (
    "observation", "observations", "obs", "real_obs", "position", "speed", "", " ", "a b", "a.b", "a", "b", "x/y",
    "größe", "状態", "0", "state_in_0", "state_in_action", "action", "__all__", "observation.a", "action_mask ",
    "/action_mask",
)  # fmt: skip
FLOATS = (np.float32, np.float32, np.float32, np.float64, np.float16)
INTEGERS = (np.int8, np.uint8, np.int16, np.uint16, np.int32, np.uint32, np.int64, np.uint64)
SHAPES = ((), (), (1,), (2,), (3,), (2, 2), (4, 4, 3), (1, 1, 1, 2))
RARE_SHAPES = ((0,), (2, 0))
STEPS = 6
"""Actions of an agent in a game."""
REPLICA = ServeSettings(poll=5.0, poll_slowest=5.0, heartbeat=5.0, timeout=120.0, run_timeout=60.0)


class Generator:
    """Draws spaces."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def agent(self) -> tuple[gymnasium.Space[Any], gymnasium.Space[Any]]:
        """Return the observation and the action space of an agent."""
        action = self.action()
        return self._observation(action), action

    def action(self) -> gymnasium.Space[Any]:
        """Return an action space. One in ten has a type that cannot be learnt."""
        draw = self._pick((self.discrete, self.discrete, self.multi_discrete, self.box_of_floats, self.box_of_floats))
        return (
            self._leaf() if self._rng.random() < 0.05 else self._unsupported() if self._rng.random() < 0.03 else draw()
        )

    def _observation(self, action: gymnasium.Space[Any]) -> gymnasium.Space[Any]:
        if self._rng.random() < 0.03:
            return self._unsupported()
        if self._rng.random() < 0.4:
            return self._leaf()
        parts = self._parts(depth=2)
        if self._rng.random() < 0.5:
            parts[ACTION_MASK] = self._mask(action)
        if self._rng.random() < 0.02:
            parts["text"] = self._unsupported()
        return spaces.Dict(parts)

    def _parts(self, depth: int) -> dict[str, gymnasium.Space[Any]]:
        count = 0 if self._rng.random() < 0.01 else int(self._rng.integers(1, 4))
        names = self._rng.choice(KEYS, size=count, replace=False).tolist()
        return {
            name: spaces.Dict(self._parts(depth - 1)) if depth and self._rng.random() < 0.2 else self._leaf()
            for name in names
        }

    def _mask(self, action: gymnasium.Space[Any]) -> gymnasium.Space[Any]:
        sizes = {spaces.Discrete: lambda: int(action.n), spaces.MultiDiscrete: lambda: int(np.sum(action.nvec))}  # type: ignore[attr-defined]
        size = sizes.get(type(action), lambda: 3)()
        if self._rng.random() < 0.1:
            size += 1
        kinds = [
            lambda: spaces.Box(0, 1, (size,), self._pick((np.int8, np.float32, np.uint8, np.int64, np.bool_))),
            lambda: spaces.MultiBinary(size),
            lambda: spaces.MultiDiscrete([2] * size),
        ]
        return self._pick(kinds)()

    def _leaf(self) -> gymnasium.Space[Any]:
        kinds = (self.discrete, self.multi_discrete, self._multi_binary, self.box_of_floats, self._box_of_integers)
        return self._pick(kinds)()

    def _unsupported(self) -> gymnasium.Space[Any]:
        kinds = (
            lambda: spaces.Text(5),
            lambda: spaces.Tuple([spaces.Discrete(2), spaces.Box(0, 1, (2,))]),
            lambda: spaces.Sequence(spaces.Discrete(2)),
            lambda: spaces.Graph(spaces.Box(0, 1, (2,)), None),
            lambda: spaces.OneOf([spaces.Discrete(2), spaces.Discrete(3)]),
            lambda: spaces.Dict({"move": spaces.Discrete(2), "force": spaces.Box(0, 1, (2,))}),
        )
        return self._pick(kinds)()

    def discrete(self) -> spaces.Discrete:
        """A Discrete, sometimes with another start or a dtype of fewer bits, sometimes at the limits of int64."""
        n = int(self._rng.integers(1, 6))
        limits = np.iinfo(np.int64)
        start = self._pick((0, 0, 0, 3, -2, -1000, int(limits.min), int(limits.max) - n))
        if start in (0, 3) and self._rng.random() < 0.2:
            return spaces.Discrete(n, start=start, dtype=self._pick((np.int32, np.uint8, np.int16)))
        return spaces.Discrete(10**9 if self._rng.random() < 0.01 else n, start=start)

    def multi_discrete(self) -> spaces.MultiDiscrete:
        """A MultiDiscrete of up to two dimensions."""
        shape = self._pick(((1,), (2,), (3,), (2, 2)))
        nvec = self._rng.integers(1, 5, shape)
        start = self._pick((None, None, None, self._rng.integers(-3, 4, shape)))
        dtype = self._pick((np.int64, np.int64, np.int32, np.int16))
        return spaces.MultiDiscrete(nvec, dtype=dtype, start=start)

    def _multi_binary(self) -> spaces.MultiBinary:
        return spaces.MultiBinary(self._pick((1, 3, (2,), (2, 3), [1, 2, 2])))

    def box_of_floats(self) -> spaces.Box:
        """A Box with bounds of all kinds: both, one, none, equal, huge, or different for each element."""
        dtype, shape = self._pick(FLOATS), self._shape()
        largest = float(np.finfo(dtype).max)
        pairs = (
            (-1, 1), (-1, 1), (0, 1), (-1, 1), (0, 255), (-np.inf, np.inf), (-np.inf, np.inf), (0, np.inf),
            (-np.inf, 3), (2, 2), (0, 0), (-largest, largest), (0, largest / 2), (-1e-30, 1e-30),
            (1000, 1001), (-np.inf, -5),
        )  # fmt: skip
        if self._rng.random() < 0.7:
            return spaces.Box(*self._pick(pairs), shape, dtype)
        bounds = [self._pick(pairs) for _ in range(int(np.prod(shape)))]
        low, high = (np.array([pair[i] for pair in bounds], dtype).reshape(shape) for i in (0, 1))
        return spaces.Box(low, high, shape, dtype)

    def _box_of_integers(self) -> spaces.Box:
        if self._rng.random() < 0.15:
            return spaces.Box(0, 1, self._shape(), np.bool_)
        dtype = self._pick(INTEGERS)
        limits = np.iinfo(dtype)
        pairs = ((0, 1), (0, 100), (5, 5), (limits.min, limits.max), (limits.max - 1, limits.max))
        return spaces.Box(*self._pick(pairs), self._shape(), dtype)

    def _shape(self) -> tuple[int, ...]:
        return self._pick(RARE_SHAPES if self._rng.random() < 0.01 else SHAPES)

    def _pick(self, options: Any) -> Any:
        return options[int(self._rng.integers(len(options)))]


@dataclass(frozen=True)
class Case:
    """An environment. agents: their observation and action spaces."""

    seed: int
    api: str
    agents: Mapping[str, tuple[gymnasium.Space[Any], gymnasium.Space[Any]]]
    training: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, seed: int) -> "Case":
        """Generate a case."""
        rng = np.random.default_rng(seed)
        generator = Generator(rng)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            first = generator.agent()
            second = generator.agent() if rng.random() < 0.15 else first
        api = ("parallel", "aec", "rllib")[int(rng.integers(3))]
        training = {"normalize_observations": bool(rng.random() < 0.2)}
        if rng.random() < 0.15:
            training["recurrence"] = {"width": 8}
        return cls(seed, api, dict(zip(AGENTS, (first, second), strict=True)), training)

    def league(self) -> LeagueConfig:
        """Return the league of this case, with the smallest network."""
        training = {
            "steps": 100, "runners": 0, "hidden": [4], "num_envs": 2, "train_batch_size": 32, "minibatch_size": 16,
            "epochs": 1, "strength": None, **self.training,
        }  # fmt: skip
        document = {
            "league": f"case-{self.seed}",
            "environment": {"entry_point": "benchmarks.generated_spaces:environment", "kwargs": {"seed": self.seed}},
            "training": training,
        }
        return LeagueConfig.from_mapping(document)

    def __str__(self) -> str:
        agents = "; ".join(dict.fromkeys(f"{observed} → {acted}" for observed, acted in self.agents.values()))
        return " ".join(f"seed {self.seed}, {self.api}, {dict(self.training)}, {agents}".split())


class Sampler:
    """Draws values of a space, sometimes at its bounds, and legal masks."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)

    def observation(self, space: gymnasium.Space[Any], action: gymnasium.Space[Any]) -> Any:
        """Draw an observation. A key `action_mask` of the right size allows at least one action."""
        if isinstance(space, spaces.Dict):
            return {
                key: self._mask(part, action) if key == ACTION_MASK else self.observation(part, action)
                for key, part in space.spaces.items()
            }
        if isinstance(space, spaces.Box) and space.dtype.kind == "f":
            return self._floats(space)
        if isinstance(space, spaces.Box):
            # Gymnasium fails at the limits of 64 bits.
            return np.where(self._rng.random(space.shape) < 0.5, space.low, space.high).astype(space.dtype)
        space.seed(int(self._rng.integers(2**31)))
        return space.sample()

    def _mask(self, space: gymnasium.Space[Any], action: gymnasium.Space[Any]) -> Any:
        size, shape = mask_size(from_gymnasium(action)), space.shape
        if size is None or shape != (size,):
            return self.observation(space, action)
        sizes = np.ravel(action.nvec) if isinstance(action, spaces.MultiDiscrete) else [size]
        parts = [self._rng.integers(0, 2, n) for n in sizes]
        for part in parts:
            part[self._rng.integers(len(part))] = 1
        return np.concatenate(parts).astype(space.dtype)

    def _floats(self, space: spaces.Box) -> NDArray[Any]:
        largest = min(float(np.finfo(space.dtype).max), 1e30)
        low, high = (np.clip(bound.astype(np.float64), -largest, largest) for bound in (space.low, space.high))
        narrow_low, narrow_high = np.maximum(low, np.minimum(-3, high)), np.minimum(high, np.maximum(3, low))
        drawn = self._rng.uniform(narrow_low, narrow_high)
        return np.clip(np.asarray(drawn).astype(space.dtype), space.low, space.high).astype(space.dtype)


class Game:
    """What the three APIs share. A game ends after as many steps as the case says; a reward is 1 now and then."""

    def __init__(self, case: Case) -> None:
        self.case = case
        self.metadata: dict[str, Any] = {"name": "generated", "is_parallelizable": True}
        self.render_mode = None
        self.possible_agents, self.agents = list(AGENTS), list(AGENTS)
        self.sampler, self.turn = Sampler(0), 0

    def begin(self, seed: int | None) -> None:
        """Start a game."""
        self.sampler, self.turn = Sampler(seed or 0), 0
        self.agents = list(AGENTS)

    def observe_all(self) -> dict[str, Any]:
        """Draw an observation of each agent."""
        return {agent: self.sampler.observation(*spaces) for agent, spaces in self.case.agents.items()}

    def check(self, agent: str, action: Any) -> None:
        """Raise AssertionError unless an action has the type and the range of what `sample` returns."""
        space = self.case.agents[agent][1]
        # Gymnasium cannot sample from the whole range of float64.
        expected = type(space.sample()) if isinstance(space, spaces.Discrete) else np.ndarray
        assert type(action) is expected, f"{agent} acts with {type(action)}, expected {expected}"
        assert space.contains(action), f"{agent} acts with {action!r}, outside of {space}"

    def observation_space(self, agent: str) -> gymnasium.Space[Any]:
        """Return the observation space of an agent."""
        return self.case.agents[agent][0]

    def action_space(self, agent: str) -> gymnasium.Space[Any]:
        """Return the action space of an agent."""
        return self.case.agents[agent][1]


class ParallelGame(Game, ParallelEnv):
    """A game with PettingZoo's Parallel API."""

    def reset(self, seed: int | None = None, options: Any = None) -> Any:  # noqa: ARG002
        """Start a game."""
        self.begin(seed)
        return self.observe_all(), {agent: {} for agent in AGENTS}

    def step(self, actions: dict[str, Any]) -> Any:
        """Step all agents."""
        for agent, action in actions.items():
            self.check(agent, action)
        self.turn += 1
        over = self.turn >= STEPS
        self.agents = [] if over else list(AGENTS)
        rewards = dict.fromkeys(AGENTS, float(self.turn % 2))
        flags = dict.fromkeys(AGENTS, over), dict.fromkeys(AGENTS, False)
        return self.observe_all(), rewards, *flags, {agent: {} for agent in AGENTS}


class TurnGame(Game, AECEnv):
    """A game with PettingZoo's AEC API."""

    def reset(self, seed: int | None = None, options: Any = None) -> None:  # noqa: ARG002
        """Start a game."""
        self.begin(seed)
        self.rewards, self._cumulative_rewards = dict.fromkeys(AGENTS, 0.0), dict.fromkeys(AGENTS, 0.0)
        self.terminations, self.truncations = dict.fromkeys(AGENTS, False), dict.fromkeys(AGENTS, False)
        self.infos: dict[str, Any] = {agent: {} for agent in AGENTS}
        self.agent_selection, self.seen = AGENTS[0], self.observe_all()

    def observe(self, agent: str) -> Any:
        """Return the observation of an agent."""
        return self.seen[agent]

    def step(self, action: Any) -> None:
        """Step the agent whose turn it is."""
        agent = self.agent_selection
        if self.terminations[agent]:
            self._was_dead_step(action)
            return
        self.check(agent, action)
        self._cumulative_rewards[agent] = 0.0
        self.turn += 1
        self.rewards = dict.fromkeys(AGENTS, float(self.turn % 2))
        if self.turn >= 2 * STEPS:
            self.terminations = dict.fromkeys(AGENTS, True)
        self.seen = self.observe_all()
        self.agent_selection = AGENTS[self.turn % 2]
        self._accumulate_rewards()


class RLlibGame(Game, MultiAgentEnv):
    """A game with RLlib's API."""

    def __init__(self, case: Case) -> None:
        MultiAgentEnv.__init__(self)
        Game.__init__(self, case)
        self.observation_spaces = {agent: observed for agent, (observed, _) in case.agents.items()}
        self.action_spaces = {agent: acted for agent, (_, acted) in case.agents.items()}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:  # noqa: ARG002
        """Start a game."""
        self.begin(seed)
        return self.observe_all(), {}

    def step(self, actions: dict[str, Any]) -> Any:
        """Step all agents."""
        for agent, action in actions.items():
            self.check(agent, action)
        self.turn += 1
        over = {"__all__": self.turn >= STEPS}
        return self.observe_all(), dict.fromkeys(AGENTS, float(self.turn % 2)), over, {"__all__": False}, {}


APIS: dict[str, Callable[[Case], Any]] = {"parallel": ParallelGame, "aec": TurnGame, "rllib": RLlibGame}


@functools.lru_cache(maxsize=4)
def case_of(seed: int) -> Case:
    """Generate a case once."""
    return Case.of(seed)


def environment(seed: int) -> Any:
    """Return the environment of a case: the entry point of its league."""
    case = case_of(seed)
    return APIS[case.api](case)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a case. refusal: the reason of `check-env`. failure: the stage that failed after it, and why."""

    seed: int
    refusal: str | None = None
    failure: str | None = None


class Pipeline:
    """Everything that happens to an environment after `check-env`, in this process."""

    def __init__(self, home: Path) -> None:
        self._home = home
        self._registry = Registry.open(Storage.at(home))
        server = Replica(Registry.open(Storage.at(home)), REPLICA, "replica", evaluation_client=None)
        self._client = TestClient(server.application(), base_url="http://localhost", headers={"host": "localhost"})
        self._client.__enter__()

    def close(self) -> None:
        """Stop the replica."""
        self._client.__exit__(None, None, None)
        self._registry.close()

    def outcome(self, case: Case, published: bool = True) -> Outcome:
        """Check and train a case, and export, publish and serve it if wanted. Never raises."""
        stage = "check-env"
        try:
            config = case.league()
            examination = examine(config, episodes=1)
            faults = [str(finding) for finding in examination.findings if finding.severity == "fault"]
            crashes = [fault for fault in faults if "raised an exception" in fault]
            if crashes:
                return Outcome(case.seed, failure=f"check-env: {crashes[0]}")
            if faults:
                return Outcome(case.seed, refusal=faults[0])
            described = interface(config)
            stage = "one update"
            checkpoint = self._trained(config, described)
            if not published:
                return Outcome(case.seed)
            stage = "export and parity"
            self._registry.leagues.register(config, described)
            publish(
                Checkpoint(checkpoint, source="run/32", steps=32), registry=self._registry, config=config,
                interface=described, parent=None, git_commit=None,
            )  # fmt: skip
            for policy in described.policy_ids:
                agent = next(agent for agent in described.agents if described.policies[agent] == policy)
                stage = "a request"
                self._request(case, described, agent, policy)
                stage = "a request of the Open Inference Protocol"
                self._infer(case, described, agent, policy)
        except Exception as error:
            where = raised_at(error) or traceback.format_exc().strip().splitlines()[-3].strip()
            return Outcome(case.seed, failure=f"{stage}: {one_line(error, with_type=True)} ({where})")
        return Outcome(case.seed)

    def _trained(self, config: LeagueConfig, described: Interface) -> Path:
        """Play and update once; return the checkpoint."""
        algorithm = algorithm_config(config, described)
        runner = BatchedEnvRunner(config=algorithm, worker_index=0)
        try:
            chunks = runner.sample_chunks(num_timesteps=32)
        finally:
            runner.stop()
        learner = PPOLearner(config=algorithm, module_spec=algorithm.rl_module_spec)
        learner.build()
        learner.update(training_data=TrainingData(episodes=chunks), num_epochs=1, minibatch_size=16)
        for policy in described.policy_ids:
            for name, value in learner.module[policy].state_dict().items():
                if not value.isfinite().all():
                    raise ArithmeticError(f"{name} is not finite after one update")
        path = self._home / "runs" / config.league
        learner.module.save_to_path(path / MODULES)
        return path

    def _request(self, case: Case, described: Interface, agent: str, policy: str) -> None:
        """Send the environment's own observation, and the example of the documentation, as JSON."""
        model = f"case-{case.seed}.{policy}"
        value = self._observation(case, described, agent)
        for body in (_lists(value), example(described.agents[agent].observation)):
            content = json.dumps({"observation": body, "probabilities": True})
            response = self._client.post(f"/v1/policies/{model}/action?version=1", content=content)
            if response.status_code != 200:
                raise ValueError(f"{response.status_code} {response.text[:200]}")
            space = to_gymnasium(from_gymnasium(case.agents[agent][1]))
            action = np.array(response.json()["action"], space.dtype)
            if not space.contains(action):
                raise ValueError(f"the action {response.json()['action']} is not in {space}")

    def _infer(self, case: Case, described: Interface, agent: str, policy: str) -> None:
        arrays = tensors(described.agents[agent].observation, self._observation(case, described, agent))
        path = f"/v2/models/case-{case.seed}.{policy}/versions/1"
        metadata = self._client.get(path)
        if metadata.status_code != 200:
            raise ValueError(f"{metadata.status_code} {metadata.text[:200]}")
        datatypes = {tensor["name"]: tensor["datatype"] for tensor in metadata.json()["inputs"]}
        body = {
            "inputs": [
                {"name": name, "datatype": datatypes[name], "shape": [1, *array.shape], "data": array.ravel().tolist()}
                for name, array in arrays.items()
            ]
        }
        response = self._client.post(f"{path}/infer", content=json.dumps(body))
        if response.status_code != 200:
            raise ValueError(f"{response.status_code} {response.text[:200]}")

    @staticmethod
    def _observation(case: Case, described: Interface, agent: str) -> Any:
        value = Sampler(case.seed).observation(*case.agents[agent])
        assert list(tensors(described.agents[agent].observation, value)) == list(
            inputs(described.agents[agent].observation)
        )
        return value


def _lists(value: Any) -> Any:
    """Return an observation as JSON."""
    if isinstance(value, Mapping):
        return {key: _lists(part) for key, part in value.items()}
    return np.asarray(value).tolist()


@contextmanager
def pipeline() -> Iterator[Pipeline]:
    """A pipeline in a temporary directory, which compares fewer observations per policy than a training run."""
    # The exporter parses its 500 operators at each export, which takes half of its time.
    operators = staticmethod(functools.cache(ONNXRegistry.from_torchlib))
    with (
        tempfile.TemporaryDirectory() as scratch,
        warnings.catch_warnings(),
        patch.object(ONNXRegistry, "from_torchlib", operators),
        patch.multiple(parity, EXPORTED=replace(parity.EXPORTED, observations=64), MIN_OBSERVATIONS=64),
        patch.object(gymnasium.logger, "min_level", gymnasium.logger.ERROR),
        closing(Pipeline(Path(scratch))) as line,
    ):
        warnings.simplefilter("ignore")
        yield line
