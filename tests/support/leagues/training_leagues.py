"""Leagues for tests of training, small or with exactly predictable results."""

from typing import Any

from league.config.league import LeagueConfig

COUNTING = "tests.support.environments.counting:counting"
ENVIRONMENTS = "tests.support.environments.training_environments"


def small(
    entry_point: str, kwargs: dict[str, Any] | None = None, policies: Any = None, name: str = "small", **training: Any
) -> LeagueConfig:
    """A league of any environment, with a small network."""
    settings: dict[str, Any] = {"runners": 0, "num_envs": 3, "hidden": [8], "seed": 5}
    document: dict[str, Any] = {"league": name, "environment": {"entry_point": entry_point, "kwargs": kwargs or {}}}
    document |= {"training": settings | training} | ({"policies": policies} if policies else {})
    return LeagueConfig.from_mapping(document)


def counting(lives: list[int], truncated: list[int], **training: Any) -> LeagueConfig:
    """A policy for each player, as their spaces differ."""
    policies = {f"policy_{i}": [f"player_{i}"] for i in range(len(lives))}
    return small(COUNTING, {"lives": lives, "truncated": truncated}, policies, "counting", **training)


def tictactoe(**training: Any) -> LeagueConfig:
    """One policy for both players, with a small network."""
    settings: dict[str, Any] = {"num_envs": 4, "hidden": [16]}
    return small("pettingzoo.classic.tictactoe_v3", name="tictactoe", **settings | training)


def solvable(name: str, kwargs: dict[str, Any] | None = None, policies: Any = None, **training: Any) -> LeagueConfig:
    """A training environment, with settings that solve it in a few updates."""
    settings: dict[str, Any] = {
        "num_envs": 16,
        "hidden": [32],
        "train_batch_size": 1024,
        "minibatch_size": 128,
        "epochs": 6,
        "lr": 0.003,
        "gamma": 0.9,
        "entropy": 0.001,
    }
    return small(f"{ENVIRONMENTS}:{name}", kwargs, policies or {"shared": ["*"]}, name, **settings | training)


def solvable_by_dqn(
    name: str, kwargs: dict[str, Any] | None = None, policies: Any = None, **training: Any
) -> LeagueConfig:
    """A training environment, with settings of DQN that solve it in a few updates."""
    settings: dict[str, Any] = {
        "algorithm": "dqn",
        "num_envs": 16,
        "hidden": [32],
        "lr": 0.003,
        "gamma": 0.9,
        "learning_starts": 256,
        "batch_size": 64,
        "target_every": 20,
        "exploration": {"steps": 4000},
    }
    return small(f"{ENVIRONMENTS}:{name}", kwargs, policies or {"shared": ["*"]}, name, **settings | training)


def qmix_league(name: str, kwargs: dict[str, Any] | None = None, policies: Any = None, **training: Any) -> LeagueConfig:
    """A training environment, with all agents in one team, and settings of QMIX that solve it in a few updates."""
    settings: dict[str, Any] = {"algorithm": "qmix", "groups": {"team": ["*"]}, "mixing_width": 8}
    return solvable_by_dqn(name, kwargs, policies, **(settings | training))


def maddpg(name: str, kwargs: dict[str, Any], policies: Any, **training: Any) -> LeagueConfig:
    """A training environment, with settings that solve it in some thousand actions."""
    settings: dict[str, Any] = {
        "algorithm": "maddpg",
        "num_envs": 16,
        "hidden": [32],
        "replay_capacity": 20_000,
        "learning_starts": 256,
        "batch_size": 256,
        "update_every": 32,
        "exploration": {"initial": 0.5, "final": 0.1, "steps": 20_000},
    }
    return small(f"{ENVIRONMENTS}:{name}", kwargs, policies, name, **settings | training)
