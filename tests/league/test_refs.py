import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from league.errors import InvalidReference
from league.refs import CheckpointRef, PolicyRef, ScriptRef, check_alias, check_slug, parse_ref

slugs = st.from_regex(r"[a-z0-9_-]{1,100}", fullmatch=True)
aliases = slugs.filter(lambda slug: not slug.isdigit())
versions = st.integers(1, 2**31 - 1) | aliases


@given(st.builds(CheckpointRef, slugs, versions) | st.builds(ScriptRef, slugs | st.just("my_package.bots:Bot")))
def test_a_contestant_survives_parsing_its_text(ref: CheckpointRef | ScriptRef) -> None:
    assert parse_ref(str(ref)) == ref


@given(st.builds(PolicyRef, slugs, st.none() | slugs))
def test_a_model_name_survives_parsing_its_text(ref: PolicyRef) -> None:
    assert PolicyRef.parse(str(ref)) == ref


@pytest.mark.parametrize(
    "text",
    [
        "",
        "connect_four",
        "@3",
        "a@",
        "a@0",
        "a@-1x!",
        "A@3",
        "a@3@4",
        "a@99999999999999",
        "script:",
        "script:A",
        "a/b@1",
        f"{'a' * 101}@1",
        f"a@{'b' * 101}",
        f"script:{'a' * 101}",
    ],
)
def test_an_invalid_reference_is_rejected(text: str) -> None:
    with pytest.raises(InvalidReference):
        parse_ref(text)


@pytest.mark.parametrize("text", ["games/my_game.yaml", "my_game@3", "My_Game"])
def test_the_name_of_a_league_is_guessed(text: str) -> None:
    with pytest.raises(InvalidReference, match=r"'_' and '-', did you mean 'my_game'\?$"):
        check_slug("league", text)


def test_nothing_is_guessed_from_other_texts() -> None:
    with pytest.raises(InvalidReference, match=r"'_' and '-'$"):
        check_slug("league", "a b.yaml")


def test_the_version_of_a_model_is_a_separate_parameter() -> None:
    with pytest.raises(InvalidReference, match="model 'board@2' contains a version: send it as `version` instead"):
        PolicyRef.parse("board@2")


@given(st.text())
def test_any_text_is_parsed_or_rejected(text: str) -> None:
    with contextlib.suppress(InvalidReference):
        ref = parse_ref(text)
        assert parse_ref(str(ref)) == ref


def test_an_alias_cannot_be_a_number() -> None:
    assert check_alias("candidate") == "candidate"
    with pytest.raises(InvalidReference, match="version number"):
        check_alias("12")
