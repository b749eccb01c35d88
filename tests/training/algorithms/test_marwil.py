"""Policies learn from recorded games, and continue by playing."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from ray.rllib.core.columns import Columns

from league.config.league import LeagueConfig
from league.environments.building import interface
from league.errors import ConfigError
from tests.support.algorithms import running
from tests.support.leagues.training_leagues import tictactoe
from training.algorithms.rllib_config import algorithm_config

CENTRE, CORNER = 4, 0
UPDATES = 20


def recorded(directory: Path, wins: int) -> Path:
    """Games in which the first move is the corner, which loses, or the centre, which wins `wins` of eight games."""
    rows = [
        {
            "match": f"{number:02}",
            "game": 0,
            "agent": "player_1",
            "step": 0,
            "observation": np.ones(18, np.int8),
            "action_mask": np.ones(9, np.int8),
            "action": CENTRE if number < wins else CORNER,
            "reward": 1.0 if number < wins else -1.0,
            "terminated": True,
        }
        for number in range(8)
    ]
    directory.mkdir()
    pq.write_table(pa.Table.from_pylist(rows), directory / "shared.parquet")
    return directory


def league(data: Path, **training: float) -> LeagueConfig:
    return tictactoe(algorithm="marwil", data=str(data), train_batch_size=64, minibatch_size=64, lr=0.02, **training)


def share_of_centre(league: LeagueConfig, checkpoint: Path) -> float:
    """Train, save, and return the probability of the centre in the first move."""
    with running(league) as algorithm:
        for _ in range(UPDATES):
            result = algorithm.train()
        assert result["env_runners"]["num_env_steps_sampled_lifetime"] == UPDATES * 64
        algorithm.save_to_path(str(checkpoint))
        observation = {"observation": torch.ones(1, 3, 3, 2), "action_mask": torch.ones(1, 9, dtype=torch.int8)}
        module = algorithm.env_runner_group.local_env_runner.module["shared"]
        with torch.no_grad():
            logits = module.forward_inference({Columns.OBS: observation})[Columns.ACTION_DIST_INPUTS]
        return float(logits.softmax(-1)[0, CENTRE])


@pytest.mark.usefixtures("ray_session")
def test_actions_are_imitated_and_advantages_weight_them(tmp_path: Path) -> None:
    data = recorded(tmp_path / "games", wins=2)
    cloned = share_of_centre(league(data), tmp_path / "cloned")
    assert cloned == pytest.approx(2 / 8, abs=0.1)
    # Standardised, the advantages are √3 and -1/√3: the weights are 5.7 and 0.56.
    weighted = share_of_centre(league(data, beta=1.0, value_loss=0.0), tmp_path / "weighted")
    assert weighted == pytest.approx(0.77, abs=0.1)
    with running(tictactoe(train_batch_size=64, minibatch_size=64), tmp_path / "cloned") as continued:
        continued.train()


def test_unsuitable_settings_are_refused(tmp_path: Path) -> None:
    data = recorded(tmp_path / "games", wins=1)
    with pytest.raises(ConfigError, match=r"training.*clip: marwil learns from recorded games"):
        league(data, clip=0.3)
    with pytest.raises(ConfigError, match=r"training\.data: .*nowhere/shared\.parquet does not exist"):
        algorithm_config(config := league(tmp_path / "nowhere"), interface(config))
    (data / "shared.parquet").write_bytes(b"PAR1")
    with pytest.raises(ConfigError, match=r"training\.data: .*shared\.parquet cannot be read as Parquet"):
        algorithm_config(config := league(data), interface(config))
    pq.write_table(pa.table({"match": ["a"]}), data / "shared.parquet")
    with pytest.raises(ConfigError, match="has no column 'game', only match"):
        algorithm_config(config, interface(config))
