"""Who stands where: results, scores and ratings of everybody in the ledger, best first."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from evaluation.contestants import ANCHOR
from evaluation.payoff import only_side
from evaluation.ratings import rate
from evaluation.report import RatedVersion, Standing, when
from league.registry.registry import Registry
from league.registry.rows import AliasEvent, VersionRow
from league.results.ledger import Ledger
from league.results.records import BlockResult, Game, Match


def standings(registry: Registry, league: str) -> tuple[Standing, ...]:
    """Everybody who played in the league's present environment, best first. Raises UnknownLeague."""
    digest = registry.league(league).environment_digest
    return ranked(Ledger(registry).results(league, digest))


def rated(version: VersionRow, standings: Sequence[Standing], events: Sequence[AliasEvent]) -> RatedVersion:
    """Where a version stands among `standings`, and when it became champion. events: of the champion's history."""
    standing = next((each for each in standings if each.ref == version.ref), None)
    return RatedVersion(
        ref=version.ref,
        number=version.number,
        made_at=when(version.created_at),
        steps=version.steps,
        parent=version.parent,
        rating=standing.rating if standing else None,
        interval=standing.interval if standing else None,
        games=standing.games if standing else 0,
        champion_at=tuple(when(event.at) for event in reversed(events) if event.version == version.number),
    )


def by_side(sides: Sequence[str], matches: Sequence[Match]) -> dict[str, tuple[Standing, ...]]:
    """Who stands where on each side, where contestants are compared with one another on the same side."""
    results: dict[str, list[BlockResult]] = {side: [] for side in sides}
    for match in matches:
        for number, side in enumerate(sides):
            games = [_on_side(game, number) for game in match.games]
            part = replace(match, games=tuple(game for game in games if game is not None))
            if part.games:
                results[side].append(part.result())
    return {side: ranked(own) for side, own in results.items()}


def _on_side(game: Game, side: int) -> Game | None:
    """The part of a game that says something about one side: what the contestant did that played it and no other."""
    own = game.sides[side]
    if only_side(game, own) != side:
        return None
    scores, returns = (
        tuple(v if c == own else None for c, v in enumerate(each)) for each in (game.scores, game.returns)
    )
    return replace(game, scores=scores, returns=returns)


def ranked(results: Iterable[BlockResult], distinct_games: Mapping[str, int] | None = None) -> tuple[Standing, ...]:
    """Sum up and rate `results`, best rating first; behind them those without one, by their scores."""
    results = list(results)
    games: Counter[str] = Counter()
    whole: Counter[str] = Counter()
    points: defaultdict[str, float] = defaultdict(float)
    returns: defaultdict[str, float] = defaultdict(float)
    for block in results:
        for ref, score in zip(block.contestants, block.scores, strict=True):
            games[ref] += block.games
            points[ref] += score
        for ref, value in zip(block.contestants, block.returns or (), strict=block.returns is not None):
            whole[ref] += block.games
            returns[ref] += value
    ratings = rate(results, ANCHOR)
    table = []
    for ref, played in games.items():
        rating = ratings[ref]
        table.append(
            Standing(
                ref=ref,
                mean_return=returns[ref] / whole[ref] if whole[ref] else None,
                score=points[ref] / played,
                games=played,
                distinct_games=None if distinct_games is None else distinct_games[ref],
                rating=rating.elo,
                interval=None if rating.low is None or rating.high is None else (rating.low, rating.high),
            )
        )
    return tuple(sorted(table, key=_rank))


def _rank(standing: Standing) -> tuple[bool, float, str]:
    return standing.rating is None, -(standing.score if standing.rating is None else standing.rating), standing.ref
