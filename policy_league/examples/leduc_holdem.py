"""Leduc hold'em with information states: PettingZoo's game, with all bets of the hand in the observation.

PettingZoo's observation contains the chips of both players, but not the order of the bets: the 288 information sets of
a hand look like 93. A policy without memory then cannot play a good strategy: the best one loses 0.18 big blinds per
hand to a best response, instead of 0.
"""

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo.classic.rlcard_envs.leduc_holdem import raw_env

NUM_ACTIONS = 4
ROUNDS, MOST_ACTIONS = 2, 4
"""Betting rounds, and the most actions in one."""
STOCK_SIZE = 36
OBSERVATION_SIZE = STOCK_SIZE + ROUNDS * MOST_ACTIONS * NUM_ACTIONS
CARD_BACK = "Card"
"""Name of RLCard's picture of the back of a card."""
FIRST_PUBLIC_CARD = 3
"""Index of the public card in PettingZoo's observation: three elements, zeros in the first round."""


class LeducWithHistory(raw_env):
    """One hand is an episode. The observation is a player's information state, (68,) float32.

    | index | content |
    |---|---|
    | 0 to 35 | PettingZoo's observation: own card, public card, own chips, the opponent's chips, each one-hot |
    | 36 to 51 | the actions of both players in the first round, in order, one-hot; zeros for actions to come |
    | 52 to 67 | the actions of the second round |
    """

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(render_mode)
        mask = spaces.Box(0, 1, (NUM_ACTIONS,), np.int8)
        observation = spaces.Box(0, 1, (OBSERVATION_SIZE,), np.float32)
        self.observation_spaces = {
            agent: spaces.Dict({"observation": observation, "action_mask": mask}) for agent in self.possible_agents
        }

    def reset(self, seed: int | None = None, options: dict[str, object] | None = None) -> None:
        self._history = np.zeros((ROUNDS, MOST_ACTIONS, NUM_ACTIONS), np.float32)
        super().reset(seed=seed, options=options)

    def observe(self, agent: str) -> dict[str, NDArray]:
        """Return the information state of an agent, and its action mask."""
        stock = super().observe(agent)
        return stock | {"observation": np.concatenate([stock["observation"], self._history.ravel()])}

    def render_for(self, agent: str) -> NDArray:
        """Render the table as a player sees it, with the opponent's card face down: (height, width, 3) uint8."""
        game, viewer = self.env.game, self._name_to_int(agent)
        state_of = game.get_state
        game.get_state = lambda player: state_of(player) | ({} if player == viewer else {"hand": CARD_BACK})
        try:
            return np.array(self.render())
        finally:
            del game.get_state

    def step(self, action: int | None) -> None:
        if action is not None:
            observation = self.observe(self.agent_selection)["observation"]
            current = int(observation[FIRST_PUBLIC_CARD : FIRST_PUBLIC_CARD + 3].any())
            self._history[current, int(self._history[current].sum()), action] = 1
        super().step(action)


def env(**kwargs: str | None) -> LeducWithHistory:
    """Entry point for configurations."""
    return LeducWithHistory(**kwargs)
