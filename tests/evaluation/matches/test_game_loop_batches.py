"""Games do not depend on the number of parallel environments, with networks as large as those that are trained."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from evaluation.matches.game_loop import play_matches
from evaluation.matches.seating import Roster
from evaluation.schedules.builders import round_robin
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.environments.implementation import stepping
from league.environments.lockstep import stock_stepping
from league.policies.onnx import OnnxPolicy
from league.policies.scripted import script
from league.results.records import Match
from tests.support.policies.graphs import masked_mlp

CONFIG = LeagueConfig.load(Path(__file__).parents[3] / "policy_league/configs" / "connect_four.yaml")
INTERFACE = interface(CONFIG)
SPACES = INTERFACE.of_policy("shared")
MLP = CONFIG.training.model_copy(update={"convolutions": (), "hidden": (256, 256)})
CONTESTANTS = ["connect_four@1", "connect_four@2", "script:one_ply"]
SIZES = (1, 2, 3, 8, 31, 32, 33, 512)


def roster(graphs: Sequence[OnnxPolicy]) -> Roster:
    policies = [*graphs, script("one_ply", SPACES.observation, SPACES.action)]
    return {
        ref: dict.fromkeys(INTERFACE.agents, ("shared", policy))
        for ref, policy in zip(CONTESTANTS, policies, strict=True)
    }


def play(graphs: Sequence[OnnxPolicy], num_envs: int, blocks: int, stock: bool = False) -> list[Match]:
    schedule = round_robin(CONFIG, INTERFACE, CONTESTANTS, blocks)
    environment = (stock_stepping if stock else stepping)(CONFIG.environment, num_envs)
    return play_matches(schedule, range(schedule.length), environment, INTERFACE, roster(graphs))


def test_games_are_equal_in_any_number_of_environments() -> None:
    graphs = [OnnxPolicy(masked_mlp(hidden=(256, 256), seed=seed)) for seed in range(2)]
    expected = play(graphs, 32, blocks=3, stock=True)
    assert len(expected) == 9
    for num_envs in (1, 5, 512):
        assert play(graphs, num_envs, blocks=3) == expected


@pytest.mark.slow
@pytest.mark.parametrize("training", [MLP, CONFIG.training], ids=["MLP", "convolutional"])
def test_exported_networks_compute_each_row_alone(tmp_path: Path, training: object) -> None:
    """Their outputs for a row are equal in every batch, to the last bit, and so are the games."""
    import torch

    from training.algorithms.rllib_config import module_spec
    from training.export.onnx_export import export_policy

    graphs = []
    for seed in range(2):
        torch.manual_seed(seed)
        module = module_spec(training, INTERFACE).build()["shared"].eval()
        export_policy(module, SPACES, tmp_path / f"{seed}.onnx")
        graphs.append(OnnxPolicy(tmp_path / f"{seed}.onnx"))
    rng, rows = np.random.default_rng(0), 512
    observations = {
        "observation": (rng.random((rows, 6, 7, 2)) < 0.3).astype(np.int8),
        "action_mask": np.ones((rows, 7), np.int8),
    }
    together = graphs[0].distribution(observations).dist_inputs
    for size in SIZES:
        parts = [
            graphs[0].distribution({name: array[i : i + size] for name, array in observations.items()}).dist_inputs
            for i in range(0, rows, size)
        ]
        np.testing.assert_array_equal(np.concatenate(parts), together)
    expected = play(graphs, 1, blocks=100)
    assert play(graphs, 32, blocks=100) == play(graphs, 512, blocks=100) == expected
