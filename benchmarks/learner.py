"""What does an iteration of PPO cost, compared with a compiled JAX program in the style of PureJaxRL?

Connect four by self-play, sampling and learning, one thread each. A rate is actions per second of processor time; the
two programs alternate, and a ratio is the median over the rounds. PYTHON is that of an environment with jax and pgx.
"""

import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from benchmarks import revisions
from benchmarks.harness import ROOT, Parts, Quick, Target, chosen
from benchmarks.revisions import Worker

PEER = ROOT / "benchmarks/peers/jax_ppo.py"


@dataclass(frozen=True, slots=True)
class Comparison:
    """ours: a part of `benchmarks.revisions`. theirs: arguments of the peer. at_most: ratio of processor times."""

    ours: str
    theirs: tuple[str, ...]
    at_most: float


PARTS = {
    "MLP": Comparison("iteration MLP", ("mlp", "128", "32", "512"), at_most=1.15),
    "convolutional": Comparison("iteration convolutional", ("convolutional", "256", "32", "1024"), at_most=1.1),
}


def main(python: Path, parts: Parts = None, quick: Quick = False) -> Iterator[Target]:
    """Measure the networks."""
    rounds, seconds = (3, 1.0) if quick else (9, 3.0)
    for name, comparison in chosen(parts, PARTS).items():
        with tempfile.TemporaryDirectory() as scratch:
            program = revisions.PARTS[comparison.ours]
            with (
                closing(Worker.of_checkout(ROOT, program, scratch)) as ours,
                closing(Worker([python, PEER, *comparison.theirs], ROOT, {})) as theirs,
            ):
                pairs = [(1e6 / ours.measure(seconds), 1e6 / theirs.measure(seconds)) for _ in range(rounds)]
        ratio = median(time / peer for time, peer in pairs)
        our_time, peer_time = (median(times) for times in zip(*pairs, strict=True))
        note = f"{our_time:.1f} to {peer_time:.1f} µs per action"
        yield Target(name, ratio, "×", at_most=comparison.at_most, peer="PPO in JAX", note=note)
