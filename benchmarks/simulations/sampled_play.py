"""Gates with sampled actions: Kuhn poker between one policy and itself under another number.

Both games of a block have the same deal. With greedy actions they would be the same game with exchanged sides, and
cancel; with sampled ones they differ. The policy is a small network with random weights.
"""

from __future__ import annotations

from copy import deepcopy

import numpy as np

from evaluation.gating.gate import SequentialTest, decide_matches
from evaluation.matches.game_loop import play_matches
from evaluation.schedules.builders import verdict
from league.config.gate import GateConfig
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.environments.implementation import stepping
from league.policies.draws import probabilities
from league.policies.onnx import OnnxPolicy
from league.spaces import ACTION_MASK, OBSERVATION, Discrete
from policy_league.examples.kuhn_poker import AGENTS, KuhnPoker
from tests.support.policies.graphs import masked_mlp

CONFIG = LeagueConfig.from_mapping(
    {
        "league": "kuhn",
        "environment": {
            "entry_point": "policy_league.examples.kuhn_poker:env",
            "vector": "policy_league.examples.kuhn_poker_vector:KuhnPokerVector",
        },
    }
)
GATE = GateConfig(elo1=60, max_blocks=1000, nights=None)
CHUNK, NUM_ENVS = 100, 200
DEALS = 6


def policy() -> OnnxPolicy:
    """The policy of both players."""
    return OnnxPolicy(masked_mlp((11,), 2))


def shares(player: OnnxPolicy) -> tuple[float, ...]:
    """Exact probabilities of a block's cells (LL, LD, DD or WL, WD, WW) between a policy and itself.

    With a given deal, the player who begins wins with probability p. A contestant begins in one game of the block, and
    its opponent in the other: it wins both with probability p (1 - p).
    """
    wins = np.array([_first_wins(deal, player) for deal in _deals()])
    both = float(np.mean(wins * (1 - wins)))
    return both, 0.0, 1 - 2 * both, 0.0, both


def promoted(gates: int) -> tuple[int, float]:
    """How many of these gates promote the policy over itself, and the share of blocks that are not even."""
    described, player = interface(CONFIG), policy()
    refs = [f"{CONFIG.league}@{number}" for number in (2, 1)]
    roster = {ref: {agent: (described.policies[agent], player) for agent in AGENTS} for ref in refs}
    environment = stepping(CONFIG.environment, NUM_ENVS)
    promotions, scores = 0, list[float]()
    for seed in range(gates):
        schedule = verdict(CONFIG, described, *refs, GATE, seed)
        matches, decision = [], None
        while decision is None or decision.outcome is None:
            positions = range(len(matches), min(len(matches) + CHUNK, schedule.length))
            matches += play_matches(schedule, positions, environment, described, roster)
            decision = decide_matches(SequentialTest(GATE, refs[0]), matches)
        promotions += decision.outcome == "promote"
        scores += [match.score(0) for match in matches]
    return promotions, float(np.mean(np.array(scores) != 0.5))


def _deals() -> list[KuhnPoker]:
    """A game with each deal."""
    deals: dict[bytes, KuhnPoker] = {}
    seed = 0
    while len(deals) < DEALS:
        env = KuhnPoker()
        env.reset(seed)
        deals.setdefault(b"".join(env.observe(agent)[OBSERVATION].tobytes() for agent in AGENTS), env)
        seed += 1
    return list(deals.values())


def _first_wins(env: KuhnPoker, player: OnnxPolicy) -> float:
    """Probability that the player who begins wins a game that is in progress."""
    if env.terminations[AGENTS[0]]:
        return float(env.rewards[AGENTS[0]] > 0)
    observation = env.observe(env.agent_selection)
    batch = {name: observation[name][np.newaxis] for name in (OBSERVATION, ACTION_MASK)}
    logits = player.distribution(batch).dist_inputs
    assert logits is not None
    chance = 0.0
    for action, likely in enumerate(probabilities(logits, Discrete(n=2))[0]):
        after = deepcopy(env)
        after.step(action)
        chance += likely * _first_wins(after, player)
    return chance
