"""All interfaces of inference answer generated requests as recorded: see `tests.support.corpus`."""

from pathlib import Path

import pytest

from league.settings import Storage
from tests.support.corpus import FEW, MANY, read
from tests.support.corpus.answers import alike, rounds, sides


@pytest.mark.parametrize("numbers", [(FEW,), pytest.param((FEW, MANY), marks=pytest.mark.slow)], ids=["few", "many"])
def test_answers_are_those_that_were_recorded(numbers: tuple[int, ...], tmp_path: Path) -> None:
    recorded = read()
    with sides([Storage.at(tmp_path / name) for name in ("without_keys", "with_keys")]) as replicas:
        for interface, digest, answers in rounds(replicas, numbers):
            expected = recorded[interface][digest]
            for answer in answers:
                assert alike(answer, expected), f"{interface} {digest}: {answer}, expected {expected}"
