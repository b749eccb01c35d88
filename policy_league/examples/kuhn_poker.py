"""Kuhn poker: the smallest poker game with bluffing. A PettingZoo AEC environment.

The deck has three cards: 0, 1 and 2. Both players pay an ante of 1 and get one card. Then they take turns to pass or to
bet 1 until one of five lines is complete:

| line | result |
|---|---|
| pass, pass | the higher card wins 1 |
| bet, bet or pass, bet, bet | the higher card wins 2 |
| bet, pass | the first player wins 1 |
| pass, bet, pass | the second player wins 1 |

With best play, the first player loses 1/18 per hand (Kuhn, 1950, "A simplified two-person poker").
"""

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import AECEnv
from pettingzoo.utils import AgentSelector

AGENTS = ("player_0", "player_1")
PASS, BET = range(2)
DEALS = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))
"""The cards of both players."""
FIRST_CARD, FIRST_BET = 2, 5
"""Indices in an observation."""
OBSERVATION_SIZE = 11


class KuhnPoker(AECEnv):
    """One hand is an episode. The observation is a player's information state, as in OpenSpiel, (11,) int8.

    | index | content |
    |---|---|
    | 0 to 1 | the player, one-hot |
    | 2 to 4 | its card, one-hot |
    | 5 to 10 | the three actions of the longest line, one-hot; zeros for actions to come |
    """

    metadata = {"name": "kuhn_poker", "render_modes": [], "hidden_information": True}  # noqa: RUF012  # PettingZoo's form
    render_mode = None

    def __init__(self) -> None:
        super().__init__()
        self.possible_agents = list(AGENTS)
        self._observation = spaces.Dict(
            {
                "observation": spaces.Box(0, 1, (OBSERVATION_SIZE,), np.int8),
                "action_mask": spaces.Box(0, 1, (2,), np.int8),
            }
        )
        self._action = spaces.Discrete(2)
        self._random = np.random.default_rng()

    def observation_space(self, agent: str) -> spaces.Dict:  # noqa: ARG002
        return self._observation

    def action_space(self, agent: str) -> spaces.Discrete:  # noqa: ARG002
        return self._action

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:  # noqa: ARG002
        """Deal. Only the deal is random."""
        if seed is not None:
            self._random = np.random.default_rng(seed)
        self._cards = DEALS[int(len(DEALS) * self._random.random())]
        self._line: list[int] = []
        self.agents = list(AGENTS)
        self.rewards = dict.fromkeys(AGENTS, 0)
        self._cumulative_rewards = dict.fromkeys(AGENTS, 0)
        self.terminations, self.truncations = dict.fromkeys(AGENTS, False), dict.fromkeys(AGENTS, False)
        self.infos: dict[str, dict[str, Any]] = {agent: {} for agent in AGENTS}
        self._selector = AgentSelector(self.agents)
        self.agent_selection = self._selector.reset()

    def observe(self, agent: str) -> dict[str, NDArray]:
        """Return the information state of an agent, and a mask of ones if it must act."""
        player = AGENTS.index(agent)
        observation = np.zeros(OBSERVATION_SIZE, dtype=np.int8)
        observation[player] = 1
        observation[FIRST_CARD + self._cards[player]] = 1
        for number, action in enumerate(self._line):
            observation[FIRST_BET + 2 * number + action] = 1
        must_act = agent == self.agent_selection and payoff(self._cards, self._line) is None
        return {"observation": observation, "action_mask": np.full(2, must_act, dtype=np.int8)}

    def step(self, action: int | None) -> None:
        if self.terminations[self.agent_selection]:
            self._was_dead_step(action)
            return
        assert action is not None
        self._line.append(action)
        gain = payoff(self._cards, self._line)
        if gain is not None:
            self.rewards = dict(zip(AGENTS, (gain, -gain), strict=True))
            self.terminations = dict.fromkeys(AGENTS, True)
        self.agent_selection = self._selector.next()
        self._accumulate_rewards()


def payoff(cards: tuple[int, int], line: list[int]) -> int | None:
    """Return what the first player wins; None if the hand is not over."""
    last = line[-2:]
    if len(last) < 2 or last == [PASS, BET]:
        return None
    if last == [BET, PASS]:
        return 1 if len(line) == 2 else -1
    stake = 1 + line[-1]
    return stake if cards[0] > cards[1] else -stake


def env() -> KuhnPoker:
    """Entry point for configurations."""
    return KuhnPoker()
