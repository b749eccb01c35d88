"""Games of a newly trained policy, like those of matches: its exported graph, greedily, on each side in turn."""

import tempfile
from collections.abc import Sequence
from pathlib import Path

from ray.rllib.algorithms.algorithm import Algorithm
from scipy.stats import binomtest

from evaluation.matches.game_loop import play_matches
from evaluation.schedules.builders import round_robin
from league.config.league import LeagueConfig
from league.environments.building import interface as interface_of
from league.environments.implementation import stepping
from league.policies.loading import contestant
from league.policies.onnx import OnnxPolicy
from league.policies.policy import Policy
from league.results.records import Game
from training.export.onnx_export import export_policy

TRAINED = "trained"
NUM_ENVS = 128


def graph(algorithm: Algorithm, league: LeagueConfig) -> Policy:
    """The exported graph of the policy of a league with one policy, which plays greedily in any league."""
    league_interface = interface_of(league)
    (policy,) = league_interface.policy_ids
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "policy.onnx"
        export_policy(algorithm.learner_group._learner.module[policy], league_interface.of_policy(policy), path)
        return OnnxPolicy(path, has_distribution=False)


def games(trained: Policy, league: LeagueConfig, opponent: str, count: int, seed: int = 0) -> list[Game]:
    """Play games against a script; the trained policy is contestant 0. Raises IllegalAction on an illegal action."""
    league_interface = interface_of(league)
    schedule = round_robin(league, league_interface, [TRAINED, opponent], count // 2, seed)
    policies = {agent: (policy, trained) for agent, policy in league_interface.policies.items()}
    roster = {TRAINED: policies, opponent: contestant(opponent, None, league_interface)}
    environment = stepping(league.environment, NUM_ENVS)
    try:
        matches = play_matches(schedule, range(schedule.length), environment, league_interface, roster)
    finally:
        environment.close()
    return [game for match in matches for game in match.games]


def lower_bound(played: Sequence[Game]) -> float:
    """The lower limit of Wilson's two-sided 95 % interval of contestant 0's wins, in percent. A draw is not a win."""
    won = sum(game.scores[0] == 1 for game in played)
    return float(100 * binomtest(won, len(played)).proportion_ci(0.95, "wilson").low)
