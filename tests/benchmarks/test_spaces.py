"""Generated spaces: what `check-env` accepts is trained, exported and served."""

from collections.abc import Iterator

import pytest

from benchmarks.generated_spaces import Case, Pipeline, pipeline

CASES, PARTS = 100, 5
PUBLISHED = 25
"""Every so many cases are exported and served too, which takes five times as long as the rest: all of part 0."""


@pytest.fixture(scope="module")
def line() -> Iterator[Pipeline]:
    with pipeline() as line:
        yield line


@pytest.mark.parametrize("part", [0, *(pytest.param(part, marks=pytest.mark.slow) for part in range(1, PARTS))])
def test_accepted_spaces_do_not_fail_later(line: Pipeline, part: int) -> None:
    outcomes = [line.outcome(Case.of(seed), published=seed % PUBLISHED == 0) for seed in range(part, CASES, PARTS)]
    assert [outcome for outcome in outcomes if outcome.failure] == []
    refused = [outcome for outcome in outcomes if outcome.refusal]
    assert 0 < len(refused) < 0.5 * len(outcomes)
