from dataclasses import asdict
from pathlib import Path
from typing import Any

from evaluation.gating.verdicts import conclude, open_verdict
from league.results.ledger import Ledger
from tests.support.leagues import tictactoe


def test_the_number_of_environments_does_not_change_a_verdict(tmp_path: Path) -> None:
    """Chunks have other bounds, so that other matches are played after the decision, which do not count."""
    gate = {"elo0": 0, "elo1": 100, "max_blocks": 300, "nights": None, "confirmation_blocks": 0}

    def verdict(num_envs: Any) -> tuple[dict[str, Any], int]:
        play = {"opening_plies": 2, "num_envs": num_envs}
        registry = tictactoe.registry(tmp_path / str(num_envs), play=play, gate=gate)
        tictactoe.publish(registry, tictactoe.graph(wins=True, blocks=True))
        row = registry.leagues.get(tictactoe.LEAGUE)
        report = conclude(registry, open_verdict(registry, row, 1, "script:random"))
        played = len(Ledger(registry).matches(league=tictactoe.LEAGUE))
        registry.close()
        document = asdict(report)
        del document["opened_at"]
        return document, played

    few, played_by_few = verdict(3)
    many, played_by_many = verdict("auto")
    assert few == many
    assert few["outcome"] == "promote"
    assert few["blocks"] <= played_by_few < played_by_many == 256
