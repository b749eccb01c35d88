"""What a report of a league contains: the documents of its HTTP API, from the same code that responds on a server.

With the web pages, they are one HTML file.
"""

from __future__ import annotations

import asyncio
import re
import time
from base64 import b64encode
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from secrets import token_urlsafe
from typing import Any

import httpx
import orjson

from evaluation.documents import iso_timestamp
from evaluation.matches.leaderboard import MOST_CONTESTANTS
from evaluation.service.game_worker import GameWorker
from evaluation.service.snapshots import refresh
from league.errors import AlreadyRunning
from league.refs import CHAMPION
from league.registry.registry import Registry
from league.service_requests import GameRequest, GameResponse
from serve_app.app import Replica
from serve_app.routes.pages import DOCUMENT, FILES, MEDIA_TYPES
from serve_app.settings import ServeSettings

MAX_PAGE = 200
"""Rows of a page, as many as the API returns."""
MOST_VERDICTS = 200
"""Verdicts with their evidence, the newest ones."""
MOST_BYTES = 3_000_000
"""Total size of all recorded games."""
PATIENCE = 3600.0
"""Timeout of a request, in seconds: an environment may need minutes to render a game."""
RETRY = 0.2
"""Seconds between two attempts while another process computes the results."""


def league_report(registry: Registry, league: str) -> dict[str, Any]:
    """Return the report of a league, `{"league", "made_at", "documents"}`.

    Documents are by their paths in the API, with the parameter `side` only: lists are whole. They are empty where a
    server has replicas, traffic, or results of earlier games.

    Raises UnknownLeague or StorageError.
    """
    while True:
        try:
            refresh(registry, league)
            break
        except AlreadyRunning:
            time.sleep(RETRY)
    replica = Replica(
        registry,
        ServeSettings(require_keys="never", timeout=PATIENCE),
        "report",
        evaluation_client=_RecordedGames(GameWorker(league, registry)),
    )
    try:
        made_at = iso_timestamp(datetime.now(UTC))
        documents = asyncio.run(_documents(replica, f"/v1/leagues/{league}"))
    finally:
        replica.models.close()
        replica.connection.close()
    return {"league": league, "made_at": made_at, "documents": documents}


class _RecordedGames:
    """Replays recorded games in this process instead of an evaluation service."""

    def __init__(self, worker: GameWorker) -> None:
        self._worker = worker

    def notify(self) -> None:
        """Do nothing."""

    async def request_game(self, request: GameRequest) -> GameResponse:
        """Replay a game. Raises LeagueError."""
        return self._worker.respond(request.operation)


async def _documents(replica: Replica, base: str) -> dict[str, Any]:
    transport = httpx.ASGITransport(replica.application())
    async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:

        async def get(path: str, **parameters: Any) -> Any:
            return (await client.get(base + path, params=parameters)).raise_for_status().json()

        async def whole(path: str, rows: str, **parameters: Any) -> Any:
            document = page = await get(path, limit=MAX_PAGE, **parameters)
            while page.get("next") is not None or len(document[rows]) < page.get("total", 0):
                cursor = {"before": page["next"]} if "next" in page else {"offset": len(document[rows])}
                page = await get(path, limit=MAX_PAGE, **parameters, **cursor)
                document[rows] += page[rows]
            return document | ({"next": None} if "next" in document else {})

        about = await get("")
        traffic = about["traffic"] | {"canary": None, "shadow": None}
        about |= {"replicas": [], "faults": [], "traffic": traffic, "summary": about["summary"] | {"earlier": []}}
        leaderboard = await whole("/leaderboard", "leaderboard")
        verdicts = await whole("/verdicts", "verdicts")
        documents = {
            "": about,
            "/leaderboard": leaderboard,
            "/payoff": await get("/payoff"),
            "/ratings": await get("/ratings"),
            "/versions": await whole("/versions", "versions"),
            "/verdicts": verdicts,
        }
        for side in leaderboard["sides"]:
            documents[f"/leaderboard?side={side}"] = await whole("/leaderboard", "leaderboard", side=side)
        for alias in sorted({CHAMPION, *about["aliases"]}):
            path = f"/aliases/{alias}/history"
            documents[path] = await whole(path, "history")
        for verdict in verdicts["verdicts"][:MOST_VERDICTS]:
            path = f"/verdicts/{verdict['verdict']}"
            documents[path] = await get(path)
        upsets = about["summary"]["upsets"]
        for upset in upsets:
            path = _game(upset)
            documents[path] = await _recording(client, base + path, MOST_BYTES // len(upsets))
    return {base + path: document for path, document in documents.items()}


async def _recording(client: httpx.AsyncClient, path: str, room: int) -> Any:
    """A game with its first and its last step: every step, or every second, fourth, … if all are more than `room` bytes
    or than one response contains. Or the error of the replay.
    """
    every = 1
    while True:
        response = await client.get(path, params={"every": every})
        recording = response.json()
        steps = recording.get("steps")
        is_complete = steps and steps[-1]["step"] == recording["length"]
        if not steps or every > recording["length"] or (is_complete and len(response.content) <= room):
            return recording
        every *= 2


def plain_document(report: Mapping[str, Any]) -> dict[str, Any]:
    """Return the contents of a report under names of their own, without images, for programs."""
    league = report["league"]
    documents = {path.removeprefix(f"/v1/leagues/{league}"): document for path, document in report["documents"].items()}
    about, leaderboard = documents[""], documents["/leaderboard"]
    champion, summary = about["champion"], about["summary"]
    payoff = documents["/payoff"]["payoff"] or {"shares": []}
    verdicts = [f"/verdicts/{row['verdict']}" for row in documents["/verdicts"]["verdicts"]]
    left_out = []
    if (contestants := leaderboard["total"]) > MOST_CONTESTANTS:
        left_out.append(f"The payoff matrix contains the best {MOST_CONTESTANTS} of {contestants} contestants.")
    if len(verdicts) > MOST_VERDICTS:
        left_out.append(f"Only the newest {MOST_VERDICTS} of {len(verdicts)} verdicts have their evidence.")
    return summary | {
        "league": league,
        "made_at": report["made_at"],
        "champion": champion and f"{league}@{champion}",
        "leaderboard": leaderboard["leaderboard"],
        "not_champion": leaderboard["not_champion"],
        "by_side": {side: documents[f"/leaderboard?side={side}"]["leaderboard"] for side in leaderboard["sides"]},
        "payoff": {name: table for name, table in payoff.items() if name != "shares"} or None,
        "shares": payoff["shares"],
        "versions": documents["/ratings"]["versions"],
        "roles": {
            f"{league}@{version['version']}": _role(version)
            for version in documents["/versions"]["versions"]
            if version["role"] != "main"
        },
        "verdicts": [documents[path] for path in verdicts if path in documents],
        "promotions": [_promotion(event) for event in documents[f"/aliases/{CHAMPION}/history"]["history"]],
        "upsets": [upset | _without_images(documents[_game(upset)]) for upset in summary["upsets"]],
        "left_out": left_out,
    }


def _game(upset: Mapping[str, Any]) -> str:
    return f"/matches/{upset['match']}/games/{upset['game']}"


def _role(version: Mapping[str, Any]) -> str:
    if version["role"] == "exploiter":
        return f"exploiter of {version['exploits']}"
    if version["role"] == "search":
        return "search with @{version}, {simulations} simulations, {rule}, {ms:.3g} ms".format(**version["search"])
    shares = (f"@{member['version']} {100 * member['probability']:.1f} %" for member in version["members"])
    return f"mixture of {', '.join(shares)}"


def _promotion(event: Mapping[str, Any]) -> dict[str, Any]:
    league, previous = event["league"], event["previous"]
    by_hand = "by hand" if event["verdict"] is None else "promotion"
    return {name: event[name] for name in ("at", "actor", "reason", "verdict")} | {
        "kind": "rollback" if event["kind"] == "rollback" else by_hand,
        "champion": f"{league}@{event['version']}",
        "before": previous and f"{league}@{previous}",
    }


def _without_images(recording: dict[str, Any]) -> dict[str, Any]:
    """A recorded game without its images; with the `fault`, if the server would have responded with an error."""
    if "code" in recording:
        return {"fault": recording["message"]}
    return recording | {"steps": [step | {"picture": None} for step in recording["steps"]]}


def report_file(report: Mapping[str, Any]) -> bytes:
    """All pages with a report as one HTML document, which needs no server and works from `file://`.

    Browsers load no modules from files, so an import map contains them as data URLs. A Content-Security-Policy allows
    only scripts and styles with a random nonce, which no text of the report can know.

    Args:
        report: `{"league", "made_at", "documents"}`, as in `pages/report.js`.

    Returns:
        The document in UTF-8.
    """
    files = {
        path.relative_to(FILES).as_posix(): path.read_text(encoding="utf-8")
        for path in FILES.rglob("*")
        if path.suffix in MEDIA_TYPES
    }
    imports = {
        name: _data_url(name, re.sub(r'"\./(?=[\w/-]+\.js")', '"', code))  # data URLs have no relative ones
        for name, code in files.items()
        if name.endswith(".js")
    }
    nonce = token_urlsafe()
    rules = f"default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; img-src data:; base-uri 'none'"
    policy = f'<meta http-equiv="Content-Security-Policy" content="{rules}; form-action \'none\'">\n'
    data = orjson.dumps(report).decode().replace("<", r"\u003c")  # no text can end its element
    scripts = f"""<script type="importmap" nonce="{nonce}">{orjson.dumps({"imports": imports}).decode()}</script>
<script type="application/json" id="report">{data}</script>
<script type="module" nonce="{nonce}">import "app.js";</script>"""
    page = files[DOCUMENT].replace("<title>", f"{policy}<title>")
    for element, inlined in (
        (r'<link rel="modulepreload".*>\n', lambda _: ""),
        (r"/pages/(logo\.svg)", lambda found: _data_url(found[1], files[found[1]])),
        (
            r'<link rel="stylesheet" href="/pages/(.*)">',
            lambda found: f'<style nonce="{nonce}">{files[found[1]]}</style>',
        ),
        (r'<script src="/pages/(.*)"></script>', lambda found: f'<script nonce="{nonce}">{files[found[1]]}</script>'),
        (r'<script type="module" src="/pages/app\.js"></script>', lambda _: scripts),
    ):
        page = re.sub(element, inlined, page)
    return page.encode()


def _data_url(name: str, text: str) -> str:
    return f"data:{MEDIA_TYPES[Path(name).suffix]};base64,{b64encode(text.encode()).decode()}"
