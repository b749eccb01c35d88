from hypothesis import given
from hypothesis import strategies as st

from evaluation.matches.tournament import ReorderBuffer


@given(st.permutations(range(12)), st.lists(st.booleans(), min_size=12, max_size=12))
def test_items_are_returned_in_order_as_soon_as_possible(order: list[int], looks: list[bool]) -> None:
    """looks: whether available items are taken after each insertion."""
    queue: ReorderBuffer[str] = ReorderBuffer()
    out: list[str] = []
    for number, (place, look) in enumerate(zip(order, looks, strict=True), start=1):
        queue.put(place, f"item {place}")
        while look and (item := queue.take()) is not None:
            out.append(item)
        if look:
            assert queue.due not in order[:number], "the next item is available but was not returned"
        assert len(queue) == number - len(out)
    while (item := queue.take()) is not None:
        out.append(item)
    assert out == [f"item {place}" for place in range(12)]
