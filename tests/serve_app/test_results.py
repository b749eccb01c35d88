"""The web pages: the data of a league, and files, which are public and restricted to their own resources."""

import hashlib
import re
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from urllib.parse import urljoin

import pytest
from jsonschema import Draft202012Validator
from starlette.testclient import TestClient

from evaluation.service.snapshots import refresh
from league.registry.registry import Registry
from league.settings import Storage
from serve_app.openapi.document import document
from serve_app.routes.pages import FILES, MEDIA_TYPES
from tests.support.leagues import reported_league, tictactoe
from tests.support.leagues.match_results import EARLIER, LOST, PENDING, RANKED, SCHEDULE, WON, record
from tests.support.leagues.served_leagues import everything, promote
from tests.support.servers.replicas import QUICK, replica

BOARD = "/v1/leagues/board"
OPENAPI = document(QUICK, [])


LISTS = ("leaderboard", "verdicts", "matches", "runs", "aliases/champion/history")
RESOURCES = {
    f"verdicts/{WON}": "unknown_verdict",
    f"matches/{SCHEDULE.id}/0": "unknown_match",
    "runs/first": "unknown_run",
}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Storage:
    storage = Storage.at(tmp_path_factory.mktemp("results"))
    registry = everything(storage)
    record(registry)
    registry.close()
    return storage


@pytest.fixture(scope="module")
def reader(recorded: Storage) -> Iterator[TestClient]:
    with replica(recorded) as client:
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
    rows, before = [], {}
    while before is not None:
        page = get(reader, path, schema, **query, **before)
        rows.append(page[name])
        before = None if page["next"] is None else {"before": page["next"]}
    return rows


def test_leagues_have_a_summary_of_their_activity(reader: TestClient) -> None:
    leagues = {row["league"]: row for row in get(reader, "/v1/leagues", "Leagues")["leagues"]}
    board = leagues["board"]
    assert (board["champion"], board["versions"], board["games"], board["matches"]) == (2, 3, 12, 6)
    verdict = {name: board["last_verdict"][name] for name in ("verdict", "outcome", "promoted", "candidate")}
    assert verdict == {"verdict": WON, "outcome": "promote", "promoted": True, "candidate": "board@2"}
    assert (board["running_evaluations"], board["running_runs"], board["requests"]) == (0, 1, 0)
    assert board["archived_at"] is None
    empty = leagues["empty"]
    assert (empty["champion"], empty["versions"], empty["games"], empty["last_verdict"]) == (None, 0, None, None)
    split = pages(reader, "/v1/leagues", "Leagues", "leagues", limit=3)
    assert [[row["league"] for row in page] for page in split] == [
        list(leagues)[:3],
        list(leagues)[3:6],
        list(leagues)[6:],
    ]


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
    assert [(row["rank"], row["ref"]) for row in page["leaderboard"]] == list(enumerate(RANKED[:3], 1))
    assert (page["total"], page["sides"], page["side"]) == (4, ["player_0", "player_1"], None)
    page = get(reader, f"{BOARD}/leaderboard", "Leaderboard", limit=3, offset=3)
    assert [(row["rank"], row["ref"]) for row in page["leaderboard"]] == [(4, RANKED[3])]
    assert get(reader, f"{BOARD}/leaderboard", "Leaderboard", offset=9)["leaderboard"] == []
    page = get(reader, f"{BOARD}/leaderboard", "Leaderboard", side="player_0")
    assert ([row["ref"] for row in page["leaderboard"]], page["total"]) == (list(RANKED[:2]), 2)
    assert get(reader, f"{BOARD}/leaderboard", "Leaderboard", side="player_1")["total"] == 0


def test_without_snapshots_standings_are_empty(reader: TestClient) -> None:
    memory = "/v1/leagues/memory"
    leaderboard = get(reader, f"{memory}/leaderboard", "Leaderboard")
    assert (leaderboard["computed_at"], leaderboard["leaderboard"], leaderboard["sides"]) == (None, [], [])
    assert get(reader, f"{memory}/payoff", "PayoffTable")["payoff"] is None
    assert get(reader, f"{memory}/ratings", "Ratings")["versions"] == []
    for path, schema, name in (
        ("verdicts", "Verdicts", "verdicts"),
        ("matches", "Matches", "matches"),
        ("runs", "Runs", "runs"),
        ("training-nights", "TrainingNights", "training_nights"),
        ("nightly-runs", "NightlyRuns", "nightly_runs"),
    ):
        assert get(reader, f"{memory}/{path}", schema)[name] == []


def test_payoff_and_ratings_are_those_of_the_snapshots(reader: TestClient) -> None:
    payoff = get(reader, f"{BOARD}/payoff", "PayoffTable")["payoff"]
    assert payoff["score"] == [[None, 0.75], [0.25, None]]
    assert [share["ref"] for share in payoff["shares"]] == ["board@2"]
    assert [row["number"] for row in get(reader, f"{BOARD}/ratings", "Ratings")["versions"]] == [1, 2, 3]


def test_verdicts_are_listed_newest_first(reader: TestClient) -> None:
    (verdicts,) = pages(reader, f"{BOARD}/verdicts", "Verdicts", "verdicts")
    assert [(row["verdict"], row["outcome"], row["promoted"], row["llr"], row["reason"]) for row in verdicts] == [
        (PENDING, "open", False, None, None),
        (WON, "promote", True, 2.97, "It is the stronger one."),
        (LOST, "reject", False, -3.0, None),  # its reason is outdated
    ]
    split = pages(reader, f"{BOARD}/verdicts", "Verdicts", "verdicts", limit=2)
    assert split == [verdicts[:2], verdicts[2:]]


def test_a_verdict_has_its_curve_once_computed_and_the_name_of_an_earlier_game(reader: TestClient) -> None:
    lost, won, pending = (get(reader, f"{BOARD}/verdicts/{verdict}", "Verdict") for verdict in (LOST, WON, PENDING))
    assert (won["outcome"], won["curve"][-1], won["counts"][-1]) == ("promote", [41, 0.07 * 41], 15)
    assert won["reason"] == "It is the stronger one."
    assert (pending["outcome"], pending["computed_at"], pending["reason"]) == ("open", None, None)
    assert (lost["outcome"], lost["reason"]) == ("reject", None), "an outdated reason is omitted"
    assert [verdict["earlier_game"] for verdict in (lost, won, pending)] == [EARLIER, None, None]


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


def test_matches_of_another_game_are_listed_but_not_counted(recorded: Storage, reader: TestClient) -> None:
    with closing(Registry.open(recorded)) as registry:
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
    both = [pages(reader, f"{BOARD}/matches", "Matches", "matches", limit=2, **way) for way in queries]
    assert both[0] == both[1]
    assert [match["contestants"] for page in both[0] for match in page] == [["board@1", "board@2"]] * 3
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
    assert [[row["run"] for row in page] for page in pages_of_runs] == [["exploiter"], ["second"], ["first"]]
    exploiter, _, first = (page[0] for page in pages_of_runs)
    assert [(run["role"], run["exploits"]) for run in (exploiter, first)] == [("exploiter", "board@2"), ("main", None)]
    assert (first["state"], first["error"], first["steps"]) == ("failed", "the environment raised", 200)
    assert first["curves"] == {"return": 0.2, "shared/entropy": 1.5}


def test_a_run_has_its_curves_and_the_strength_of_its_versions(reader: TestClient) -> None:
    run = get(reader, f"{BOARD}/runs/first", "Run")
    assert [(point["steps"], point["curves"]["return"]) for point in run["points"]] == [(100, 0.1), (200, 0.2)]
    assert run["settings"] == {"lr": 0.001, "minutes": 10}
    assert (run["seconds"], run["target"], run["minutes"]) == (20.0, 1000, 10.0)
    (strength,) = run["strength"]
    assert (strength["version"], strength["opponent"], strength["games"]) == (2, "board@1", 40)
    assert (strength["score"], strength["low"], strength["high"]) == (0.625, 0.5, 0.75)
    assert get(reader, f"{BOARD}/runs/second", "Run")["strength"] == []


def test_nights_have_the_strength_and_the_exploitability_of_their_champions(reader: TestClient) -> None:
    (open_night,), (night,) = pages(reader, f"{BOARD}/training-nights", "TrainingNights", "training_nights", limit=1)
    assert (night["versions"], night["champion_before"], night["champion"]) == (["board@2"], "board@1", "board@2")
    assert [(row["number"], row["parent"]) for row in (open_night, night)] == [(2, 2), (1, 3)]
    assert (night["rating"], night["errors"]) == (200.0, ["exploiter: the disk is full"])
    expected = {"bound": 0.625, "exploiter": "board@3", "games": 64, "score": 0.75, "low": 0.625, "high": 0.875}
    assert night["exploitability"] == expected | {"gain": {"mean": 1.5, "low": 0.5, "high": 2.5}}
    unknown = {name: open_night[name] for name in ("champion", "rating", "exploitability", "ended_at")}
    assert unknown == dict.fromkeys(unknown), "its steps are not complete"
    assert open_night["versions"] == []


def test_nightly_runs_have_their_verdicts(reader: TestClient) -> None:
    (open_run,), (run,) = pages(reader, f"{BOARD}/nightly-runs", "NightlyRuns", "nightly_runs", limit=1)
    assert (run["candidates"], run["champion_before"], run["champion"]) == (["board@2"], "board@1", "board@2")
    assert [(row["candidate"], row["outcome"], row["promoted"]) for row in run["verdicts"]] == [
        ("board@2", "promote", True)
    ]
    assert run["errors"] == ["board@3: its file is missing"]
    assert (open_run["candidates"], open_run["verdicts"]) == (["board@3"], [])
    assert open_run["ended_at"] is None


def test_results_of_an_earlier_game_stay_viewable(reader: TestClient) -> None:
    (earlier,) = get(reader, BOARD, "League")["summary"]["earlier"]
    assert (earlier["name"], earlier["matches"]) == (EARLIER, 3)
    page = get(reader, f"{BOARD}/leaderboard", "Leaderboard", game=EARLIER)
    assert [row["ref"] for row in page["leaderboard"]] == [RANKED[1]]
    assert get(reader, f"{BOARD}/payoff", "PayoffTable", game=EARLIER)["payoff"] is None


def test_the_history_has_the_champion_at_each_time(reader: TestClient) -> None:
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
        page = get(reader, path, "History", at=instant.isoformat())
        assert ([event["version"] for event in page["history"]], page["next"]) == (expected, None)
    assert get(reader, f"{BOARD}/aliases/candidate/history", "History")["history"] == []


def test_versions_are_paginated_newest_first(reader: TestClient) -> None:
    pages_of_versions = pages(reader, f"{BOARD}/versions", "Versions", "versions", limit=2)
    assert [[row["version"] for row in page] for page in pages_of_versions] == [[3, 2], [1]]
    assert [row["version"] for row in get(reader, f"{BOARD}/versions", "Versions")["versions"]] == [1, 2, 3]


INVALID = (
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
    ("payoff?game=x", f"game must be one of {EARLIER}, got 'x'"),
    *((f"{name}?limit=201", "limit must be an integer from 1 to 200") for name in LISTS),
    ("/v1/leagues/memory/leaderboard?game=x", "memory has no results of an earlier game, got 'x'"),
    ("/v1/leagues/memory/leaderboard?side=agent_shared", "no side of memory has its own leaderboard"),
    ("/v1/leagues?limit=0", "limit"),
)


def test_invalid_queries_are_rejected(reader: TestClient, subtests: pytest.Subtests) -> None:
    for query, message in INVALID:
        with subtests.test(query):
            reply = reader.get(urljoin(f"{BOARD}/", query))
            assert (reply.status_code, message in reply.json()["message"]) == (400, True), reply.text
    assert [reader.get(f"{BOARD}/{name}?limit=200").status_code for name in LISTS] == [200] * len(LISTS)


UNKNOWN = (
    *((f"/v1/leagues/nobody/{path}", "unknown_league") for path in (*LISTS, "payoff", "ratings", *RESOURCES)),
    (f"{BOARD}/verdicts/nothing", "unknown_verdict"),
    (f"{BOARD}/verdicts/%00", "unknown_verdict"),
    (f"{BOARD}/matches/nothing/0", "unknown_match"),
    (f"{BOARD}/matches/{SCHEDULE.id}/6", "unknown_match"),
    (f"{BOARD}/matches/{SCHEDULE.id}/x", "unknown_match"),
    (f"{BOARD}/matches/{SCHEDULE.id}/99999999999999999999", "unknown_match"),
    (f"{BOARD}/runs/nothing", "unknown_run"),
    (f"{BOARD}/runs/%00", "unknown_run"),
    # A key may be limited to one league.
    *((f"/v1/leagues/memory/{path}", code) for path, code in RESOURCES.items()),
)


def test_unknown_resources_are_reported(reader: TestClient, subtests: pytest.Subtests) -> None:
    for path, code in UNKNOWN:
        with subtests.test(path):
            reply = reader.get(path)
            assert (reply.status_code, reply.json()["code"]) == (404, code)


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
        assert [row["verdict"] for row in listed] == verdicts[::-1]
        for row in listed:
            verdict = get(night, f"{league}/verdicts/{row['verdict']}", "Verdict")
            assert verdict["curve"]
            assert verdict["reason"] == row["reason"]
            assert {name: verdict[name] for name in row} == row
        match = get(night, f"{league}/matches", "Matches", limit=1)["matches"][0]
        games = get(night, f"{league}/matches/{match['match']}", "MatchWithGames")["games"]
        assert [list(game["sides"].values()) for game in games] == [match["contestants"], match["contestants"][::-1]]


PAGE_FILES = [path for path in FILES.iterdir() if path.suffix in MEDIA_TYPES]
SCRIPTS = [path for path in PAGE_FILES if path.suffix == ".js"]


def test_all_pages_are_the_same_document_whose_references_hold_below_any_prefix(
    read_only_client: TestClient, subtests: pytest.Subtests
) -> None:
    document, reference = (FILES / "index.html").read_text(), r'(?<=href="|.src=")'
    for path in (
        *("/", "/leagues", "/leagues/", "/leagues/board", "/leagues/nowhere/verdicts/%3Cb%3E", "/leagues/a%2F..%2Fb"),
        "/leagues/b/matches/s/0/1",
    ):
        reply = read_only_client.get(path)  # as a proxy sends it that has removed the prefix
        assert (reply.status_code, reply.headers["content-type"]) == (200, "text/html; charset=utf-8")
        for prefix in ("", "/ai", "/very/long"):
            with subtests.test(path, prefix=prefix):
                url = f"http://host{prefix}"
                page = re.sub(reference + r'[^"]+', lambda match, at=url + path: urljoin(at, match[0]), reply.text)
                assert page == re.sub(reference + "/", f"{url}/", document)
    assert read_only_client.get("/leagues" + "/a" * 20).status_code == 404, "too many slashes"


def test_redirects_are_relative(read_only_client: TestClient) -> None:
    for path, target in (("/docs/", "/docs"), ("/v1/leagues/?limit=1", "/v1/leagues?limit=1")):
        reply = read_only_client.get(path, follow_redirects=False)
        assert reply.status_code == 307
        assert urljoin(f"https://host/ai{path}", reply.headers["location"]) == f"https://host/ai{target}"
        assert read_only_client.get(path).status_code == 200
    assert read_only_client.get("/nothing/").status_code == 404


def test_the_content_security_policy_allows_own_resources_only(read_only_client: TestClient) -> None:
    for path in ("/", "/pages/app.js"):
        headers = read_only_client.get(path).headers
        rules = dict(rule.split(" ", 1) for rule in headers["content-security-policy"].split("; "))
        assert rules["default-src"] == rules["base-uri"] == rules["form-action"] == rules["frame-ancestors"] == "'none'"
        assert rules["script-src"] == rules["style-src"] == rules["connect-src"] == "'self'"
        assert rules["img-src"] == "'self' data: blob:"
        assert headers["referrer-policy"] == "no-referrer"


def test_all_files_and_no_others_are_sent_unmodified(read_only_client: TestClient, subtests: pytest.Subtests) -> None:
    assert SCRIPTS
    for path in PAGE_FILES:
        for encoding in ("identity", "gzip"):
            with subtests.test(path.name, encoding=encoding):
                reply = read_only_client.get(f"/pages/{path.name}", headers={"accept-encoding": encoding})
                assert (reply.status_code, reply.content) == (200, path.read_bytes())
                assert reply.headers["content-type"].startswith(MEDIA_TYPES[path.suffix])
                is_zipped = encoding == "gzip" and path.stat().st_size >= 1024
                assert reply.headers.get("content-encoding") == ("gzip" if is_zipped else None)
    for name in ("nothing.js", "vendor", "vendor/LICENSE.htm", "../app.py", "..%2Fapp.py", ""):
        reply = read_only_client.get(f"/pages/{name}")
        assert (reply.status_code, reply.json()["code"]) == (404, "unknown_path"), name


def test_an_unmodified_file_is_not_sent_again(read_only_client: TestClient) -> None:
    first = read_only_client.get("/pages/app.js")
    assert first.headers["cache-control"] == "no-cache"
    second = read_only_client.get("/pages/app.js", headers={"if-none-match": f'W/"other", {first.headers["etag"]}'})
    assert (second.status_code, second.content) == (304, b"")
    assert read_only_client.get("/pages/app.js", headers={"if-none-match": 'W/"other"'}).status_code == 200


def test_the_document_refers_to_existing_files_and_has_no_inline_code() -> None:
    text = (FILES / "index.html").read_text()
    files = re.findall(r'(?:href|src)="/pages/([^"]+)"', text)
    assert files
    assert all((FILES / name).is_file() for name in files)
    assert not re.findall(r"<style|style=|\son\w+=|<script>", text)


def test_scripts_insert_no_html_and_import_existing_files_and_charts_name_their_axes() -> None:
    forbidden = r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(|new Function|https?://"
    charts: list[str] = []
    for path in SCRIPTS:
        text = path.read_text()
        assert not re.findall(forbidden, text), path
        imported = re.findall(r'(?:from |import\()"(.+?)"', text)
        assert [name for name in imported if not (path.parent / name).is_file()] == [], path
        charts += re.findall(r"<\$\{Chart\} (.+?)/>", text, re.DOTALL)
    assert charts
    assert [chart for chart in charts if "xName=" not in chart or "yName=" not in chart] == []


def test_vendored_files_have_their_licence_and_are_those_of_their_packages() -> None:
    vendor = FILES / "vendor"
    readme = (vendor / "README.md").read_text()
    assert [path.name for path in vendor.iterdir() if path.name != "README.md" and f"`{path.name}`" not in readme] == []
    recorded = dict(re.findall(r"^([0-9a-f]{64})  (\S+)$", readme, re.MULTILINE))
    assert {hashlib.sha256(path.read_bytes()).hexdigest(): path.name for path in vendor.glob("*.*s")} == recorded
