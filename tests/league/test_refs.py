"""References and errors as texts; histograms of times."""

import contextlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from league.errors import InvalidReference, NotFound, from_document, last_line, one_line, to_document
from league.histograms import BOUNDS, Histogram
from league.refs import CheckpointRef, PolicyRef, ScriptRef, check_alias, check_slug, parse_ref

slugs = st.from_regex(r"[a-z0-9_-]{1,100}", fullmatch=True)


aliases = slugs.filter(lambda slug: not slug.isdigit())


versions = st.integers(1, 2**31 - 1) | aliases


@given(st.text())
def test_any_text_is_parsed_or_rejected(text: str) -> None:
    with contextlib.suppress(InvalidReference):
        ref = parse_ref(text)
        assert parse_ref(str(ref)) == ref


@given(
    st.builds(CheckpointRef, slugs, versions) | st.builds(ScriptRef, slugs | st.just("my_package.bots:Bot")),
    st.builds(PolicyRef, slugs, st.none() | slugs),
)
def test_references_survive_parsing_their_texts(ref: CheckpointRef | ScriptRef, model: PolicyRef) -> None:
    assert parse_ref(str(ref)) == ref
    assert PolicyRef.parse(str(model)) == model


INVALID = ["", "connect_four", "@3", "a@", "a@0", "a@-1x!", "A@3", "a@3@4", "a@99999999999999", "a/b@1"]


INVALID += ["script:", "script:A", f"{'a' * 101}@1", f"a@{'b' * 101}", f"script:{'a' * 101}"]


def test_invalid_references_are_rejected() -> None:
    for text in INVALID:
        with pytest.raises(InvalidReference):
            parse_ref(text)
    for text in ("games/my_game.yaml", "my_game@3", "My_Game"):
        with pytest.raises(InvalidReference, match=r"'_' and '-', did you mean 'my_game'\?$"):
            check_slug("league", text)
    with pytest.raises(InvalidReference, match=r"'_' and '-'$"):
        check_slug("league", "a b.yaml")
    with pytest.raises(InvalidReference, match="model 'board@2' contains a version: send it as `version` instead"):
        PolicyRef.parse("board@2")
    assert check_alias("candidate") == "candidate"
    with pytest.raises(InvalidReference, match="version number"):
        check_alias("12")


def test_an_error_keeps_its_type_as_data() -> None:
    document = to_document(NotFound("no such league"))
    assert document == {"code": "not_found", "message": "no such league"}
    error = from_document(document)
    assert type(error) is NotFound
    assert str(error) == "no such league"


def test_an_error_is_one_line() -> None:
    error = ValueError("two\n  lines")
    assert (one_line(error), one_line(error, with_type=True)) == ("two lines", "ValueError: two lines")
    assert one_line(TimeoutError()) == one_line(TimeoutError(), with_type=True) == "TimeoutError"
    assert one_line(ValueError("the  first\nthe second"), with_type=True, first_line=True) == "ValueError: the first"
    assert [last_line(text) for text in ("first\n second \n\n", "\n", "")] == ["second", "", ""]


TIMES = st.lists(st.integers(0, 10**11), min_size=1, max_size=50)


def histogram_of(times: list[int]) -> Histogram:
    histogram = Histogram()
    for ns in times:
        histogram.add(ns)
    return histogram


@given(TIMES, st.floats(0.01, 1))
def test_a_quantile_is_an_upper_bound(times: list[int], share: float) -> None:
    bound = histogram_of(times).quantile(share)
    assert bound is not None
    exact = np.quantile(times, share, method="inverted_cdf") / 1e6
    assert exact <= bound
    assert bound == float("inf") or bound == BOUNDS[0] / 1000 or exact > bound / 5, "the bound is too large"


@given(TIMES, TIMES)
def test_merging_adds_the_counts(some: list[int], others: list[int]) -> None:
    merged, other = histogram_of(some), histogram_of(others)
    merged.merge(other.counts, other.ns)
    both = histogram_of(some + others)
    assert (merged.counts, merged.ns, merged.count) == (both.counts, both.ns, len(some) + len(others))


def test_an_empty_histogram_has_no_quantile() -> None:
    assert Histogram().quantile(0.5) is None


def test_a_bound_belongs_to_its_bucket() -> None:
    histogram = histogram_of([25_000, 25_001])
    assert histogram.counts[:2] == [1, 1]
    assert (histogram.quantile(0.5), histogram.quantile(0.51)) == (0.025, 0.05)
