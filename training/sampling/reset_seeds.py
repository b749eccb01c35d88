"""The seed of every reset of a run, by a counter: no two resets share one."""

from dataclasses import dataclass

from league.seeds import derive

SEEDS = 2**31
"""Environments take seeds of 31 bits."""
SPACING = 4
"""Numbers that are kept for each step of a run. See ResetSeeds."""


@dataclass(frozen=True, slots=True)
class ResetSeeds:
    """Seeds of the copies of one runner, from one beginning anew to the next.

    Episode e of copy c in runner r (of R runners with C copies each) has the number

        first + (e·R + r)·C + c,    first = SPACING times the steps of the run before, rounded up to R·C

    and the seed `base + number` modulo 2³¹. The remainder by R·C tells runner and copy apart, the quotient their
    episodes. What begins anew Δ steps later is past all numbers that were used: a turn of a runner is an action in each
    of its copies at least, and each sample has at least C actions of each runner, so that R·C times the turns of any
    runner are at most 2Δ; a copy begins one episode more than it takes turns, which is another R·C ≤ Δ, and so is the
    rounding. Numbers repeat after 2³¹ / SPACING steps.
    """

    base: int
    runner: int
    runners: int
    copies: int
    steps: int

    @classmethod
    def of_run(cls, seed: int, *, runner: int, runners: int, copies: int, steps: int) -> "ResetSeeds":
        """seed: of the run. steps: actions of the whole run before the first of these resets."""
        return cls(derive(seed, "reset") % SEEDS, runner, runners, copies, steps)

    def __call__(self, copy: int, episode: int) -> int:
        stride = self.runners * self.copies
        first = -(-SPACING * self.steps // stride) * stride
        number = first + (episode * self.runners + self.runner) * self.copies + copy
        return (self.base + number) % SEEDS
