"""Names of actions, as the configuration gives them, and the keys that directions in the names suggest."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping

from league.config.play import PlayConfig
from league.interface import Interface
from league.spaces import Discrete

ActionNamesByAgent = dict[str, dict[str, str]]
"""Agent → action, as text → its name. Agents without names are left out."""

KEYS = {"up": ("ArrowUp", "w"), "left": ("ArrowLeft", "a"), "down": ("ArrowDown", "s"), "right": ("ArrowRight", "d")}
"""Direction → keys, as `KeyboardEvent.key` names them."""
DIRECTIONS = {"north": "up", "west": "left", "south": "down", "east": "right"} | {name: name for name in KEYS}


def action_names(play: PlayConfig, interface: Interface) -> ActionNamesByAgent:
    """The names of each agent's actions."""
    named: ActionNamesByAgent = {}
    for agent, spaces in interface.agents.items():
        names = play.names_for(interface.policies[agent])
        if isinstance(spaces.action, Discrete) and names:
            named[agent] = {str(action): name for action, name in enumerate(names, spaces.action.start)}
    return named


def direction_keys(names: Mapping[str, str]) -> dict[str, int]:
    """Key → action, for actions whose names contain one direction: arrow keys and WASD.

    If several names contain a direction, the one with the fewest words has its keys; equal ones have none. Names with
    two directions are diagonals, and have no keys.
    """
    named_actions: defaultdict[str, list[tuple[int, int]]] = defaultdict(list)
    for action, name in names.items():
        words = re.findall(r"[a-z]+", name.lower())
        directions = {DIRECTIONS[word] for word in words if word in DIRECTIONS}
        if len(directions) == 1:
            named_actions[directions.pop()].append((len(words), int(action)))
    keys: dict[str, int] = {}
    for direction, candidates in named_actions.items():
        fewest, keyed_action = min(candidates)
        if [words for words, _ in candidates].count(fewest) == 1:
            keys |= dict.fromkeys(KEYS[direction], keyed_action)
    return keys
