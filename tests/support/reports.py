"""Reports of tests of exploitability, without games."""

from evaluation.documents import Difference, Exploitability, ExploiterScore
from evaluation.gating.criteria.exploitability import ExploitabilityReport


def exploitability_report(exploiters: int) -> ExploitabilityReport:
    """A test of tictactoe@3 against the champion tictactoe@2, with the exploiters @4, @5, … and @14, @15, …"""
    over_exploiters = Difference(0.1, 0.01, 0.19) if exploiters > 1 else Difference(0.1, None, None)
    return ExploitabilityReport(
        ref="tictactoe@2",
        margin=0.1,
        schedule="s",
        outcome="more exploitable",
        finding="more exploitable than tictactoe@2 by 0.1 of all points after 600 games",
        llr=-3.0,
        bounds=(-2.9, 2.9),
        blocks=100,
        games=600,
        unique_games=600,
        counts=(100,),
        improvement=0.0,
        candidate=_exploitability("tictactoe@3", exploiters, first=4, score=0.6),
        champion=_exploitability("tictactoe@2", exploiters, first=14, score=0.5),
        difference=Difference(0.1, 0.05, 0.15),
        difference_over_exploiters=over_exploiters,
    )


def _exploitability(ref: str, exploiters: int, first: int, score: float) -> Exploitability:
    gain = Difference(0.25, 0.125, 0.375)
    scores = (
        ExploiterScore(f"tictactoe@{number}", 400, score, score - 0.1, score + 0.1, gain)
        for number in range(first, first + exploiters)
    )
    return Exploitability(ref, score - 0.1, tuple(scores))
