"""Environments whose steps violate the contract of their API, or hang until they are interrupted."""

from collections.abc import Sequence
from typing import Any

from tests.support.environments.simultaneous import Simultaneous
from tests.support.environments.vector_copies import VectorCopies

CLOSED: list[int] = []
"""Seeds of the newest episodes of environments that were closed, in order."""


class Interrupt(BaseException):
    """What the handler of a signal raises in an environment that hangs."""


class Violation(Simultaneous):
    """Violates the contract in its second step, or in its reset, as `fault` says."""

    def __init__(self, fault: str) -> None:
        super().__init__()
        self.fault = fault

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        observations, infos = super().reset(seed, options)
        return ({}, {}) if self.fault == "empty" else (observations, infos)

    def step(self, actions: dict[str, int]) -> tuple[dict, ...]:
        observations, *reports = super().step(actions)
        match self.fault:
            case "mute":
                del observations["agent_1"]
            case "flown":
                self.agents = ["agent_0"]
            case "stranger":
                observations["agent_7"] = observations["agent_0"]
            case "misshapen":
                observations["agent_1"] = observations["agent_1"][:2]
            case "exits":
                raise SystemExit(3)
        return observations, *reports


class Hanging(Simultaneous):
    """Is interrupted in the second step of the episodes with the seeds `hangs`."""

    def __init__(self, hangs: Sequence[int]) -> None:
        super().__init__()
        self.hangs, self.seed = hangs, -1

    def step(self, actions: dict[str, int]) -> tuple[dict, ...]:
        if self.time == 1 and self.seed in self.hangs:
            raise Interrupt
        return super().step(actions)

    def close(self) -> None:
        CLOSED.append(self.seed)


class VectorHanging(VectorCopies):
    entry_point = f"{__name__}:hanging"


def violation(fault: str) -> Violation:
    """The entry point for configurations."""
    return Violation(fault)


def hanging(hangs: Sequence[int]) -> Hanging:
    """The entry point for configurations."""
    return Hanging(hangs)
