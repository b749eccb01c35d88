"""Paired differences: by how much one contestant's return exceeds the other's, in the environment's own unit.

Both games of a block have the same seed and opening, so what a seed is worth cancels in the difference of a block's
returns. Blocks are independent: the interval is Student's, over blocks.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from scipy.special import stdtrit

from evaluation.report import Difference
from league.results.records import Match


def paired_difference(matches: Iterable[Match], contestant: str, confidence: float = 0.95) -> Difference | None:
    """Mean return of `contestant` minus that of its opponent, over `matches` between the two; None without any.

    Blocks with a forfeited game are left out: what was collected until then can be more than a whole game brings.
    After a sequential stop the interval is conditional on having stopped, and tends to be optimistic.
    """
    gaps = []
    for match in matches:
        own = match.contestants.index(contestant)
        mine, other = match.mean_return(own), match.mean_return(1 - own)
        if mine is not None and other is not None:
            gaps.append(mine - other)
    return student(gaps, confidence) if gaps else None


def student(values: Sequence[float], confidence: float = 0.95) -> Difference:
    """The mean of independent values, mean ± t s/√N."""
    number, mean = len(values), float(np.mean(values))
    if number == 1:
        return Difference(mean, None, None)
    half = float(stdtrit(number - 1, 0.5 + confidence / 2)) * float(np.std(values, ddof=1)) / math.sqrt(number)
    return Difference(mean, mean - half, mean + half)
