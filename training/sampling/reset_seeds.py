"""The seed of every reset of a run, by a counter: no two resets share one."""

from dataclasses import dataclass

from league.seeds import derive

SEEDS = 2**32
"""Environments take 32-bit seeds."""


@dataclass(frozen=True, slots=True)
class ResetSeeds:
    """Seeds of the copies of one runner.

    Episode e of copy c in runner r (of R runners with C copies each) has the number

        steps' + (e·R + r)·C + c,    steps' = the environment steps before this life of the runner, rounded up to R·C

    and the seed `base + number` modulo 2³². The remainder by R·C tells runner and copy apart, the quotient their
    episodes. As each episode takes a step of its copy, and all copies step together, a runner that starts again after
    an interruption is past all numbers that were used: numbers stay below the steps of the run, and so below 2³².
    """

    base: int
    runner: int
    runners: int
    copies: int
    steps: int

    @classmethod
    def of_run(cls, seed: int, *, runner: int, runners: int, copies: int, steps: int) -> "ResetSeeds":
        """seed: of the run. steps: environment steps of the whole run before the runner's first reset."""
        return cls(derive(seed, "reset") % SEEDS, runner, runners, copies, steps)

    def __call__(self, copy: int, episode: int) -> int:
        stride = self.runners * self.copies
        first = -(-self.steps // stride) * stride
        number = first + (episode * self.runners + self.runner) * self.copies + copy
        return (self.base + number) % SEEDS
