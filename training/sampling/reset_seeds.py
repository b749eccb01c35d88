"""Derives a unique seed for every environment reset of a run from a counter."""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from league.random.seeds import derive

SEEDS = 2**31
"""Environments accept seeds of 31 bits."""
SPACING = 4
"""Numbers reserved for each step of a run. See ResetSeeds."""

Numbers = TypeVar("Numbers", int, NDArray[np.int64])


@dataclass(frozen=True, slots=True)
class ResetSeeds:
    """Reset seeds of one runner's environments, from one `reset_episodes` to the next.

    Episode e of environment c in runner r (of R runners with C environments each) has the number

        first + (e·R + r)·C + c,    first = SPACING · steps of the run before, rounded up to a multiple of R·C

    and the seed `base + number` modulo 2³¹. The remainder modulo R·C identifies runner and environment, the quotient
    their episodes. A reset Δ steps later starts beyond all numbers in use: a runner's turn is at least one action in
    each of its environments, and each sample has at least C actions of each runner, so that R·C times the turns of any
    runner are at most 2Δ; an environment starts one episode more than it takes turns, another R·C ≤ Δ, and so is the
    rounding. Numbers repeat after 2³¹ / SPACING steps.
    """

    base: int
    runner: int
    runners: int
    num_envs: int
    steps: int

    @classmethod
    def of_run(cls, seed: int, *, runner: int, runners: int, num_envs: int, steps: int) -> "ResetSeeds":
        """Return the seeds after a reset. seed: of the run. steps: actions of the whole run before it."""
        return cls(derive(seed, "reset") % SEEDS, runner, runners, num_envs, steps)

    def __call__(self, env: Numbers, episode: Numbers) -> Numbers:
        """Return the seeds of episodes, of one or of many."""
        stride = self.runners * self.num_envs
        first = -(-SPACING * self.steps // stride) * stride
        number = first + (episode * self.runners + self.runner) * self.num_envs + env
        return (self.base + number) % SEEDS
