"""Human play: a game of a person against policies, and what can be played in a league.

No state is kept between two turns: equal seeds and actions give the same game. A client can therefore continue at any
time and return to any point.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from evaluation.matches.policy_calls import PolicyFault, action_fault, fault_of
from evaluation.matches.seating import agent_sides, contestant_returns
from evaluation.playback.action_names import action_names, direction_keys
from evaluation.playback.environment_hooks import Declarations, EnvironmentHooks
from evaluation.playback.recorded_steps import LARGEST, likely, step_of
from evaluation.playback.single_game import GameStep, Move, expected_return, play_game, policy_output
from evaluation.playback.video import data_uri
from league.conditions import ActionSelection, action_selection
from league.config.league import LeagueConfig
from league.environments.stepping import BatchedEnvironment
from league.errors import (
    EnvironmentMismatch,
    GameCrashed,
    IllegalAction,
    IllegalMask,
    InvalidInput,
    RemoteError,
    one_line,
)
from league.interface import Interface
from league.policies.loading import baselines, configured_scripts, eligible
from league.policies.onnx import LAST_ACTION, OnnxPolicy
from league.policies.policy import Actions, Arrays, Policy
from league.registry.registry import Registry
from league.results.scoring import scores, scoring
from league.search.policies import SearchPolicy
from league.service_requests import (
    GameForfeit,
    HumanPlayRequest,
    Playability,
    PlayableAgent,
    PlayedGame,
    RecordedStep,
)
from league.spaces import ACTION_MASK, DictSpace, Discrete, Space

MOST_OPPONENTS = 50


def playability(config: LeagueConfig, registry: Registry, interface: Interface, hooks: EnvironmentHooks) -> Playability:
    """What can be played. Raises UnknownLeague."""
    league = config.league
    playable_agents = _playable_agents(config, interface, hooks.declared)
    kinds = sorted({type(spaces.action).__name__ for spaces in interface.agents.values()})
    why = None if playable_agents else f"human play needs Discrete actions, but its agents have {' and '.join(kinds)}"
    mixtures = [
        row.ref
        for row in registry.versions.all(league)
        if row.mixture is not None and row.aliases and row.manifest.environment_digest == config.environment.digest()
    ]
    versions = [version.ref for version in reversed(eligible(registry, league))]
    scripts = dict.fromkeys([*baselines(config, interface), *configured_scripts(config, interface)])
    return Playability(
        league=league,
        playable=bool(playable_agents),
        why=why,
        agents=playable_agents,
        opponents=(*mixtures, *versions[:MOST_OPPONENTS], *scripts),
        draws=hooks.draws,
        board=hooks.declared.board,
        board_area=hooks.declared.board_area,
        reveals=hooks.draws and not hooks.has_views and interface.hidden_information and len(interface.agents) > 1,
    )


def _playable_agents(config: LeagueConfig, interface: Interface, declared: Declarations) -> tuple[PlayableAgent, ...]:
    side_of = {agent: side for side, agents in interface.sides.items() for agent in agents}
    names = action_names(config.play, interface)
    agents = []
    for agent, spaces in interface.agents.items():
        if not isinstance(space := spaces.action, Discrete):
            continue
        own_names = names.get(agent, {})
        keys = direction_keys(own_names) | declared.action_keys
        fitting = {key: action for key, action in keys.items() if space.start <= action < space.start + space.n}
        color = declared.agent_colors.get(agent)
        agents.append(
            PlayableAgent(
                agent=agent,
                side=side_of[agent],
                actions=space.n,
                start=space.start,
                names=own_names,
                keys=fitting,
                color=color,
            )
        )
    return tuple(agents)


PERSON = "person"
"""Stands for the person in place of a reference."""
MOST_NAMED = 32
"""Legal actions listed in an error."""


def human_play(
    request: HumanPlayRequest,
    config: LeagueConfig,
    interface: Interface,
    players: Mapping[str, Policy],
    analyst: Policy | None,
    environment: BatchedEnvironment,
    hooks: EnvironmentHooks,
) -> PlayedGame:
    """Play the game in `environment`, which has `num_envs` 1.

    Args:
        request: The request.
        config: Configuration of the league.
        interface: Interface of the league.
        players: agent → the opponent's policy, for all agents; that of the person's is not used.
        analyst: Evaluates the person's positions: a graph or a search. None for no evaluation.
        environment: The environment. It must not be used again after GameCrashed.
        hooks: What the environment renders. If it has views of agents, the picture shows what the person's agent sees.

    Raises:
        InvalidInput: Unknown agent, or actions after the end of the game.
        EnvironmentMismatch: The agent's action space is not Discrete.
        IllegalAction: An illegal action; the message lists legal ones.
        GameCrashed: The environment raised.
        RemoteError: The server of a remote opponent cannot be reached or failed.
    """
    space = space_of(interface, request.agent)
    person = _Person(request.actions, space, analyst)
    steps, last, stop, picture = _play(
        environment, players, person, request, interface, hooks, action_selection(config, interface)
    )
    awaiting = stop if isinstance(stop, _AwaitingPerson) else None
    forfeit = stop if isinstance(stop, _Forfeited) else None
    if person.left and not awaiting:
        made = len(request.actions) - person.left
        raise InvalidInput(f"actions: the game ended after {made} of {len(request.actions)} actions")
    return PlayedGame(
        opponent=request.opponent,
        agent=request.agent,
        seed=request.seed,
        steps=tuple(steps),
        picture=picture,
        legal=awaiting.legal if awaiting else (),
        acting=last.acting if awaiting else (),
        over=awaiting is None,
        returns=last.returns,
        score=None if awaiting else _score(request.agent, last.returns, forfeit, config, interface),
        chances=likely(Move(request.agent, {}, None, awaiting.inputs), space) if awaiting else (),
        value=awaiting.value if awaiting else None,
        forfeits=(GameForfeit(agent=forfeit.agent, ref=request.opponent, reason=forfeit.fault.reason),)
        if forfeit
        else (),
    )


def _play(
    environment: BatchedEnvironment,
    players: Mapping[str, Policy],
    person: _Person,
    request: HumanPlayRequest,
    interface: Interface,
    hooks: EnvironmentHooks,
    actions: ActionSelection,
) -> tuple[list[RecordedStep], GameStep, _Stop | None, str | None]:
    """The steps of the game, the last one, what stopped it before its end, and the last picture."""
    policies: dict[str, Policy] = {
        agent: _Opponent(agent, policy, interface.agents[agent].action, request.chances)
        for agent, policy in players.items()
    }
    policies[request.agent] = person
    controllers = {agent: PERSON if agent == request.agent else request.opponent for agent in interface.agents}
    steps: list[RecordedStep] = []
    last: GameStep | None = None
    stop: _Stop | None = None
    try:
        try:
            for last in play_game(environment, policies, request.seed, actions):
                steps.append(step_of(last, controllers, interface))
        except _Stop as stopping:
            stop = stopping
        view = request.agent if hooks.has_views else None
        picture = data_uri(environment.render(0, view), LARGEST) if hooks.draws else None
    except (IllegalAction, RemoteError):
        raise
    except Exception as error:
        raise GameCrashed(
            f"the game cannot continue: its environment raised {one_line(error, with_type=True)}"
        ) from error
    assert last is not None, "a game has at least one step"
    return steps, last, stop, picture


def space_of(interface: Interface, agent: str) -> Discrete:
    """Action space of the person's agent. Raises InvalidInput and EnvironmentMismatch like `human_play`."""
    if agent not in interface.agents:
        raise InvalidInput(f"agent: unknown agent {agent[:64]!r}; known: {', '.join(interface.agents)}")
    space = interface.agents[agent].action
    if not isinstance(space, Discrete):
        raise EnvironmentMismatch(f"human play needs Discrete actions, but {agent} has {type(space).__name__}")
    return space


class _Stop(Exception):
    """The game cannot continue, or not yet."""


class _AwaitingPerson(_Stop):
    """It is the person's turn. analysis: what the analyst would do."""

    def __init__(self, legal: tuple[int, ...], analysis: Actions | None) -> None:
        super().__init__("it is the person's turn")
        inputs = None if analysis is None else analysis.dist_inputs
        self.legal, self.inputs = legal, None if inputs is None else inputs[0]
        self.value = None if analysis is None else expected_return(analysis)


class _Forfeited(_Stop):
    """An opponent returned no playable action."""

    def __init__(self, agent: str, fault: PolicyFault) -> None:
        super().__init__(fault.detail)
        self.agent, self.fault = agent, fault


class _Person:
    """Plays the person's actions in order, and queries the analyst for probabilities."""

    def __init__(self, choices: Sequence[int], space: Discrete, analyst: Policy | None) -> None:
        self._choices, self._space = choices, space
        self.left = len(choices)
        self._analyst = analyst if isinstance(analyst, OnnxPolicy | SearchPolicy) else None

    def act(
        self,
        observations: Arrays,
        *,
        state: Arrays | None = None,
        explore: bool = False,  # noqa: ARG002
        rng: Sequence[np.random.Generator] | None = None,
    ) -> Actions:
        # A graph may have a memory of the earlier positions; a search has none, and is slow.
        is_evaluated = isinstance(self._analyst, OnnxPolicy) or not self.left
        analysis = None
        if self._analyst is not None and is_evaluated:
            analysis = policy_output(self._analyst, observations, state, rng)
        legal = self._legal(observations.get(ACTION_MASK))
        if not self.left:
            raise _AwaitingPerson(legal, analysis)
        number = len(self._choices) - self.left
        choice = self._choices[number]
        self.left -= 1
        if choice not in legal:
            named = ", ".join(map(str, legal[:MOST_NAMED])) + ", …" * (len(legal) > MOST_NAMED)
            raise IllegalAction(f"actions[{number}]: {choice} is illegal, expected one of {named}")
        actions = np.array([choice], dtype=self._space.dtype)
        if analysis is None:
            return Actions(actions)
        return replace(analysis, actions=actions, state=self._after(analysis, choice))

    def _after(self, analysis: Actions, choice: int) -> dict[str, NDArray] | None:
        """The analyst's next recurrent state; a previous action in it is replaced by the person's."""
        if analysis.state is None or LAST_ACTION not in analysis.state:
            return analysis.state
        last = np.full_like(analysis.state[LAST_ACTION], choice - self._space.start + 1)
        return {**analysis.state, LAST_ACTION: last}

    def _legal(self, mask: NDArray | None) -> tuple[int, ...]:
        if mask is None:
            return tuple(range(self._space.start, self._space.start + self._space.n))
        legal = tuple((np.flatnonzero(mask[0]) + self._space.start).tolist())
        if not legal:
            raise IllegalMask("action_mask allows no action")
        return legal


class _Opponent:
    """Raises _Forfeited for the first output of a policy that is not playable, and RemoteError as it is.

    with_probabilities: whether to return action probabilities.
    """

    def __init__(self, agent: str, policy: Policy, space: Space, with_probabilities: bool) -> None:
        assert not isinstance(space, DictSpace), "action spaces are not dictionaries"
        self._agent, self._policy, self._space, self._with_probabilities = agent, policy, space, with_probabilities

    def act(
        self,
        observations: Arrays,
        *,
        state: Arrays | None = None,
        explore: bool = False,
        rng: Sequence[np.random.Generator] | None = None,
    ) -> Actions:
        try:
            output = policy_output(self._policy, observations, state, rng, explore)
        except (MemoryError, RemoteError):
            raise
        except Exception as error:
            raise _Forfeited(self._agent, fault_of(error)) from error
        if fault := action_fault(output, self._space, observations.get(ACTION_MASK)):
            raise _Forfeited(self._agent, fault)
        return output if self._with_probabilities else replace(output, dist_inputs=None)


def _score(
    agent: str, returns: Mapping[str, float], forfeit: _Forfeited | None, config: LeagueConfig, interface: Interface
) -> float | None:
    """Score of the person's side against all others. A side that forfeits has lost."""
    if scoring(config, interface) != "game":
        return None
    agents = list(interface.agents)
    side_of = agent_sides(agents, interface)
    own_side = side_of[agents.index(agent)]
    sides = [int(side != own_side) for side in range(len(interface.sides))]
    forfeited = {sides[side_of[agents.index(forfeit.agent)]]} if forfeit else set()
    values = contestant_returns([returns[name] for name in agents], side_of, sides)
    return scores([values], "game", [forfeited])[0][0]
