from hypothesis import given
from hypothesis import strategies as st

from evaluation.ordering import InOrder


@given(st.permutations(range(12)), st.lists(st.booleans(), min_size=12, max_size=12))
def test_whatever_the_order_of_completion_items_come_out_by_place_and_as_soon_as_they_can(
    order: list[int], looks: list[bool]
) -> None:
    """`looks`: whether somebody takes what there is after each item."""
    queue: InOrder[str] = InOrder()
    out: list[str] = []
    for number, (place, look) in enumerate(zip(order, looks, strict=True), start=1):
        queue.put(place, f"item {place}")
        while look and (item := queue.take()) is not None:
            out.append(item)
        if look:
            assert queue.due not in order[:number], "nothing that can come out is held back"
        assert len(queue) == number - len(out)
    while (item := queue.take()) is not None:
        out.append(item)
    assert out == [f"item {place}" for place in range(12)]
