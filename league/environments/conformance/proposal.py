"""Proposes a configuration for an environment (`league init`): a YAML file in which every line has a comment.

The environment is built and played as by `league check-env`. Its agents and spaces determine policies, sides, network
and algorithm; the openings are those that were measured.
"""

import glob
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
import yaml

from league.conditions import action_selection, describe_selection
from league.config.base import JSON
from league.config.league import LeagueConfig
from league.config.network import channels_of
from league.environments.conformance.examination import examine
from league.environments.conformance.findings import Examination
from league.errors import ConfigError
from league.interface import Interface
from league.refs import SLUG
from league.spaces import ACTION_MASK, Box, Discrete, Leaf, MultiDiscrete, Space, inputs

COMMENT_COLUMN = 50
"""Column of the comments, unless a line is longer."""
LISTED_AGENTS = 8
"""More agents of a policy are named by a pattern."""
SHORT_EPISODE = 5
"""Actions of an agent per episode up to which rewards are not discounted."""
SMALL_BOARD, IMAGE = 4, 36
"""Least height and width of an observation for one convolution, and for the three of Mnih et al. (2015)."""
BOARD_CONVOLUTIONS = [{"filters": 32, "kernel": 3}]
IMAGE_CONVOLUTIONS = [
    {"filters": 32, "kernel": 8, "stride": 4},
    {"filters": 64, "kernel": 4, "stride": 2},
    {"filters": 64, "kernel": 3},
]
PLAIN = re.compile(r"[A-Za-z_][\w.:/-]*", re.ASCII)
"""Texts that need no quotes in YAML, except words such as `yes`."""
WIDE = 10.0
"""Numbers beyond ± this value are normalised."""


@dataclass(frozen=True, slots=True)
class Proposal:
    """A configuration file that passes `league check-env`, and what was found while it was made."""

    text: str
    config: LeagueConfig
    examination: Examination


@dataclass(frozen=True, slots=True)
class _Line:
    """A line of the file: key and value with their indentation, and the comment. Empty: a blank line."""

    text: str = ""
    comment: str = ""

    def __str__(self) -> str:
        return f"{self.text:<{COMMENT_COLUMN}}  # {self.comment}" if self.comment else self.text


GATE = (
    _Line(),
    _Line("gate:", "league nightly: the test for promotions"),
    _Line("  elo1: 30", "gain in Elo that the test should detect"),
    _Line("  max_blocks: 4000", "pairs of games after which a test ends undecided"),
    _Line("  anchors: []", "bots or versions that a new champion must hold its own against"),
)


def propose(
    league: str,
    entry_point: str,
    kwargs: JSON,
    folder: str,
    shown: str | None = None,
    *,
    is_team: bool | None = None,
    seconds: float | None = None,
    progress: Callable[[str], None] | None = None,
) -> Proposal:
    """Examine an environment and propose a configuration.

    Args:
        league: Name of the league.
        entry_point: As `environment.entry_point`.
        kwargs: As `environment.kwargs`.
        folder: Where entry points are searched first.
        shown: This folder relative to the file; None if it is that of the file.
        is_team: Whether all agents are one side. None: if only a team's returns agree so well.
        seconds: Time after which the examination is cut short.
        progress: Receives what is done.

    Raises:
        ConfigError: The environment cannot be built, or violates the contract.
    """
    environment: JSON = {"entry_point": entry_point} | ({"kwargs": kwargs} if kwargs else {})
    document = {"league": league, "environment": environment, "folder": folder}
    config = LeagueConfig.from_mapping(document, source=entry_point)
    examination = examine(config, seconds=seconds, progress=progress)
    faults = [str(finding) for finding in examination.findings if finding.severity == "fault"]
    if faults or examination.interface is None:
        raise ConfigError(f"{entry_point} cannot be a league's environment: {'; '.join(faults)}")
    team = examination.is_team if is_team is None else is_team
    if team:
        one_side = examination.interface.model_copy(update={"sides": {"team": tuple(examination.interface.agents)}})
        examination.actions = describe_selection(config, one_side)
    lines = [
        *_header(config, environment, shown),
        *_policies(examination.interface, team),
        *_play(config, examination, examination.interface, team),
        *_training(examination, examination.interface, team),
        *GATE,
    ]
    text = "\n".join(map(str, lines)) + "\n"
    proposed = LeagueConfig.from_mapping(yaml.safe_load(text) | {"folder": document["folder"]}, source="the proposal")
    return Proposal(text, proposed, examination)


def _header(config: LeagueConfig, environment: JSON, shown: str | None) -> Iterator[_Line]:
    yield from (
        _Line("# Written by `league init`. docs/configuration.md describes all settings."),
        _Line(f"league: {config.league}", "name in all commands and URLs"),
    )
    if shown is not None:
        yield _Line(f"folder: {_inline(shown)}", "where the code is searched, relative to this file")
    entry_point = f"  entry_point: {_inline(environment['entry_point'])}"
    yield from (
        _Line(),
        _Line("environment:", "what is played"),
        _Line(entry_point, "module or function that creates it"),
    )
    if kwargs := environment.get("kwargs"):
        yield _Line(f"  kwargs: {_inline(kwargs)}", "arguments of its constructor")


def _policies(interface: Interface, is_team: bool) -> Iterator[_Line]:
    yield from (_Line(), _Line("policies:", "policy → its agents; each policy is one network"))
    for policy in interface.policy_ids:
        policy_agents = [agent for agent in interface.agents if interface.policies[agent] == policy]
        space = interface.agents[policy_agents[0]].action
        yield _Line(f"  {policy}: {_inline(_patterns(policy_agents, list(interface.agents)))}", _described(space))
    yield _Line()
    if is_team:
        yield from (
            _Line("sides:", "side → its agents; the sides are opponents"),
            _Line('  team: ["*"]', "all agents are one team; without it, each is a side of its own"),
        )
    elif len(interface.sides) <= LISTED_AGENTS and all(map(SLUG.fullmatch, interface.sides)):
        yield _Line("sides:", "side → its agents; the sides are opponents")
        for side, agents in interface.sides.items():
            yield _Line(f"  {_inline(side)}: {_inline(list(agents))}", "agents of one team belong to one side")
    else:
        yield _Line("sides: null", "each agent is a side of its own")


def _play(config: LeagueConfig, examination: Examination, interface: Interface, is_team: bool) -> Iterator[_Line]:
    measured, reason = examination.openings, "the most likely ones; sampled if information is hidden"
    actions = "greedy" if is_team else action_selection(config, interface)
    if is_team:
        reason = "the most likely ones, as there is no opponent"
    elif actions == "sampled":
        hides = interface.hidden_information
        reason = f"drawn at random, as {'the environment hides information' if hides else 'opponents act at once'}"
    yield from (_Line(), _Line("play:", "the games that are rated"), _Line(f"  actions: {actions}", reason))
    opening = "random moves at the start"
    if actions == "sampled":
        yield _Line("  opening_plies: 0", f"{opening}; sampled actions vary the games")
    elif measured is None:
        yield _Line("  opening_plies: 0", f"{opening}; not measured, as the environment is slow")
    else:
        seeds = f"{measured.games} seeds alone: {measured.different_games} different"
        yield _Line(f"  opening_plies: {measured.recommended}", f"{opening}; {seeds}")


def _training(examination: Examination, interface: Interface, is_team: bool) -> Iterator[_Line]:
    turns = examination.actions_per_episode
    alternatives = _other_algorithms(interface, examination.api)
    comment = f"also possible: {', '.join(alternatives)}" if alternatives else "the only one for these spaces"
    yield from (
        _Line(),
        _Line("training:", "league train"),
        _Line("  algorithm: ppo", comment),
        _Line("  steps: 1_000_000", "budget: actions of all agents"),
        _Line("  minutes: null", "time limit; the earlier of the two ends training"),
        _Line("  checkpoint_every: 200_000", "actions between published versions"),
    )
    if turns is not None and turns <= SHORT_EPISODE:
        most = "1 action" if turns == 1 else f"{turns} actions"
        yield _Line("  gamma: 1.0", f"no discount: at most {most} of an agent per episode")
    else:
        yield _Line("  gamma: 0.99", "discount per action; smaller favours quick wins")
    if interface.hidden_information and not is_team:
        yield from (
            _Line("  lr: {initial: 0.001, final: 0.0}", "learning rate, annealed as information is hidden"),
            _Line("  entropy: {initial: 0.1, final: 0.02}", "exploration, annealed for the same reason"),
        )
    else:
        yield from (
            _Line("  lr: 0.0005", "learning rate of Adam"),
            _Line("  entropy: 0.05", "exploration; less makes the policy decide sooner"),
        )
    leaves = [
        leaf
        for spaces in interface.agents.values()
        for name, leaf in inputs(spaces.observation).items()
        if name != ACTION_MASK
    ]
    images = [leaf.shape for leaf in leaves if isinstance(leaf, Box) and len(leaf.shape) == 3]
    sizes = [min(shape[1:] if channels_of(shape) == "first" else shape[:2]) for shape in images]
    if sizes and min(sizes) >= SMALL_BOARD:
        axes = {channels_of(shape) for shape in images}
        convolutions = IMAGE_CONVOLUTIONS if min(sizes) >= IMAGE else BOARD_CONVOLUTIONS
        yield _Line(f"  convolutions: {_inline(convolutions)}", "for images in the observations")
        if len(axes) == 1:
            channels = axes.pop()
            order = "(channels, height, width)" if channels == "first" else "(height, width, channels)"
            yield _Line(f"  channels: {channels}", f"the images are {order}")
    yield _Line("  hidden: [256, 256]", "widths of the hidden layers")
    if any(map(_is_wide, leaves)):
        yield _Line("  normalize_observations: true", "the bounds of observations are wide or infinite")
    if not is_team:
        yield _Line("  opponents: []", "such as {ref: script:random, share: 0.2}; else self-play")


def _patterns(own: list[str], agents: list[str]) -> list[str]:
    """Agents of a policy by their names or, if there are many, by a pattern that fits no other agent."""
    if len(own) == len(agents):
        return ["*"]
    stem = own[0].rstrip("0123456789")
    if len(own) > LISTED_AGENTS and [agent for agent in agents if agent.startswith(stem)] == own:
        return [f"{glob.escape(stem)}*"]
    return own


def _described(space: Space) -> str:
    match space:
        case Discrete():
            return f"{space.n} discrete actions"
        case MultiDiscrete():
            return f"{len(np.ravel(space.nvec))} discrete choices per action"
        case Box():
            return f"{prod(space.shape)} continuous numbers per action"
    return space.type


def _other_algorithms(interface: Interface, api: str) -> list[str]:
    """Algorithms other than PPO for the action spaces, see docs/training.md."""
    actions = [spaces.action for spaces in interface.agents.values()]
    algorithms = []
    if all(isinstance(action, Discrete) for action in actions):
        algorithms.append("dqn")
        if api != "AEC" and len(interface.policy_ids) == 1:
            algorithms.append("qmix (a team)")
    if api != "AEC" and all(isinstance(action, Discrete | Box) for action in actions):
        algorithms.append("maddpg")
    return algorithms


def _is_wide(leaf: Leaf) -> bool:
    """Whether the numbers of a part are unbounded or large. Images are scaled by their bounds."""
    if not isinstance(leaf, Box) or np.dtype(leaf.dtype).kind != "f" or len(leaf.shape) == 3:
        return False
    bounds = [*np.ravel(leaf.low), *np.ravel(leaf.high)]
    return any(bound is None or not -WIDE <= bound <= WIDE for bound in bounds)  # None: infinite


def _inline(value: Any) -> str:
    """A value in the flow style of YAML. Texts are quoted only where necessary."""
    if isinstance(value, str):
        return value if PLAIN.fullmatch(value) and yaml.safe_load(value) == value else json.dumps(value)
    return yaml.safe_dump(value, default_flow_style=True, width=1000, sort_keys=False, allow_unicode=True).strip()
