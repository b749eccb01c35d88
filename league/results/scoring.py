"""Who did better: from the returns of a block's two games to 1, ½ or 0 for each contestant in each.

Where the sides are alike, opponents are compared within each game: the usual win, draw and loss. Where they are not, an
adversary's return says nothing beside that of the agents it works against, and where there is one side only, nobody is
in the same game. There a contestant is compared with the other one on the same side in the other game, which has the
same seed and opening: both have had the same task.

A game that is forfeited is lost by who forfeited it, whatever it had collected, and drawn if both did. Compared by
side, each comparison takes both games of the block: whoever forfeited one of them loses all comparisons, unless the
other one forfeited one, too.

Where both play in one team (cross-play) there is nothing to compare, and no score.

Otherwise the scores of a block sum to half their number, and change places when the contestants do; so policies that
play alike score ½ on average, whatever a seat is worth.
"""

from collections.abc import Collection, Sequence

from league.results.records import Scoring

Values = tuple[float | None, ...]


def scores(returns: Sequence[Values], scoring: Scoring, forfeits: Sequence[Collection[int]] = ()) -> list[Values]:
    """returns[g][c]: what contestant c got in game g of its block, None if it took no part; scores likewise.

    forfeits[g]: who forfeited game g; nothing where nobody forfeited any.
    """
    broken = [set(by) for by in forfeits] or [set[int]() for _ in returns]
    if scoring == "side":
        broken = [set().union(*broken)] * len(returns)
    return [
        tuple(_score(returns, game, contestant, scoring, broken[game]) for contestant in range(len(returns[game])))
        for game in range(len(returns))
    ]


def _score(
    returns: Sequence[Values], game: int, contestant: int, scoring: Scoring, broken: Collection[int]
) -> float | None:
    mine = returns[game][contestant]
    other = returns[game if scoring == "game" else 1 - game][1 - contestant]
    if scoring == "team" or mine is None or other is None:
        return None
    if broken:
        mine, other = float(contestant not in broken), float(1 - contestant not in broken)
    return 1.0 if mine > other else 0.5 if mine == other else 0.0
