"""What optimal play gains in the bundled games: the scales of what training reaches."""

from functools import cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from policy_league.examples.blotto import PAYOFF
from policy_league.examples.traffic import GREEN, RED, ROADS, Colours, Distances, lights_reward, move, starts
from policy_league.examples.two_step import GAME_A, GAME_B, PAYOFFS


def two_step_values(gamma: float) -> NDArray:
    """Return the optimal values of action pairs, (3, 2, 2): state, first agent's action, second agent's action.

    Bellman: Q(s₁, u) = γ max Q(s₂, ·).
    """
    later = [gamma * PAYOFFS[game].max() for game in (GAME_A, GAME_B)]
    return np.stack([np.repeat(later, 2).reshape(2, 2), PAYOFFS[GAME_A], PAYOFFS[GAME_B]])


def crossing_optimum(cars: int = 2, length: int = 4, steps: int = 20) -> float:
    """Return the maximum expected return per agent over all joint policies, by dynamic programming.

    Bellman, 1957: V(s, t) = max_a [r(s, a) + V(s', t + 1)], averaged over the initial states.
    """

    @cache
    def value(distances: Distances, colours: Colours, time: int) -> float:
        if time == steps or not any(map(any, distances)):
            return 0.0
        to_lights = ROADS * lights_reward(distances, colours)
        best = -np.inf
        choices = [(0, 1) if distance else (0,) for road in distances for distance in road]
        for flat in product(*choices):
            drives = tuple(flat[road * cars : (road + 1) * cars] for road in range(ROADS))
            after, rewards = move(distances, colours, drives)
            paid = to_lights + sum(map(sum, rewards))
            following = max(value(after, lights, time + 1) for lights in product((RED, GREEN), repeat=ROADS))
            best = max(best, paid + following)
        return best

    agents = ROADS * (cars + 1)
    return float(np.mean([value(start, (RED,) * ROADS, 0) for start in starts(cars, length)])) / agents


def blotto_exploitability(probabilities: NDArray[np.float64]) -> float:
    """Return what a best response wins against a policy, (actions,); 0 at an equilibrium, as the game is symmetric."""
    return float((PAYOFF @ probabilities).max())
