"""Who stands where: results, scores and ratings of everybody in the ledger, best first."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping

from evaluation.contestants import ANCHOR
from evaluation.ratings import rate
from evaluation.report import Standing
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.results.records import BlockResult, Match


def standings(registry: Registry, league: str) -> tuple[Standing, ...]:
    """Everybody who played in the league's present environment, best first. Raises UnknownLeague."""
    digest = registry.league(league).environment_digest
    return ranked(Ledger(registry).results(league, digest))


def block_result(match: Match) -> BlockResult:
    """A match without its moves."""
    contestants = range(len(match.contestants))
    return BlockResult(
        schedule=match.schedule,
        position=match.position,
        contestants=match.contestants,
        games=len(match.games),
        scores=tuple(sum(game.scores[c] for game in match.games) for c in contestants),
        returns=tuple(sum(game.returns[c] for game in match.games) for c in contestants),
    )


def ranked(results: Iterable[BlockResult], distinct_games: Mapping[str, int] | None = None) -> tuple[Standing, ...]:
    """Sum up and rate `results`, best rating first, those without one last."""
    results = list(results)
    games: Counter[str] = Counter()
    points: defaultdict[str, float] = defaultdict(float)
    returns: defaultdict[str, float] = defaultdict(float)
    for block in results:
        for ref, score, value in zip(block.contestants, block.scores, block.returns, strict=True):
            games[ref] += block.games
            points[ref] += score
            returns[ref] += value
    ratings = rate(results, ANCHOR)
    table = []
    for ref, played in games.items():
        rating = ratings[ref]
        table.append(
            Standing(
                ref=ref,
                mean_return=returns[ref] / played,
                score=points[ref] / played,
                games=played,
                distinct_games=None if distinct_games is None else distinct_games[ref],
                rating=rating.elo,
                interval=None if rating.low is None or rating.high is None else (rating.low, rating.high),
            )
        )
    return tuple(sorted(table, key=_rank))


def _rank(standing: Standing) -> tuple[bool, float, str]:
    return standing.rating is None, -(standing.rating or 0.0), standing.ref
