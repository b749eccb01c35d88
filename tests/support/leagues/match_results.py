"""Data of `board` after matches, verdicts and training runs: a few rows of each kind."""

from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

from league.registry.registry import Registry
from league.registry.storage.rows import RunPoint, StrengthRow
from league.results.ledger import Ledger
from league.results.records import Forfeit, Schedule
from tests.support.leagues.ledger_matches import play_match

LEAGUE = "board"
WON, LOST, PENDING = "board-verdict-won", "board-verdict-lost", "board-verdict-pending"
EARLIER = "0123456789ab-greedy"
"""Earlier conditions with results."""
STRENGTH = StrengthRow(
    league=LEAGUE,
    version=2,
    opponent="board@1",
    run="first",
    steps=200,
    games=40,
    score=0.625,
    low=0.5,
    high=0.75,
    at=datetime(2026, 3, 3, 14, tzinfo=UTC),
)
GAIN = {"mean": 1.5, "low": 0.5, "high": 2.5}
EXPLOITER_SCORE = {"ref": "board@3", "games": 64, "score": 0.75, "low": 0.625, "high": 0.875, "gain": GAIN}
NIGHT = {
    "train": {"run": "first", "versions": ["board@2"], "start": 3},
    "gate": {"champion_before": "board@1", "champion": "board@2", "verdicts": []},
    "exploiter": {"target": "board@2", "run": "exploiter", "versions": ["board@3"], "error": "the disk is full"},
    "measure": {"exploitability": {"ref": "board@2", "bound": 0.625, "exploiters": [EXPLOITER_SCORE]}},
}
"""The results of a night's steps."""
SCHEDULE = Schedule(
    id="board-round_robin-1",
    league=LEAGUE,
    kind="round_robin",
    seed=7,
    environment_digest="0" * 64,
    game_digest="0" * 64,
    sides=("player_0", "player_1"),
    contestants=("board@1", "board@2", "script:random"),
    pairings=((0, 1), (0, 2), (1, 2)),
    length=6,
    opening_plies=2,
)
RANKED = ("board@2", "board@1", "board@3", "script:random")


def record(registry: Registry) -> None:
    """Write all data to a registry that has `board` with three versions, the first of them its champion."""
    _matches(registry)
    _verdicts(registry)
    _runs(registry)
    _nights(registry)
    registry.snapshots.put(LEAGUE, snapshots(), registry.snapshots.current_marks()[LEAGUE])


def _matches(registry: Registry) -> None:
    """Six matches, the last with a forfeited game, and one match of a purged schedule."""
    ledger = Ledger(registry)
    current = replace(SCHEDULE, game_digest=registry.leagues.get(LEAGUE).game_digest)
    purged = replace(current, id="board-gauntlet-2", kind="gauntlet")
    for schedule in (current, purged):
        ledger.open(schedule)
    for position in range(5):
        ledger.extend([play_match(current, position)])
    last = play_match(current, 5)
    forfeit = Forfeit(contestant=1, agent="player_1", reason="illegal_action")
    ledger.extend([replace(last, games=(replace(last.games[0], forfeits=(forfeit,)), last.games[1]))])
    ledger.extend([play_match(purged, 0)])
    ledger.purge([purged.id])


def _verdicts(registry: Registry) -> None:
    """A rejected version in an earlier game, the champion, and an open verdict."""
    settings, ledger = {"gate": {"alpha": 0.05}}, Ledger(registry)
    current = registry.leagues.get(LEAGUE).game_digest
    for verdict, candidate in ((LOST, 3), (WON, 2), (PENDING, 3)):
        game = f"{EARLIER.partition('-')[0]:0<64}" if verdict == LOST else current
        ledger.open(replace(SCHEDULE, id=verdict, kind="verdict", game_digest=game))
        registry.verdicts.open(LEAGUE, candidate, f"board@{1 if verdict != PENDING else 2}", verdict, settings)
        if verdict == WON:
            registry.aliases.set(
                LEAGUE, "champion", 2, expected=1, actor="league nightly", reason="beat board@1", verdict=WON
            )
        if verdict != PENDING:
            registry.verdicts.close(verdict, "promote" if verdict == WON else "reject", evidence(verdict == WON))


def evidence(won: bool) -> dict[str, Any]:
    """The fields of the evidence that lists show."""
    return {
        "promoted": won,
        "llr": 2.97 if won else -3.0,
        "bounds": [-2.94, 2.94],
        "blocks": 41,
        "games": 82,
        "score": 0.72 if won else 0.31,
        "elo": 164.0 if won else -139.0,
        "interval": [98.0, None] if won else None,
    }


def _runs(registry: Registry) -> None:
    for run in ("first", "second"):
        registry.runs.begin(LEAGUE, run, algorithm="ppo", settings={"lr": 0.001, "minutes": 10}, seed=3, target=1000)
    for steps in (100, 200):
        point = RunPoint(LEAGUE, "first", steps, {"return": steps / 1000, "shared/entropy": 1.5}, datetime.now(UTC))
        registry.runs.record(LEAGUE, "first", point, seconds=steps / 10)
    registry.runs.end(LEAGUE, "first", "failed", "the environment raised")
    registry.runs.begin(LEAGUE, "exploiter", algorithm="ppo", settings={}, seed=3, target=1000, exploits="board@2")
    registry.runs.end(LEAGUE, "exploiter", "ended")
    registry.strength.record([STRENGTH])


def _nights(registry: Registry) -> None:
    """A complete night and nightly run, and one each that has only begun."""
    night = registry.training_nights.open(LEAGUE)
    for step, result in NIGHT.items():
        registry.training_nights.record(night.id, step, result)
    registry.training_nights.close(night.id)
    registry.training_nights.open(LEAGUE)
    verdict = {"verdict": WON, "candidate": "board@2", "opponent": "board@1", "outcome": "promote"} | evidence(True)
    report = {"champion_before": "board@1", "champion": "board@2", "verdicts": [verdict]}
    nightly_run = registry.nightly_runs.open(LEAGUE, [2], 0.001)
    registry.nightly_runs.close(nightly_run.id, report | {"faults": ["board@3: its file is missing"]})
    registry.nightly_runs.open(LEAGUE, [3], 0.001)


def snapshots() -> dict[str, Any]:
    """The documents that the evaluation service would have computed."""
    leaderboard = [standing(ref, 100.0 * place) for place, ref in enumerate(reversed(RANKED))][::-1]
    curve = [[block, 0.07 * block] for block in range(1, 42)]
    judgement = evidence(True) | {"verdict": WON, "candidate": "board@2", "opponent": "board@1", "outcome": "promote"}
    judgement |= {"reason": "It is the stronger one.", "curve": curve, "counts": [2, 3, 9, 12, 15], "anchors": []}
    stale = judgement | {"verdict": LOST, "outcome": "open", "reason": "It is not decided yet."}
    pair, change = {"better": "board@1", "other": "board@2"}, {"name": "play.opening_plies", "before": "4", "now": "2"}
    earlier = {"name": EARLIER, "actions": "greedy", "matches": 3, "changes": [change]}
    alpha_rank = {"alpha_rank": 0.9, "alpha_rank_interval": [0.5, 1.0]}
    nash = {"nash": 1.0, "nash_interval": [0.7, 1.0]}
    return {
        "summary": {
            "games": 12,
            "matches": 6,
            "unique_games": 12,
            "scoring": "game",
            "actions": "greedy",
            "sides": ["player_0", "player_1"],
            "environment": "games.none:none",
            "environment_digest": "0" * 64,
            "upsets": [{"match": f"{SCHEDULE.id}/1", "game": 0, "expected": 0.1, "score": 1} | pair],
            "earlier": [earlier | {"actions_changed": False, "replaced_at": "2026-03-02T14:00:00Z"}],
        },
        "leaderboard": {
            "sides": list(SCHEDULE.sides),
            "leaderboard": leaderboard,
            "by_side": {"player_0": leaderboard[:2], "player_1": []},
        },
        "payoff": {
            "contestants": ["board@2", "board@1"],
            "score": [[None, 0.75], [0.25, None]],
            "games": [[0, 4], [4, 0]],
            "by_side": {},
            "difference": [[None, {"mean": 0.5, "low": None, "high": None}], [None, None]],
            "shares": [{"ref": "board@2", "value": 0.0} | alpha_rank | nash],
        },
        f"earlier/{EARLIER}/leaderboard": {"sides": [], "leaderboard": leaderboard[1:2], "by_side": {}},
        f"earlier/{EARLIER}/payoff": None,
        "ratings": {"versions": [rated(number) for number in (1, 2, 3)]},
        f"verdict/{WON}": judgement | {"opened_at": "2026-03-03T14:00:00Z", "closed_at": "2026-03-03T14:09:00Z"},
        f"verdict/{LOST}": stale,
    }


def standing(ref: str, rating: float) -> dict[str, Any]:
    return {
        "ref": ref,
        "rating": rating,
        "interval": [rating - 10, rating + 10],
        "score": 0.5,
        "mean_return": None,
        "games": 8,
        "unique_games": 8,
    }


def rated(number: int) -> dict[str, Any]:
    return {
        "ref": f"board@{number}",
        "number": number,
        "made_at": "2026-03-03T14:00:00Z",
        "steps": 1000 * number,
        "parent": None,
        "rating": 100.0 * number,
        "interval": None,
        "games": 8,
        "champion_at": [],
    }
