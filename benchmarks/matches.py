"""Games of a policy that has just been trained, as matches play them: its graph, greedily, in each seat in turn."""

import tempfile
from pathlib import Path

from ray.rllib.algorithms.algorithm import Algorithm

from evaluation.play import play
from evaluation.schedule import round_robin
from league.config import LeagueConfig
from league.environments.building import interface as interface_of
from league.environments.lockstep import stepping
from league.policies.loading import contestant
from league.policies.onnx import OnnxPolicy
from league.policies.policy import Policy
from league.results.records import Game
from training.export import export_policy

TRAINED = "trained"
COPIES = 128


def graph(algorithm: Algorithm, league: LeagueConfig) -> Policy:
    """The policy of a league that has one, by its exported graph."""
    described = interface_of(league)
    (policy,) = described.policy_ids
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "policy.onnx"
        export_policy(algorithm.learner_group._learner.module[policy], described.of_policy(policy), path)
        return OnnxPolicy(path)


def games(trained: Policy, league: LeagueConfig, opponent: str, count: int, seed: int = 0) -> list[Game]:
    """So many games against a script; the trained policy is contestant 0. Raises IllegalAction if it acts illegally."""
    described = interface_of(league)
    schedule = round_robin(league, described, [TRAINED, opponent], count // 2, seed)
    own = {agent: (policy, trained) for agent, policy in described.policies.items()}
    roster = {TRAINED: own, opponent: contestant(opponent, None, described)}
    environment = stepping(league.environment, COPIES)
    try:
        matches = play(schedule, range(schedule.length), environment, described, roster)
    finally:
        environment.close()
    return [game for match in matches for game in match.games]
