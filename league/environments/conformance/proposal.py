"""Proposes a configuration for an environment (`league init`): a YAML file in which every line has a comment.

The environment is built and played as by `league check-env`. Its agents and spaces determine policies, sides, network
and algorithm; the openings are those that were measured.
"""

import glob
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from math import prod
from string import Template
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
TEMPLATE = """\
# Written by `league init`. docs/configuration.md describes all settings.
league: $league  # name in all commands and URLs
folder: $folder  # where the code is searched, relative to this file

environment:  # what is played
  entry_point: $entry_point  # module or function that creates it
  kwargs: $kwargs  # arguments of its constructor

policies:  # policy → its agents; each policy is one network
$policies

$sides

play:  # the games that are rated
  actions: $actions  # $selection
  opening_plies: $opening_plies  # random moves at the start; $openings

training:  # league train
  algorithm: ppo  # $algorithms
  steps: 1_000_000  # budget: actions of all agents
  minutes: null  # time limit; the earlier of the two ends training
  checkpoint_every: 200_000  # actions between published versions
  gamma: $gamma  # $discount
  lr: $lr  # $rate
  entropy: $entropy  # $exploration
  convolutions: $convolutions  # for images in the observations
  channels: $channels  # the images are $axes
  hidden: [256, 256]  # widths of the hidden layers
  normalize_observations: $normalized  # the bounds of observations are wide or infinite
  opponents: $opponents  # such as {ref: script:random, share: 0.2}; else self-play

gate:  # league nightly: the test for promotions
  elo1: 30  # gain in Elo that the test should detect
  max_blocks: 4000  # pairs of games after which a test ends undecided
  anchors: []  # bots or versions that a new champion must hold its own against
"""
"""The file. Lines with an empty value are left out."""


@dataclass(frozen=True, slots=True)
class Proposal:
    """A configuration file that passes `league check-env`, and what was found while it was made."""

    text: str
    config: LeagueConfig
    examination: Examination


def propose(
    league: str,
    entry_point: str,
    kwargs: JSON,
    folder: str,
    shown: str | None = None,
    *,
    is_team: bool | None = None,
    seconds: float | None = None,
    progress: Callable[[str], None] = lambda _: None,
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
        progress: Receives what is done, at each step.

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
    text = _text(config, examination, examination.interface, team, shown)
    proposed = LeagueConfig.from_mapping(yaml.safe_load(text) | {"folder": document["folder"]}, source="the proposal")
    return Proposal(text, proposed, examination)


def _text(
    config: LeagueConfig, examination: Examination, interface: Interface, is_team: bool, shown: str | None
) -> str:
    """The file. See `propose`."""
    values = {
        "league": config.league,
        "folder": "" if shown is None else _inline(shown),
        "entry_point": _inline(config.environment.entry_point),
        "kwargs": _inline(config.environment.kwargs) if config.environment.kwargs else "",
        "policies": _policies(interface),
        "sides": _sides(interface, is_team),
        "opponents": "" if is_team else "[]",
        **_play(config, examination, interface, is_team),
        **_training(examination, interface, is_team),
    }
    templates = [Template(line) for line in TEMPLATE.splitlines()]
    lines = [line.substitute(values) for line in templates if all(values[name] for name in line.get_identifiers())]
    return "".join(f"{_aligned(line)}\n" for line in "\n".join(lines).split("\n"))


def _aligned(line: str) -> str:
    text, mark, comment = line.rpartition("  # ")
    return f"{text:<{COMMENT_COLUMN}}{mark}{comment}" if text else line


def _policies(interface: Interface) -> str:
    lines = []
    for policy in interface.policy_ids:
        policy_agents = [agent for agent in interface.agents if interface.policies[agent] == policy]
        space = interface.agents[policy_agents[0]].action
        lines.append(f"  {policy}: {_inline(_patterns(policy_agents, list(interface.agents)))}  # {_described(space)}")
    return "\n".join(lines)


def _sides(interface: Interface, is_team: bool) -> str:
    head = "sides:  # side → its agents; the sides are opponents\n"
    if is_team:
        return f'{head}  team: ["*"]  # all agents are one team; without it, each is a side of its own'
    if len(interface.sides) > LISTED_AGENTS or not all(map(SLUG.fullmatch, interface.sides)):
        return "sides: null  # each agent is a side of its own"
    return head + "\n".join(
        f"  {_inline(side)}: {_inline(list(agents))}  # agents of one team belong to one side"
        for side, agents in interface.sides.items()
    )


def _play(config: LeagueConfig, examination: Examination, interface: Interface, is_team: bool) -> dict[str, str]:
    measured, plies = examination.openings, 0
    actions = "greedy" if is_team else action_selection(config, interface)
    selection = (
        f"the most likely ones{', as there is no opponent' if is_team else '; sampled if information is hidden'}"
    )
    if actions == "sampled":
        hides = interface.hidden_information
        selection = f"drawn at random, as {'the environment hides information' if hides else 'opponents act at once'}"
        openings = "sampled actions vary the games"
    elif measured is None:
        openings = "not measured, as the environment is slow"
    else:
        plies = measured.recommended
        openings = f"{measured.games} seeds alone: {measured.different_games} different"
    return {"actions": actions, "selection": selection, "opening_plies": str(plies), "openings": openings}


def _training(examination: Examination, interface: Interface, is_team: bool) -> dict[str, str]:
    turns = examination.actions_per_episode
    is_short = turns is not None and turns <= SHORT_EPISODE
    anneals = interface.hidden_information and not is_team
    alternatives = ", ".join(_other_algorithms(interface, examination.api))
    leaves = [
        leaf
        for spaces in interface.agents.values()
        for name, leaf in inputs(spaces.observation).items()
        if name != ACTION_MASK
    ]
    images = [leaf.shape for leaf in leaves if isinstance(leaf, Box) and len(leaf.shape) == 3]
    axes = {channels_of(shape) for shape in images}
    size = min((min(shape[1:] if channels_of(shape) == "first" else shape[:2]) for shape in images), default=0)
    return {
        "algorithms": f"also possible: {alternatives}" if alternatives else "the only one for these spaces",
        "gamma": "1.0" if is_short else "0.99",
        "discount": f"no discount: at most {turns} action{'s' * (turns != 1)} of an agent per episode"
        if is_short
        else "discount per action; smaller favours quick wins",
        "lr": "{initial: 0.001, final: 0.0}" if anneals else "0.0005",
        "rate": "learning rate, annealed as information is hidden" if anneals else "learning rate of Adam",
        "entropy": "{initial: 0.1, final: 0.02}" if anneals else "0.05",
        "exploration": "exploration, annealed for the same reason"
        if anneals
        else "exploration; less makes the policy decide sooner",
        "convolutions": _inline(IMAGE_CONVOLUTIONS if size >= IMAGE else BOARD_CONVOLUTIONS)
        if size >= SMALL_BOARD
        else "",
        "channels": next(iter(axes)) if size >= SMALL_BOARD and len(axes) == 1 else "",
        "axes": "(channels, height, width)" if axes == {"first"} else "(height, width, channels)",
        "normalized": "true" if any(map(_is_wide, leaves)) else "",
    }


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
