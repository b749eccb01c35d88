"""What `check-env` and `league init` say of environments: sound, odd and faulty ones, of all APIs.

The cases of `tests/data/findings.json.xz`, see `tests.support.recordings`. Environments that block or end their process
are not among them, nor what depends on time.
"""

import json
import random
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from league.config.league import LeagueConfig
from league.environments.conformance import episodes, examination, openings
from league.environments.conformance.examination import examine
from league.environments.conformance.proposal import propose
from league.errors import LeagueError
from tests.support.environments.cases import CASES
from tests.support.environments.kinds import KINDS
from tests.support.environments.masked import APIS
from tests.support.environments.varied_spaces import ACTIONS, OBSERVATIONS, REFUSED

ROOT = Path(__file__).parents[2]
CONFIGS = ROOT / "policy_league" / "configs"
MEASURED = ("steps_per_second", "stock_steps_per_second")
"""Fields of documents that are measurements of time."""
VARIABLE = re.compile(
    r"(?<=\.py, line )\d+"  # lines of files move
    r"|(?<=np\.int32\()\d+(?=\) is not what sample returns)"  # PettingZoo's API test samples without a seed
    r"|(?<=^agent )(ann|bob)(?= has left the environment neither)"  # the first one of a set, by the hashes of a process
    r"| assert \S.* is \S.* \+ where .*"  # pytest adds this to the assertions of pettingzoo.test
)
"""Parts of texts that differ between processes."""
CLASSIC, BUTTERFLY, MPE = "pettingzoo.classic.", "pettingzoo.butterfly.", "mpe2."
SUPPORT, TESTS, EXAMPLES = "tests.support.environments.", "tests.league.environments.", "policy_league.examples."
UNSOUND, LEARNT = f"{SUPPORT}unsound:", f"{SUPPORT}training_environments:"
RETURNS, OWN = f"{TESTS}test_returns:", f"{TESTS}test_apis:"
MEETING, RLLIB_MEETING = f"{SUPPORT}simultaneous:meeting", f"{SUPPORT}simultaneous:rllib_meeting"
COUNTING, COPIES = f"{SUPPORT}counting:counting", f"{SUPPORT}vector_copies:"
RLLIB = "ray.rllib.examples.envs.classes.multi_agent"
SPREAD, ADVERSARY, PISTONBALL = f"{MPE}simple_spread_v3", f"{MPE}simple_adversary_v3", f"{BUTTERFLY}pistonball_v6"
TICTACTOE, KUHN = f"{CLASSIC}tictactoe_v3", f"{EXAMPLES}kuhn_poker:env"
Arguments = dict[str, Any]
PISTONS: Arguments = {"n_pistons": 5, "max_cycles": 8}
SHORT: Arguments = {"max_cycles": 10}
NAMED: list[Arguments] = [{"agents": [0, 1]}, {"agents": ["unit[0]", "unit[1]"]}]
LATE: list[Arguments] = [{"late": "spaces"}, {"late": "agents"}]
CHANGES = (
    "rewards None",
    "a reward None",
    "a reward array",
    "rewards list",
    "four values",
    "raises",
    "flag array",
    "no infos",
    "no observation",
    "another mask",
    "another key",
)

SOUND: dict[str, list[Arguments]] = {
    MEETING: [
        {},
        {"leaves": [2, 7]},
        {"arrives": [0, 2, 1, 0], "leaves": [4, 5, 2, 3], "truncated": [1, 2]},
        {"truncated": [0, 1]},
    ],
    RLLIB_MEETING: [{}, {"ends": 5}, {"truncated": False}, {"silent": True}],
    COUNTING: [{}, {"truncated": [0, 1]}, {"lives": [1, 4, 2, 4], "truncated": [1, 2]}, {"lives": [5]}],
    f"{UNSOUND}OutOfBounds": [{}],
    f"{UNSOUND}OneRound": [{"rounds": rounds} for rounds in (1, 2, 20)],
    f"{UNSOUND}Unrewarding": [{}, {"any_length": True}, {"truncated": [0, 1]}],
    f"{UNSOUND}Stateful": [{"kind": "sound"}, {"kind": "raises"}],
    f"{SUPPORT}fuses:fuse": [{"ends": "breaks"}],
    f"{SUPPORT}engines:engine": [{}, {"closes": "raises"}, {"closes": "exits"}, {"most": 2}],
    f"{SUPPORT}declaring:Open": [{}],
    f"{SUPPORT}declaring:Declaring": [{}],
    f"{SUPPORT}declaring:Malformed": [{"board": "x", "action_keys": {"d": 99}, "hidden_information": "yes"}],
    **{f"{SUPPORT}masked:{api}": [{"space": space} for space in ("obs", "nested", "secret", "multi")] for api in APIS},
    f"{LEARNT}discrete": [{}, {"agents": 3}, {"agents": 2, "opposed": True}],
    f"{LEARNT}several": [{"agents": 2}],
    f"{LEARNT}far_numbers": [{"agents": 2}],
    f"{LEARNT}summing": [{}, {"ends": 2}],
    **{f"{LEARNT}{name}": [{}] for name in ("numbers", "watching", "remembering", "masked")},
    f"{SUPPORT}varied_spaces:varied": [
        *({"observation": name} for name in OBSERVATIONS if name not in REFUSED),
        *({"action": name} for name in ACTIONS if name not in REFUSED),
    ],
    f"{TESTS}test_exits:Exiting": [{"where": "close"}],
    **{f"{TESTS}test_info_masks:{name}": [{}] for name in ("InfoMaskTicTacToe", "ParallelInfoMasks", "RLlibInfoMasks")},
    f"{OWN}Rounds": NAMED + LATE,
    f"{OWN}turns": NAMED + LATE,
    f"{OWN}Group": [*NAMED, *LATE, *({"where": where} for where in ("dict", "Dict", "common", "common Dict"))],
    f"{OWN}Overriding": NAMED,
    **{
        f"{TESTS}test_lockstep:{name}": [{}]
        for name in ("ReusedArrays", "RepeatedTermination", "NoAllFlag", "StateInInfo")
    },
    TICTACTOE: [{}],
    f"{CLASSIC}connect_four_v3": [{}, {"render_mode": "rgb_array"}],
    f"{CLASSIC}rps_v2": [{}, {"max_cycles": 6}],
    f"{CLASSIC}leduc_holdem_v4": [{}],
    f"{CLASSIC}texas_holdem_v4": [{}],
    SPREAD: [SHORT],
    ADVERSARY: [SHORT],
    f"{MPE}simple_tag_v3": [SHORT | {"continuous_actions": True}],
    f"{MPE}simple_reference_v3": [SHORT],
    f"{MPE}simple_speaker_listener_v4": [SHORT],
    PISTONBALL: [PISTONS],
    f"{EXAMPLES}two_step:parallel_env": [{}],
    f"{SUPPORT}rllib_two_step:multi_agent_env": [{}],
    f"{EXAMPLES}traffic:crossing": [{}],
    KUHN: [{}],
    f"{EXAMPLES}leduc_holdem:env": [{}],
    f"{EXAMPLES}blotto:env": [{}],
    "openspiel": [
        *({"game": game} for game in ("kuhn_poker", "matrix_rps", "tic_tac_toe", "goofspiel", "pig", "hex")),
        {"game": "kuhn_poker", "players": 3, "information_state": True},
    ],
    f"{RLLIB}:MultiAgentCartPole": [{"config": {"num_agents": 2}}],
    f"{RLLIB}.double_row_corridor_env:DoubleRowCorridorEnv": [{}],
    f"{RLLIB}.rock_paper_scissors:RockPaperScissors": [{"config": {}}],
    f"{RLLIB}.two_step_game:TwoStepGame": [{"env_config": {}}],
}
"""Entry points without faults, and their arguments: these have a proposal of `league init`."""

FAULTY: dict[str, list[Arguments]] = {
    MEETING: [
        *({"crashes": [seed]} for seed in (0, 2, 7)),
        {"bad_reward": float("nan")},
        {"bad_reward": float("inf")},
        {"no_such_argument": 1},
    ],
    f"{UNSOUND}Shuffled": [{"module": "random"}, {"module": "numpy.random"}],
    f"{UNSOUND}Unrewarding": [{"truncated": [0, 1], "any_length": True}],
    f"{UNSOUND}Stateful": [{"kind": "grows"}, {"kind": "nan"}],
    **{
        f"{UNSOUND}{name}": [{}]
        for name in ("IgnoresSeed", "Forgetful", "WrongShape", "DictActions", "ConstantImages", "Signalling")
    },
    f"{SUPPORT}faulty:raising": [{}],
    f"{SUPPORT}faulty:unrewarding": [{}],
    f"{SUPPORT}faulty_steps:violation": [
        {"fault": fault} for fault in ("empty", "mute", "flown", "stranger", "misshapen", "exits")
    ],
    f"{SUPPORT}hanging:Raising": [{}],
    f"{SUPPORT}engines:engine": [{"most": 0}, {"most": 1}],
    **{f"{SUPPORT}masked:{api}": [{"space": space} for space in ("joint", "short", "parts", "only")] for api in APIS},
    f"{LEARNT}bits": [{}],
    f"{SUPPORT}varied_spaces:varied": [
        *({"observation": name} for name in OBSERVATIONS if name in REFUSED),
        *({"action": name} for name in ACTIONS if name in REFUSED),
    ],
    f"{TESTS}test_exits:Exiting": [
        *({"where": where} for where in ("constructor", "space", "reset", "step")),
        {"where": "close", "bad_reward": float("nan")},
    ],
    f"{RETURNS}WrongParallel": [{"change": change} for change in ("one value", "done", *CHANGES)],
    f"{RETURNS}WrongRLlib": [{"change": change} for change in CHANGES],
    f"{RETURNS}WrongTurns": [{"change": change} for change in ("a reward None", "four values")],
    f"{RETURNS}BinaryActions": [{}],
    f"{TESTS}test_info_masks:Far": [{}],
    f"{TESTS}test_info_masks:ParallelInfoMasks": [{"late": True}],
    f"{TESTS}test_info_masks:RLlibInfoMasks": [{"late": True}],
    f"{OWN}Rounds": [{"agents": [1, "1"]}],
    f"{OWN}Group": [{"agents": [1, "1"]}, {"where": "nowhere"}],
    f"{OWN}Both": [{}],
    f"{TESTS}test_building:nameless": [{}],
    f"{CLASSIC}connect_four_v3": [{"colour": 1}],
    **{
        name: [{}]
        for name in (
            "no_such_module:env",
            f"{CLASSIC}connect_for_v3",
            "pettingzoo.classic",
            "league.config:nothing",
            ".relative",
            "builtins:dict",
        )
    },
    "openspiel": [{"game": "kuhn_poker", "colour": 1}, {"game": "no_such_game"}, {"game": "mfg_crowd_modelling"}],
    f"{RLLIB}:MultiAgentNestedSpaceRepeatAfterMeEnv": [{"config": {"num_agents": 2}}],
    f"{RLLIB}.tic_tac_toe:TicTacToe": [{}],
}
"""Entry points with faults, and their arguments."""

STACK: Arguments = {"frame_stack_v1": {"stack_size": 2}}
WRAPPED: list[tuple[str, Arguments, list[Any]]] = [
    *(
        (SPREAD, SHORT, wrappers)
        for wrappers in (
            ["agent_indicator_v0"],
            ["black_death_v3"],
            [{"clip_reward_v0": {"lower_bound": -1, "upper_bound": 1}}],
            [{"delay_observations_v0": {"delay": 2}}],
            [{"dtype_v0": {"dtype": "float64"}}],
            [{"frame_skip_v0": {"num_frames": 2}}],
            [STACK],
            [{"frame_stack_v1": {"stack_dim": 0}}],
            [{"max_observation_v0": {"memory": 2}}],
            [{"nan_noop_v0": {"no_op_action": 0}}],
            [{"reshape_v0": {"shape": [2, 9]}}],
            [{"sticky_actions_v0": {"repeat_action_probability": 0.3}}],
            ["pad_observations_v0", "agent_indicator_v0", STACK],
            ["frame_stak_v2"],
            ["vectorize_aec_env_v0"],
            [{"frame_stack_v1": {"size": 2}}],
        )
    ),
    (ADVERSARY, SHORT, ["agent_indicator_v0"]),
    (ADVERSARY, SHORT, ["pad_observations_v0", "agent_indicator_v0"]),
    (PISTONBALL, PISTONS, [{"color_reduction_v0": {"mode": "B"}}, {"resize_v1": {"x_size": 12, "y_size": 48}}, STACK]),
    (PISTONBALL, PISTONS, ["flatten_v0", {"resize_v1": {"x_size": 8, "y_size": 8}}]),
    (TICTACTOE, {}, [STACK]),
    (COUNTING, {}, [STACK]),
    (f"{EXAMPLES}traffic:crossing", {}, ["flatten_v0"]),
    (MEETING, {}, [{"name": f"{TESTS}test_exits:ExitingWrapper"}]),
    *((f"{RETURNS}WrongParallel", {"change": name}, ["clip_reward_v0"]) for name in ("a reward None", "raises")),
]
"""Entry points, their arguments and wrappers."""

BOX, DISCRETE = {"type": "box", "dtype": "float32", "shape": [4], "low": -1, "high": 1}, {"type": "discrete", "n": 5}
EXTERNAL = {
    "simulator": "pursuit",
    "version": "1.0",
    "hidden_information": True,
    "agents": {agent: {"observation": BOX, "action": DISCRETE} for agent in ("hunter", "prey")},
}
SETTINGS: list[tuple[Arguments, Arguments]] = [
    ({"entry_point": KUHN, "vector": f"{EXAMPLES}kuhn_poker_vector:KuhnPokerVector"}, {}),
    ({"entry_point": KUHN, "vector": f"{UNSOUND}WrongKuhnPoker"}, {}),
    ({"entry_point": KUHN, "vector": f"{UNSOUND}BrokenKuhnPoker"}, {}),
    ({"entry_point": KUHN, "vector": f"{COPIES}Nothing"}, {}),
    ({"entry_point": KUHN, "vector": "no colon"}, {}),
    ({"entry_point": TICTACTOE, "vector": f"{COPIES}Chance"}, {}),
    ({"entry_point": MEETING, "vector": f"{COPIES}Faulty"}, {"policies": {"a": ["*_0"], "b": ["*_1"]}}),
    ({"entry_point": COUNTING, "vector": f"{COPIES}VectorCounting"}, {"policies": {"a": ["*_0"], "b": ["*_1"]}}),
    ({"entry_point": SPREAD, "api": "aec", "kwargs": SHORT}, {}),
    ({"entry_point": f"{CLASSIC}rps_v2", "api": "aec"}, {}),
    ({"entry_point": TICTACTOE, "api": "parallel"}, {}),
    ({"entry_point": f"{CLASSIC}rps_v2:env", "api": "rllib"}, {}),
    *(({"entry_point": f"{OWN}Both", "api": api}, {}) for api in ("parallel", "rllib")),
    ({"entry_point": f"{OWN}Rounds", "api": "rllib"}, {}),
    ({"entry_point": f"{TESTS}test_info_masks:Far"}, {"training": {"normalize_observations": True}}),
    ({"entry_point": f"{SUPPORT}masked:ParallelMasked", "kwargs": {"space": "obs", "continuous": True}}, {}),
    ({"entry_point": f"{UNSOUND}Endless"}, {"play": {"max_moves": 50}}),
    ({"entry_point": TICTACTOE}, {"play": {"opening_plies": 7}}),
    ({"entry_point": f"{UNSOUND}OneRound", "kwargs": {"rounds": 20}}, {"play": {"opening_plies": 2}}),
    ({"entry_point": SPREAD, "kwargs": SHORT}, {"sides": {"team": ["*"]}}),
    ({"entry_point": COUNTING}, {"policies": {"a": ["player_0"]}}),
    ({"entry_point": COUNTING}, {"policies": {"a": ["*"]}}),
    ({"entry_point": COUNTING}, {"sides": {"a": ["player_9"]}}),
    ({"entry_point": TICTACTOE}, {"policies": "no_such_module:role"}),
    ({"entry_point": TICTACTOE}, {"play": {"action_names": ["a", "b"]}}),
    ({"entry_point": "external", "external": EXTERNAL}, {}),
]
"""Sections `environment`, and the other ones, of configurations."""

CUT: list[tuple[str, Arguments]] = [(f"{UNSOUND}Endless", {"steps": 20}), (TICTACTOE, {"episodes": 1, "steps": 3})]
"""Entry points, and options of `check-env`."""


SLOW = re.compile(
    r"pistonball|_(dqn|qmix)|double_row|VectorCounting|\"(hex|pig)\"|init (pettingzoo|mpe2|openspiel|ray)|case "
)
"""In the names of cases that take half a second or more, or resemble quick ones."""


@dataclass(frozen=True)
class Case:
    """An examination, or the proposal of `league init`, of a league: its document, or the file in `CONFIGS`."""

    league: Mapping[str, Any] | str
    options: Arguments = field(default_factory=dict)
    is_proposal: bool = False

    def document(self) -> Any:
        """What is said, as it is stored."""
        # Some environments draw from these generators, whatever the seed is.
        random.seed(0)
        np.random.seed(0)
        try:
            with shortened():
                document = self._proposed() if self.is_proposal else self._examined()
        except LeagueError as error:
            document = {"error": type(error).__name__, "text": str(error)}
        return _normal(json.loads(json.dumps(document)))

    def _proposed(self) -> str:
        assert isinstance(self.league, Mapping)
        environment = self.league["environment"]
        return propose("x", environment["entry_point"], environment["kwargs"], str(CONFIGS)).text

    def _examined(self) -> Any:
        name = self.league
        config = LeagueConfig.load(CONFIGS / name) if isinstance(name, str) else LeagueConfig.from_mapping(name)
        examined = examine(config, **self.options)
        return asdict(replace(examined, interface=None)) | {
            "interface": examined.interface and examined.interface.digest(),
            "openings_text": str(examined.openings),
            "passed": examined.passed,
        }


@contextmanager
def shortened() -> Iterator[None]:
    """Few games, and short comparisons with stock environments. No deadline ends any of them."""
    with pytest.MonkeyPatch.context() as patched:
        for name, value in {"COMPARED_STEPS": 100, "COMPARED_COPIES": 4, "MEASURED_SECONDS": 0.01, "CYCLES": 5}.items():
            patched.setattr(examination, name, value)
        patched.setattr(examination, "BARE_SECONDS", 1e9)
        patched.setattr(episodes, "GAMES", 8)
        patched.setattr(openings, "SEEDS", 8)
        patched.setattr(openings, "OPENINGS", 100)
        yield


def cases() -> dict[str, Case]:
    """All cases by their names."""
    leagues: dict[str, Case] = {
        path.name: Case(path.name) for path in sorted(CONFIGS.glob("*.yaml")) if path.name != "pistonball_gpu.yaml"
    }
    for entry_points in (SOUND, FAULTY):
        for entry_point, alternatives in entry_points.items():
            for kwargs in alternatives:
                name, case = _name(entry_point, kwargs), Case(_league({"entry_point": entry_point, "kwargs": kwargs}))
                leagues[name] = case
                if entry_points is SOUND:
                    leagues[f"init {name}"] = replace(case, is_proposal=True)
    for entry_point, kwargs, wrappers in WRAPPED:
        environment = {"entry_point": entry_point, "kwargs": kwargs, "wrappers": wrappers}
        leagues[_name(entry_point, kwargs, wrappers)] = Case(_league(environment))
    for environment, settings in SETTINGS:
        leagues[_name(*(value for value in environment.values() if value is not EXTERNAL), settings)] = Case(
            _league(environment, **settings)
        )
    for entry_point, options in CUT:
        leagues[_name(entry_point, options)] = Case(_league({"entry_point": entry_point}), options)
    for stock in CASES:
        leagues[f"case {stock.entry_point}"] = Case(stock.league().model_dump(by_alias=True))
    for kind, of_kind in KINDS.items():
        leagues[f"kind {kind}"] = Case(of_kind.config.model_dump(by_alias=True))
    return leagues


def documents() -> Iterator[tuple[str, Any]]:
    """All cases with what is said of them."""
    for name, case in cases().items():
        yield name, case.document()


def _league(environment: Arguments, **settings: Any) -> Arguments:
    return {"league": "x", "environment": environment} | settings


def _name(entry_point: Any, *parts: Any) -> str:
    texts = (part if isinstance(part, str) else json.dumps(part) for part in (entry_point, *parts) if part)
    return " ".join(texts).replace(SUPPORT, "").replace(TESTS, "")


def _normal(value: Any) -> Any:
    """A document without this machine's paths, its measurements of time, and what else varies."""
    match value:
        case dict():
            return {key: "measured" if key in MEASURED and part else _normal(part) for key, part in value.items()}
        case list():
            return [_normal(part) for part in value]
        case str():
            return VARIABLE.sub("", value.replace(f"{ROOT}/", "").replace(str(ROOT), "ROOT"))
    return value
