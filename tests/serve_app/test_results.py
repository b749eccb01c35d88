"""The data for web pages of a league: leaderboard, verdicts, matches, training runs, alias history."""

from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator
from starlette.testclient import TestClient

from evaluation.service.snapshots import refresh
from league.registry.registry import Registry
from league.settings import Storage
from serve_app.openapi.document import document
from tests.support.leagues import reported_league, tictactoe
from tests.support.leagues.match_results import EARLIER, LOST, PENDING, RANKED, SCHEDULE, WON, record
from tests.support.leagues.served_leagues import everything, promote
from tests.support.servers.replicas import QUICK, replica

BOARD = "/v1/leagues/board"
OPENAPI = document(QUICK, [])


@pytest.fixture(scope="module")
def storage(tmp_path_factory: pytest.TempPathFactory) -> Storage:
    storage = Storage.at(tmp_path_factory.mktemp("results"))
    registry = everything(storage)
    record(registry)
    registry.close()
    return storage


@pytest.fixture(scope="module")
def reader(storage: Storage) -> Iterator[TestClient]:
    with replica(storage) as client:
        yield client


def get(reader: TestClient, path: str, schema: str, **query: Any) -> dict[str, Any]:
    """A response, validated with its schema."""
    reply = reader.get(path, params=query)
    assert reply.status_code == 200, reply.text
    described = {"$ref": f"#/components/schemas/{schema}", "components": OPENAPI["components"]}
    Draft202012Validator(described).validate(reply.json())
    return dict(reply.json())


def pages(reader: TestClient, path: str, schema: str, name: str, **query: Any) -> list[list[Any]]:
    """All pages of a list."""
    found, before = [], {}
    while before is not None:
        page = get(reader, path, schema, **query, **before)
        found.append(page[name])
        before = None if page["next"] is None else {"before": page["next"]}
    return found


def test_leagues_have_a_summary_of_their_activity(reader: TestClient) -> None:
    reported_league = {each["league"]: each for each in get(reader, "/v1/leagues", "Leagues")["leagues"]}
    board = reported_league["board"]
    assert (board["champion"], board["versions"], board["games"], board["matches"]) == (2, 3, 12, 6)
    verdict = {name: board["last_verdict"][name] for name in ("verdict", "outcome", "promoted", "candidate")}
    assert verdict == {"verdict": WON, "outcome": "promote", "promoted": True, "candidate": "board@2"}
    assert (board["running_evaluations"], board["running_runs"], board["requests"]) == (0, 1, 0)
    assert board["archived_at"] is None
    empty = reported_league["empty"]
    assert (empty["champion"], empty["versions"], empty["games"], empty["last_verdict"]) == (None, 0, None, None)


def test_leagues_are_paginated(reader: TestClient) -> None:
    expected = [each["league"] for each in get(reader, "/v1/leagues", "Leagues")["leagues"]]
    found = pages(reader, "/v1/leagues", "Leagues", "leagues", limit=3)
    assert [len(page) for page in found] == [3, 3, 1]
    assert [each["league"] for page in found for each in page] == expected
    assert reader.get("/v1/leagues", params={"limit": 0}).json()["code"] == "invalid_input"


def test_a_league_has_the_time_of_its_standings(reader: TestClient) -> None:
    board = get(reader, BOARD, "League")
    assert (board["summary"]["games"], board["up_to_date"]) == (12, True)
    assert [upset["better"] for upset in board["summary"]["upsets"]] == ["board@1"]
    assert datetime.fromisoformat(board["computed_at"]) <= datetime.now(UTC)
    assert board["traffic"]["canary"] is None
    memory = get(reader, "/v1/leagues/memory", "League")
    assert (memory["summary"], memory["computed_at"], memory["up_to_date"]) == (None, None, False)


def test_changes_since_then_are_indicated(client: TestClient, registry: Registry) -> None:
    record(registry)
    assert client.get(BOARD).json()["up_to_date"]
    promote(registry, "board", 3)
    assert not client.get(BOARD).json()["up_to_date"]


def test_standings_are_paginated_by_rank(reader: TestClient) -> None:
    page = get(reader, f"{BOARD}/leaderboard", "Leaderboard", limit=3)
    assert [(each["rank"], each["ref"]) for each in page["leaderboard"]] == list(enumerate(RANKED[:3], 1))
    assert (page["total"], page["sides"], page["side"]) == (4, ["player_0", "player_1"], None)
    rest = get(reader, f"{BOARD}/leaderboard", "Leaderboard", limit=3, offset=3)
    assert [(each["rank"], each["ref"]) for each in rest["leaderboard"]] == [(4, RANKED[3])]
    assert get(reader, f"{BOARD}/leaderboard", "Leaderboard", offset=9)["leaderboard"] == []


def test_standings_of_one_side(reader: TestClient) -> None:
    page = get(reader, f"{BOARD}/leaderboard", "Leaderboard", side="player_0")
    assert ([each["ref"] for each in page["leaderboard"]], page["total"]) == (list(RANKED[:2]), 2)
    assert get(reader, f"{BOARD}/leaderboard", "Leaderboard", side="player_1")["total"] == 0


def test_without_snapshots_standings_are_empty(reader: TestClient) -> None:
    memory = "/v1/leagues/memory"
    leaderboard = get(reader, f"{memory}/leaderboard", "Leaderboard")
    assert (leaderboard["computed_at"], leaderboard["leaderboard"], leaderboard["sides"]) == (None, [], [])
    rejected = reader.get(f"{memory}/leaderboard", params={"side": "agent_shared"})
    assert "no side of memory has its own leaderboard" in rejected.json()["message"]
    assert get(reader, f"{memory}/payoff", "PayoffTable")["payoff"] is None
    assert get(reader, f"{memory}/ratings", "Ratings")["versions"] == []
    for name, schema in (("verdicts", "Verdicts"), ("matches", "Matches"), ("runs", "Runs")):
        assert get(reader, f"{memory}/{name}", schema)[name] == []


def test_payoff_and_ratings_are_those_of_the_snapshots(reader: TestClient) -> None:
    payoff = get(reader, f"{BOARD}/payoff", "PayoffTable")["payoff"]
    assert payoff["score"] == [[None, 0.75], [0.25, None]]
    assert [share["ref"] for share in payoff["shares"]] == ["board@2"]
    assert [each["number"] for each in get(reader, f"{BOARD}/ratings", "Ratings")["versions"]] == [1, 2, 3]


def test_verdicts_are_listed_newest_first(reader: TestClient) -> None:
    (verdicts,) = pages(reader, f"{BOARD}/verdicts", "Verdicts", "verdicts")
    assert [each["verdict"] for each in verdicts] == [PENDING, WON, LOST]
    assert [(each["outcome"], each["promoted"]) for each in verdicts] == [
        ("open", False),
        ("promote", True),
        ("reject", False),
    ]
    assert [each["llr"] for each in verdicts] == [None, 2.97, -3.0]
    assert verdicts[1]["reason"] == "It is the stronger one."
    split = pages(reader, f"{BOARD}/verdicts", "Verdicts", "verdicts", limit=2)
    assert [[each["verdict"] for each in page] for page in split] == [[PENDING, WON], [LOST]]


def test_a_verdict_has_its_curve_once_computed(reader: TestClient) -> None:
    won = get(reader, f"{BOARD}/verdicts/{WON}", "Verdict")
    assert (won["outcome"], won["curve"][-1], won["counts"][-1]) == ("promote", [41, 0.07 * 41], 15)
    assert won["reason"] == "It is the stronger one."
    pending = get(reader, f"{BOARD}/verdicts/{PENDING}", "Verdict")
    assert (pending["outcome"], pending["computed_at"], pending["reason"]) == ("open", None, None)


def test_a_verdict_of_an_earlier_game_names_it(reader: TestClient) -> None:
    found = [get(reader, f"{BOARD}/verdicts/{each}", "Verdict")["earlier_game"] for each in (LOST, WON, PENDING)]
    assert found == [EARLIER, None, None]


def test_an_outdated_reason_of_a_verdict_is_omitted(reader: TestClient) -> None:
    lost = get(reader, f"{BOARD}/verdicts/{LOST}", "Verdict")
    assert (lost["outcome"], lost["reason"]) == ("reject", None)
    (verdicts,) = pages(reader, f"{BOARD}/verdicts", "Verdicts", "verdicts")
    assert verdicts[2]["reason"] is None


def test_matches_are_listed_newest_first(reader: TestClient) -> None:
    pages_of_matches = pages(reader, f"{BOARD}/matches", "Matches", "matches", limit=3)
    assert [len(page) for page in pages_of_matches] == [3, 3, 1]
    matches = [match for page in pages_of_matches for match in page]
    assert [match["match"] for match in matches[1:]] == [SCHEDULE.match_id(at) for at in reversed(range(6))]
    assert (matches[0]["kind"], matches[0]["counts"]) == ("gauntlet", False)
    newest = matches[1]
    assert newest["contestants"] == ["board@2", "script:random"]
    assert (newest["scores"], newest["returns"], newest["games"]) == ([1.5, 0.5], None, 2)
    assert (matches[2]["returns"], matches[2]["counts"]) == ([1.25, -0.75], True)


def test_matches_of_another_game_are_listed_but_not_counted(storage: Storage, reader: TestClient) -> None:
    with closing(Registry.open(storage)) as registry:
        row = registry.leagues.get("board")
        play = row.config.play.model_copy(update={"opening_plies": 3})
        registry.leagues.register(row.config.model_copy(update={"play": play}), row.interface)
        try:
            matches = get(reader, f"{BOARD}/matches", "Matches")["matches"]
        finally:
            registry.leagues.register(row.config, row.interface)
    assert len(matches) == 7
    assert not any(match["counts"] for match in matches)


def test_matches_of_a_pair_are_listed_in_either_order(reader: TestClient) -> None:
    queries = [{"first": "board@1", "second": "board@2"}, {"first": "board@2", "second": "board@1"}]
    found = [pages(reader, f"{BOARD}/matches", "Matches", "matches", limit=2, **way) for way in queries]
    assert found[0] == found[1]
    assert [match["contestants"] for page in found[0] for match in page] == [["board@1", "board@2"]] * 3
    assert get(reader, f"{BOARD}/matches", "Matches", first="board@1", second="nobody")["matches"] == []


def test_a_match_has_its_games(reader: TestClient) -> None:
    match = get(reader, f"{BOARD}/matches/{SCHEDULE.id}/5", "MatchWithGames")
    assert (match["contestants"], match["kind"]) == (["board@2", "script:random"], "round_robin")
    first, second = match["games"]
    assert first["sides"] == {"player_0": "board@2", "player_1": "script:random"}
    assert second["sides"] == {"player_0": "script:random", "player_1": "board@2"}
    assert (first["scores"], first["returns"], first["opening"], first["actions"]) == ([1.0, 0.0], [1.0, -1.0], 2, 3)
    assert first["forfeits"] == [{"ref": "script:random", "agent": "player_1", "reason": "illegal_action"}]
    assert second["forfeits"] == []


def test_runs_are_listed_newest_first(reader: TestClient) -> None:
    pages_of_runs = pages(reader, f"{BOARD}/runs", "Runs", "runs", limit=1)
    assert [[each["run"] for each in page] for page in pages_of_runs] == [["exploiter"], ["second"], ["first"]]
    exploiter, _, first = (page[0] for page in pages_of_runs)
    assert [(run["role"], run["exploits"]) for run in (exploiter, first)] == [("exploiter", "board@2"), ("main", None)]
    assert (first["state"], first["error"], first["steps"]) == ("failed", "the environment raised", 200)
    assert first["curves"] == {"return": 0.2, "shared/entropy": 1.5}


def test_a_run_has_its_curves(reader: TestClient) -> None:
    run = get(reader, f"{BOARD}/runs/first", "Run")
    assert [(point["steps"], point["curves"]["return"]) for point in run["points"]] == [(100, 0.1), (200, 0.2)]
    assert (run["settings"], run["seconds"], run["target"], run["minutes"]) == (
        {"lr": 0.001, "minutes": 10},
        20.0,
        1000,
        10.0,
    )


def test_a_run_has_the_strength_of_its_versions(reader: TestClient) -> None:
    (strength,) = get(reader, f"{BOARD}/runs/first", "Run")["strength"]
    assert (strength["version"], strength["opponent"], strength["games"]) == (2, "board@1", 40)
    assert (strength["score"], strength["low"], strength["high"]) == (0.625, 0.5, 0.75)
    assert get(reader, f"{BOARD}/runs/second", "Run")["strength"] == []


def test_nights_have_the_strength_and_the_exploitability_of_their_champions(reader: TestClient) -> None:
    (open_night,), (night,) = pages(reader, f"{BOARD}/training-nights", "TrainingNights", "training_nights", limit=1)
    assert (night["versions"], night["champion_before"], night["champion"]) == (["board@2"], "board@1", "board@2")
    assert [(each["number"], each["parent"]) for each in (open_night, night)] == [(2, 2), (1, 3)]
    assert (night["rating"], night["errors"]) == (200.0, ["exploiter: the disk is full"])
    expected = {"bound": 0.625, "exploiter": "board@3", "games": 64, "score": 0.75, "low": 0.625, "high": 0.875}
    assert night["exploitability"] == expected | {"gain": {"mean": 1.5, "low": 0.5, "high": 2.5}}
    unknown = {name: open_night[name] for name in ("champion", "rating", "exploitability", "ended_at")}
    assert unknown == dict.fromkeys(unknown), "its steps are not complete"
    assert open_night["versions"] == []
    assert get(reader, "/v1/leagues/memory/training-nights", "TrainingNights")["training_nights"] == []


def test_nightly_runs_have_their_verdicts(reader: TestClient) -> None:
    assert get(reader, "/v1/leagues/memory/nightly-runs", "NightlyRuns")["nightly_runs"] == []
    (open_run,), (run,) = pages(reader, f"{BOARD}/nightly-runs", "NightlyRuns", "nightly_runs", limit=1)
    assert (run["candidates"], run["champion_before"], run["champion"]) == (["board@2"], "board@1", "board@2")
    assert [(each["candidate"], each["outcome"], each["promoted"]) for each in run["verdicts"]] == [
        ("board@2", "promote", True)
    ]
    assert run["errors"] == ["board@3: its file is missing"]
    assert (open_run["candidates"], open_run["verdicts"]) == (["board@3"], [])
    assert open_run["ended_at"] is None


def test_results_of_an_earlier_game_stay_viewable(reader: TestClient) -> None:
    (earlier,) = get(reader, BOARD, "League")["summary"]["earlier"]
    assert (earlier["name"], earlier["matches"]) == (EARLIER, 3)
    page = get(reader, f"{BOARD}/leaderboard", "Leaderboard", game=EARLIER)
    assert [each["ref"] for each in page["leaderboard"]] == [RANKED[1]]
    assert get(reader, f"{BOARD}/payoff", "PayoffTable", game=EARLIER)["payoff"] is None
    for path, message in (
        (f"{BOARD}/payoff", f"game must be one of {EARLIER}, got 'x'"),
        ("/v1/leagues/memory/leaderboard", "memory has no results of an earlier game, got 'x'"),
    ):
        rejected = reader.get(path, params={"game": "x"})
        assert (rejected.status_code, rejected.json()["message"]) == (400, message)


def test_the_history_has_the_champion_at_each_time(reader: TestClient, storage: Storage) -> None:
    path = f"{BOARD}/aliases/champion/history"
    (events,) = pages(reader, path, "History", "history")
    assert [(event["version"], event["verdict"], event["actor"]) for event in events] == [
        (2, WON, "league nightly"),
        (1, None, "test"),
    ]
    assert [len(page) for page in pages(reader, path, "History", "history", limit=1)] == [1, 1]
    moved, first = (datetime.fromisoformat(event["at"]) for event in events)
    for instant, expected in (
        (moved, [2]),
        (moved - timedelta(microseconds=1), [1]),
        (datetime.now(UTC) + timedelta(days=1), [2]),
        (first - timedelta(microseconds=1), []),
    ):
        found = get(reader, path, "History", at=instant.isoformat())
        assert ([event["version"] for event in found["history"]], found["next"]) == (expected, None)
    assert get(reader, f"{BOARD}/aliases/candidate/history", "History")["history"] == []


def test_versions_are_paginated_newest_first(reader: TestClient) -> None:
    pages_of_versions = pages(reader, f"{BOARD}/versions", "Versions", "versions", limit=2)
    assert [[each["version"] for each in page] for page in pages_of_versions] == [[3, 2], [1]]
    assert [each["version"] for each in get(reader, f"{BOARD}/versions", "Versions")["versions"]] == [1, 2, 3]


def test_the_size_of_a_page_is_limited(reader: TestClient) -> None:
    for name in ("leaderboard", "verdicts", "matches", "runs", "aliases/champion/history"):
        assert reader.get(f"{BOARD}/{name}", params={"limit": 200}).status_code == 200
        assert reader.get(f"{BOARD}/{name}", params={"limit": 201}).json()["code"] == "invalid_input"


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("leaderboard?limit=0", "limit must be an integer from 1 to 200, got '0'"),
        ("leaderboard?offset=-1", "offset must be an integer from 0"),
        ("leaderboard?side=nobody", "side must be one of player_0, player_1, got 'nobody'"),
        ("leaderboard?side=", "side must be 1 to 300 printable characters"),
        ("verdicts?limit=x", "limit"),
        ("verdicts?before=nothing", "before: league board has no verdict 'nothing'"),
        ("matches?before=nothing", "before: league board has no match 'nothing'"),
        ("matches?before=%00", "before must be 1 to 300 printable characters"),
        ("matches?first=board@1", "first and second must be given together"),
        ("runs?before=nothing", "before: league board has no training run 'nothing'"),
        ("versions?before=x", "before must be an integer from 1"),
        ("aliases/champion/history?before=0", "before must be an integer from 1"),
        ("aliases/champion/history?at=yesterday", "at must be a time with a time zone"),
        ("aliases/champion/history?at=2026-03-03T14:00:00", "at must be a time with a time zone"),
        ("aliases/champion/history?at=0001-01-01T00:00:00%2B05:00", "at must be a time"),
        ("aliases/champion/history?at=2026-03-03T14:00:00Z&before=3", "mutually exclusive"),
        ("aliases/7/history", "7"),
    ],
)
def test_invalid_queries_are_rejected(reader: TestClient, query: str, message: str) -> None:
    reply = reader.get(f"{BOARD}/{query}")
    assert reply.status_code == 400, reply.text
    assert message in reply.json()["message"]


@pytest.mark.parametrize(
    ("path", "code"),
    [
        ("/v1/leagues/nobody/leaderboard", "unknown_league"),
        ("/v1/leagues/nobody/payoff", "unknown_league"),
        ("/v1/leagues/nobody/ratings", "unknown_league"),
        ("/v1/leagues/nobody/verdicts", "unknown_league"),
        (f"/v1/leagues/nobody/verdicts/{WON}", "unknown_league"),
        ("/v1/leagues/nobody/matches", "unknown_league"),
        (f"/v1/leagues/nobody/matches/{SCHEDULE.id}/0", "unknown_league"),
        ("/v1/leagues/nobody/runs", "unknown_league"),
        ("/v1/leagues/nobody/runs/first", "unknown_league"),
        ("/v1/leagues/nobody/aliases/champion/history", "unknown_league"),
        (f"{BOARD}/verdicts/nothing", "unknown_verdict"),
        (f"{BOARD}/verdicts/%00", "unknown_verdict"),
        (f"{BOARD}/matches/nothing/0", "unknown_match"),
        (f"{BOARD}/matches/{SCHEDULE.id}/6", "unknown_match"),
        (f"{BOARD}/matches/{SCHEDULE.id}/x", "unknown_match"),
        (f"{BOARD}/matches/{SCHEDULE.id}/99999999999999999999", "unknown_match"),
        (f"{BOARD}/runs/nothing", "unknown_run"),
        (f"{BOARD}/runs/%00", "unknown_run"),
    ],
)
def test_unknown_resources_are_reported(reader: TestClient, path: str, code: str) -> None:
    reply = reader.get(path)
    assert (reply.status_code, reply.json()["code"]) == (404, code)


@pytest.mark.parametrize(
    "path", [f"verdicts/{WON}", f"matches/{SCHEDULE.id}/0", "runs/first"], ids=["verdict", "match", "run"]
)
def test_resources_of_another_league_are_not_shown(reader: TestClient, path: str) -> None:
    """A key may be limited to one league."""
    reply = reader.get(f"/v1/leagues/memory/{path}")
    assert reply.status_code == 404, reply.text


def test_responses_after_a_nightly_run_follow_the_document(tmp_path: Path) -> None:
    with reported_league.league_after_nightly(tmp_path / "home") as registry:
        refresh(registry, tictactoe.LEAGUE)
        verdicts = [row.id for row in registry.verdicts.all(tictactoe.LEAGUE)]
        storage = registry.storage
    league = f"/v1/leagues/{tictactoe.LEAGUE}"
    with replica(storage) as night:
        assert get(night, league, "League")["up_to_date"]
        assert get(night, f"{league}/leaderboard", "Leaderboard")["total"] > 2
        assert get(night, f"{league}/payoff", "PayoffTable")["payoff"]["contestants"]
        assert get(night, f"{league}/ratings", "Ratings")["versions"]
        assert any(event["verdict"] for event in get(night, f"{league}/aliases/champion/history", "History")["history"])
        (listed,) = pages(night, f"{league}/verdicts", "Verdicts", "verdicts")
        assert [each["verdict"] for each in listed] == verdicts[::-1]
        for each in listed:
            verdict = get(night, f"{league}/verdicts/{each['verdict']}", "Verdict")
            assert verdict["curve"]
            assert verdict["reason"] == each["reason"]
            assert {name: verdict[name] for name in each} == each
        match = get(night, f"{league}/matches", "Matches", limit=1)["matches"][0]
        games = get(night, f"{league}/matches/{match['match']}", "MatchWithGames")["games"]
        assert [list(game["sides"].values()) for game in games] == [match["contestants"], match["contestants"][::-1]]
