"""Environments that go wrong: for what a person is told of it."""

from typing import Any

from tests.league.environments.counting import Counting


class Raising(Counting):
    """Divides by zero at its second turn."""

    def step(self, action: int | None) -> None:
        if self.turns[self.agent_selection] == 1:
            _ = 1 / 0
        super().step(action)


class Unrewarding(Counting):
    """Gives its second player a reward that is no number."""

    def _accumulate_rewards(self) -> None:
        self.rewards["player_1"] = float("nan")
        super()._accumulate_rewards()


def raising(**_: Any) -> Raising:
    return Raising((3, 3))


def unrewarding(**_: Any) -> Unrewarding:
    return Unrewarding((3, 3))
