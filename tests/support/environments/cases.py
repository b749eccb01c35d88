"""PettingZoo environments, each with the configuration of its league."""

from dataclasses import dataclass, field
from typing import Any

from league.config.league import LeagueConfig

TEAM = {"team": ["*"]}

PIXELS = {"convolutions": [{"filters": 4, "kernel": 8, "stride": 4}]}


@dataclass(frozen=True)
class Case:
    """An environment, with settings that reduce a few of its episodes to seconds."""

    entry_point: str
    kwargs: dict[str, Any] = field(default_factory=dict)
    sides: dict[str, list[str]] | None = None
    policies: dict[str, list[str]] | None = None
    wrappers: tuple[Any, ...] = ()
    training: dict[str, Any] = field(default_factory=dict)

    def league(self) -> LeagueConfig:
        environment = {"entry_point": self.entry_point, "kwargs": self.kwargs, "wrappers": list(self.wrappers)}
        training = {
            "runners": 0,
            "num_envs": 2,
            "train_batch_size": 64,
            "minibatch_size": 32,
            "epochs": 1,
            "hidden": [16],
        }
        return LeagueConfig.from_mapping(
            {
                "league": self.entry_point.rpartition(".")[2],
                "environment": environment,
                "sides": self.sides,
                "policies": self.policies,
                "play": {"num_envs": 4},
                "training": training | self.training,
            }
        )


CLASSIC = "pettingzoo.classic."

BUTTERFLY = "pettingzoo.butterfly."

SISL = "pettingzoo.sisl."

CASES = [
    Case(CLASSIC + "chess_v6"),
    Case(CLASSIC + "connect_four_v3"),
    Case(CLASSIC + "go_v5", {"board_size": 5}),
    Case(CLASSIC + "hanabi_v5", sides=TEAM),
    Case(CLASSIC + "leduc_holdem_v4"),
    Case(CLASSIC + "rps_v2"),
    Case(CLASSIC + "texas_holdem_v4"),
    Case(CLASSIC + "texas_holdem_no_limit_v6"),
    Case(CLASSIC + "tictactoe_v3"),
    Case(
        BUTTERFLY + "cooperative_pong_v6",
        {"max_cycles": 12},
        TEAM,
        {"left": ["paddle_0"], "right": ["paddle_1"]},
        ({"color_reduction_v0": {"mode": "R"}}, {"resize_v1": {"x_size": 42, "y_size": 42}}, "frame_stack_v1"),
        PIXELS,
    ),
    Case(BUTTERFLY + "knights_archers_zombies_v11", {"max_cycles": 20}, TEAM),
    Case(
        BUTTERFLY + "pistonball_v6",
        {"n_pistons": 5, "max_cycles": 8},
        TEAM,
        None,
        ({"color_reduction_v0": {"mode": "B"}}, {"resize_v1": {"x_size": 42, "y_size": 42}}, "frame_stack_v1"),
        PIXELS,
    ),
    Case(SISL + "multiwalker_v9", {"max_cycles": 20}, TEAM),
    Case(SISL + "pursuit_v5", {"max_cycles": 10}, TEAM),
    Case("mpe2.simple_v3", sides=TEAM),
    Case(
        "mpe2.simple_adversary_v3",
        sides={"adversary": ["adversary_*"], "good": ["agent_*"]},
        policies={"adversary": ["adversary_*"], "good": ["agent_*"]},
    ),
    Case(
        "mpe2.simple_crypto_v3",
        sides={"eve": ["eve_*"], "good": ["*"]},
        policies={"eve": ["eve_*"], "bob": ["bob_*"], "alice": ["alice_*"]},
    ),
    Case("mpe2.simple_push_v3", policies={"adversary": ["adversary_*"], "good": ["agent_*"]}),
    Case("mpe2.simple_reference_v3", sides=TEAM),
    Case(
        "mpe2.simple_speaker_listener_v4",
        sides=TEAM,
        policies={"speaker": ["speaker_*"], "listener": ["listener_*"]},
    ),
    Case("mpe2.simple_spread_v3"),
    Case(
        "mpe2.simple_tag_v3",
        sides={"hunters": ["adversary_*"], "hunted": ["agent_*"]},
        policies={"hunters": ["adversary_*"], "hunted": ["agent_*"]},
    ),
    Case(
        "mpe2.simple_world_comm_v3",
        sides={"hunters": ["*adversary_*"], "hunted": ["agent_*"]},
        policies={"leader": ["leadadversary_*"], "hunters": ["adversary_*"], "hunted": ["agent_*"]},
    ),
]
