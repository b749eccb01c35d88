"""Tic-tac-toe between scripts and graphs, for tests of the match loop."""

from evaluation.matches.seating import Roster
from league.environments.building import interface
from league.policies.onnx import OnnxPolicy
from league.policies.policy import Policy
from league.policies.scripted import script
from tests.support.leagues import tictactoe

CONFIG = tictactoe.config()

INTERFACE = interface(CONFIG)


GREEDY, WINNER = "tictactoe@1", "tictactoe@2"

CONTESTANTS = [GREEDY, WINNER, "script:random", "script:one_ply"]


def build_roster() -> Roster:
    spaces = INTERFACE.of_policy("shared")
    policies: dict[str, Policy] = {
        GREEDY: OnnxPolicy(tictactoe.graph()),
        WINNER: OnnxPolicy(tictactoe.graph(wins=True, blocks=True)),
        "script:random": script("random", spaces.observation, spaces.action),
        "script:one_ply": script("one_ply", spaces.observation, spaces.action),
    }
    return {ref: dict.fromkeys(INTERFACE.agents, ("shared", policy)) for ref, policy in policies.items()}
