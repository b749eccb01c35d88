"""Environments with faults."""

from typing import Any

from tests.support.environments.counting import Counting


class Raising(Counting):
    """Divides by zero in its second turn."""

    def step(self, action: int | None) -> None:
        if self.turns[self.agent_selection] == 1:
            _ = 1 / 0
        super().step(action)


class InvalidReward(Counting):
    """Gives its second player a NaN reward."""

    def _accumulate_rewards(self) -> None:
        self.rewards["player_1"] = float("nan")
        super()._accumulate_rewards()


def raising(**_: Any) -> Raising:
    return Raising((3, 3))


def unrewarding(**_: Any) -> InvalidReward:
    return InvalidReward((3, 3))
