"""A game of a person against policies, played from its seed with the person's choices so far up to the next one.

Nothing is kept between two choices: the same seed and choices are the same game, so whoever holds them can go on with
it at any time, and go back to any point of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from evaluation.asking import Fault, fault_of
from evaluation.exhibition import Moment, Move, answer, exhibit
from evaluation.pictures import data_uri
from evaluation.play import sides_of
from evaluation.report import Document
from evaluation.running import contestant_returns
from evaluation.schedule import scoring
from evaluation.steps import LARGEST, Chances, Step, likely, step_of
from league.config import LeagueConfig
from league.environments.stepping import BatchedEnvironment
from league.errors import EnvironmentMismatch, GameCrashed, IllegalAction, IllegalMask, InvalidInput
from league.games import Sitting
from league.interface import Interface
from league.policies.onnx import LAST_ACTION, OnnxPolicy
from league.policies.policy import Actions, Arrays, Policy
from league.results.scoring import scores
from league.spaces import ACTION_MASK, DictSpace, Discrete, Space

PERSON = "person"
"""Who plays the person's agent: no reference looks like this."""
MOST_NAMED = 32
"""Legal actions that are named where another was chosen."""


@dataclass(frozen=True, slots=True)
class Sat(Document):
    """The game so far. steps: without pictures; `picture` is what there is to see now, None without a rendering.

    legal: what the person may choose now, nothing once the game is over. acting: who acts in this step.
    chances: what the opponent would choose in the person's place, if that was asked and it is a graph.
    score: the person's, 1, ½ or 0, once the game is over, where opponents are compared within a game; else None.
    forfeits: by whom the game was forfeited, as whom and why: an opponent gave no action that could be played.
    """

    opponent: str
    agent: str
    seed: int
    steps: tuple[Step, ...]
    picture: str | None
    legal: tuple[int, ...]
    acting: tuple[str, ...]
    over: bool
    returns: dict[str, float]
    score: float | None
    chances: Chances
    forfeits: tuple[dict[str, str], ...]


def sit(
    asked: Sitting,
    config: LeagueConfig,
    interface: Interface,
    players: Mapping[str, Policy],
    environment: BatchedEnvironment,
    draws: bool,
) -> Sat:
    """Play the game on `environment`, of one copy.

    players: agent → the opponent's policy, of all agents: the person's as well, to be asked what it would do.
    draws: whether the environment gives pictures.
    Raises InvalidInput for an agent that there is not and for choices after the end of the game; EnvironmentMismatch
    for an agent that does not choose one of several actions; IllegalAction, naming those that were legal; and
    GameCrashed if the environment cannot go on, which is not to be used again then.
    """
    space = space_of(interface, asked.agent)
    person = _Person(asked.actions, space, players[asked.agent] if asked.chances else None)
    hands: dict[str, Policy] = {
        agent: _Opponent(agent, policy, interface.agents[agent].action, asked.chances)
        for agent, policy in players.items()
    }
    hands[asked.agent] = person
    cast = {agent: PERSON if agent == asked.agent else asked.opponent for agent in interface.agents}
    steps: list[Step] = []
    last: Moment | None = None
    stop: _Stop | None = None
    try:
        try:
            for last in exhibit(environment, hands, asked.seed):
                steps.append(step_of(last, cast, interface))
        except _Stop as stopping:
            stop = stopping
        picture = data_uri(environment.render(0), LARGEST) if draws else None
    except IllegalAction:
        raise
    except Exception as error:
        raise GameCrashed(f"the game cannot go on: its environment raised {type(error).__name__}: {error}") from error
    assert last is not None, "a game has a beginning"
    waits = stop if isinstance(stop, _Waits) else None
    forfeit = stop if isinstance(stop, _Forfeited) else None
    if person.left and not waits:
        made = len(asked.actions) - person.left
        raise InvalidInput(f"actions: the game was over after {made} of these {len(asked.actions)}")
    return Sat(
        opponent=asked.opponent,
        agent=asked.agent,
        seed=asked.seed,
        steps=tuple(steps),
        picture=picture,
        legal=waits.legal if waits else (),
        acting=last.acting if waits else (),
        over=waits is None,
        returns=last.returns,
        score=None if waits else _score(asked.agent, last.returns, forfeit, config, interface),
        chances=likely(Move(asked.agent, {}, None, waits.inputs), space) if waits else (),
        forfeits=({"agent": forfeit.agent, "ref": asked.opponent, "reason": forfeit.fault.reason},) if forfeit else (),
    )


def space_of(interface: Interface, agent: str) -> Discrete:
    """How a person acts for `agent`. Raises InvalidInput and EnvironmentMismatch as `sit` does."""
    if agent not in interface.agents:
        raise InvalidInput(f"agent: there is no agent {agent[:64]!r}; known: {', '.join(interface.agents)}")
    space = interface.agents[agent].action
    if not isinstance(space, Discrete):
        raise EnvironmentMismatch(f"{agent} acts by {type(space).__name__}: a person chooses one of several actions")
    return space


class _Stop(Exception):
    """The game cannot go on, or not now."""


class _Waits(_Stop):
    """It is the person's turn, and there is no choice yet. inputs: of the adviser's distribution."""

    def __init__(self, legal: tuple[int, ...], inputs: NDArray | None) -> None:
        super().__init__("it is the person's turn")
        self.legal, self.inputs = legal, inputs


class _Forfeited(_Stop):
    """An opponent had to act, and gave no action that could be played."""

    def __init__(self, agent: str, fault: Fault) -> None:
        super().__init__(fault.detail)
        self.agent, self.fault = agent, fault


class _Person:
    """Answers with the person's choices, one after another; beside them, with how likely the adviser's are."""

    def __init__(self, choices: Sequence[int], space: Discrete, adviser: Policy | None) -> None:
        self._choices, self._space = choices, space
        self.left = len(choices)
        self._adviser = adviser if isinstance(adviser, OnnxPolicy) else None

    def act(
        self,
        observations: Arrays,
        *,
        state: Arrays | None = None,
        explore: bool = False,  # noqa: ARG002
        rng: Sequence[np.random.Generator] | None = None,
    ) -> Actions:
        advice = None if self._adviser is None else answer(self._adviser, observations, state, rng)
        legal = self._legal(observations.get(ACTION_MASK))
        if not self.left:
            raise _Waits(legal, advice.dist_inputs[0] if advice and advice.dist_inputs is not None else None)
        number = len(self._choices) - self.left
        choice = self._choices[number]
        self.left -= 1
        if choice not in legal:
            named = ", ".join(map(str, legal[:MOST_NAMED])) + ", …" * (len(legal) > MOST_NAMED)
            raise IllegalAction(f"actions: {choice}, number {number + 1} of them, is illegal there; legal are {named}")
        actions = np.array([choice], dtype=self._space.dtype)
        if advice is None:
            return Actions(actions)
        return replace(advice, actions=actions, state=self._after(advice, choice))

    def _after(self, advice: Actions, choice: int) -> dict[str, NDArray] | None:
        """What the adviser remembers: what it saw, and, if it remembers its last action, what was chosen instead."""
        if advice.state is None or LAST_ACTION not in advice.state:
            return advice.state
        last = np.full_like(advice.state[LAST_ACTION], choice - self._space.start + 1)
        return {**advice.state, LAST_ACTION: last}

    def _legal(self, mask: NDArray | None) -> tuple[int, ...]:
        if mask is None:
            return tuple(range(self._space.start, self._space.start + self._space.n))
        legal = tuple((np.flatnonzero(mask[0]) + self._space.start).tolist())
        if not legal:
            raise IllegalMask("action_mask allows no action")
        return legal


class _Opponent:
    """A policy whose answers can be played: it raises _Forfeited instead of the first that cannot.

    tells: how likely its actions are.
    """

    def __init__(self, agent: str, policy: Policy, space: Space, tells: bool) -> None:
        assert not isinstance(space, DictSpace), "no policy acts in a dictionary"
        self._agent, self._policy, self._space, self._tells = agent, policy, space, tells

    def act(
        self,
        observations: Arrays,
        *,
        state: Arrays | None = None,
        explore: bool = False,  # noqa: ARG002
        rng: Sequence[np.random.Generator] | None = None,
    ) -> Actions:
        try:
            given = answer(self._policy, observations, state, rng)
        except MemoryError:
            raise
        except Exception as error:
            raise _Forfeited(self._agent, Fault("crashed", f"{type(error).__name__}: {error}")) from error
        if fault := fault_of(given, self._space, observations.get(ACTION_MASK)):
            raise _Forfeited(self._agent, fault)
        return given if self._tells else replace(given, dist_inputs=None)


def _score(
    agent: str, returns: Mapping[str, float], forfeit: _Forfeited | None, config: LeagueConfig, interface: Interface
) -> float | None:
    """The person's side against all others; a side that forfeits has lost."""
    if scoring(config, interface) != "game":
        return None
    agents = list(interface.agents)
    side_of = sides_of(agents, interface)
    own = side_of[agents.index(agent)]
    sides = [int(side != own) for side in range(len(interface.sides))]
    forfeited = {sides[side_of[agents.index(forfeit.agent)]]} if forfeit else set()
    values = contestant_returns([returns[each] for each in agents], side_of, sides)
    return scores([values], "game", [forfeited])[0][0]
