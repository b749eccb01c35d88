"""Manifests that are not valid are named; of a mixture, each position belongs to one member, by its probability."""

import math
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from league.errors import ArtifactCorrupt, InvalidInput
from league.registry.storage.manifest import Manifest, Member, Mixture, episode_position, normalised


def test_a_manifest_that_is_not_valid_is_named_with_its_first_faults(subtests: pytest.Subtests) -> None:
    for text, message in FAULTY:
        with subtests.test(text=text), pytest.raises(ArtifactCorrupt) as caught:
            Manifest.from_json(text, "board/1/manifest.json")
        assert str(caught.value).startswith(f"board/1/manifest.json: {message}")


POSITIONS = 2000


WEIGHTS = st.lists(st.floats(0.01, 1), min_size=2, max_size=6)


def mixture(*probabilities: float) -> Mixture:
    return Mixture(
        members=tuple(Member(version=n, probability=p, sha256="0" * 64) for n, p in enumerate(probabilities, 1))
    )


@given(WEIGHTS, st.floats(0, 1, exclude_max=True))
def test_a_member_plays_its_share_of_the_positions(weights: list[float], position: float) -> None:
    drawn = mixture(*(weight / math.fsum(weights) for weight in weights))
    counts = Counter(drawn.index_at((i + 0.5) / POSITIONS) for i in range(POSITIONS))
    for index, member in enumerate(drawn.members):
        assert abs(counts[index] / POSITIONS - member.probability) <= 1 / POSITIONS
    assert 0 <= drawn.index_at(position) < len(drawn.members), "any position has one"


@given(st.binary(max_size=64))
def test_an_episode_keeps_its_member(episode: bytes) -> None:
    first, again = mixture(0.25, 0.25, 0.5), mixture(0.25, 0.25, 0.5)
    assert 0 <= episode_position("duo", episode) < 1
    assert first.version_of("duo", episode) == again.version_of("duo", episode)


@given(st.binary(max_size=64), st.floats(0.05, 0.9))
def test_only_episodes_of_the_difference_change_their_member(episode: bytes, share: float) -> None:
    before, after = (mixture(p, 1 - p).version_of("duo", episode) for p in (share, share + 0.05))
    is_between = share <= episode_position("duo", episode) < share + 0.05
    assert (before != after) == is_between


def test_episodes_are_distributed_by_the_probabilities() -> None:
    drawn = mixture(0.1, 0.3, 0.6)
    counts = Counter(drawn.version_of("duo", f"game-{i}".encode()) for i in range(20_000))
    for member in drawn.members:
        error = math.sqrt(member.probability * (1 - member.probability) / 20_000)
        assert abs(counts[member.version] / 20_000 - member.probability) < 4 * error
    assert drawn.likeliest == 3
    assert mixture(0.5, 0.5).likeliest == 2, "the newest of equal ones"


def test_invalid_members_are_rejected() -> None:
    with pytest.raises(ValidationError, match="must sum to 1"):
        mixture(0.5, 0.4)
    with pytest.raises(ValidationError, match="ascending"):
        Mixture(members=tuple(reversed(mixture(0.5, 0.5).members)))
    with pytest.raises(ValidationError, match="at least 2"):
        mixture(1.0)


def test_written_probabilities_are_normalised() -> None:
    assert normalised({5: 0.333, 3: 0.333, 4: 0.333}) == {3: pytest.approx(1 / 3), 4: pytest.approx(1 / 3), 5: 1 / 3}
    with pytest.raises(InvalidInput, match=r"sum to 0\.9, expected 1"):
        normalised({1: 0.5, 2: 0.4})
    with pytest.raises(InvalidInput, match="version 2 has the probability 0, expected more than 0"):
        normalised({1: 1.0, 2: 0.0})
    with pytest.raises(InvalidInput, match="probability nan"):
        normalised({1: 0.5, 2: math.nan})
    with pytest.raises(InvalidInput, match="has 1 version, expected at least two"):
        normalised({1: 1.0})


FAULTY = (
    ("[" * 100_000, "file: not valid JSON: recursion limit exceeded"),
    ('{"league": "board"', "file: not valid JSON: EOF while parsing an object at line 1 column 18"),
    ("[]", "file: expected a mapping, got []"),
    ('{"league": 5}', "league: expected a string, got 5; version: missing, but required; "),
)
