"""The number of examples of a property."""

from hypothesis import settings


def examples(count: int) -> settings:
    """Draw `count` examples where they are random, as every night. Elsewhere each run draws the same ones: 40 % do."""
    return settings(max_examples=round(0.4 * count) if settings().derandomize else count)
