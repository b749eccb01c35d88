"""Shadow traffic of the league `board`."""

from collections.abc import Callable
from typing import Any

from league.registry.registry import Registry
from league.registry.storage.rows import Portion, ShadowCounts
from tests.support.waiting import until


def set_shadow(registry: Registry, version: int = 2, share: float = 1.0, league: str = "board") -> None:
    setting = registry.traffic.set(league, shadow=Portion(version, share), actor="test", reason="test")
    until(lambda: [one.traffic for one in registry.replicas.acknowledgements(league)] == [setting.id])


def shadow_counts(registry: Registry, candidate: int = 2, league: str = "board") -> ShadowCounts | None:
    return next((one for one in registry.traffic.shadow_counts(league) if one.candidate == candidate), None)


def wait_for(registry: Registry, condition: Callable[[ShadowCounts], bool], **of: Any) -> ShadowCounts:
    until(lambda: (one := shadow_counts(registry, **of)) is not None and condition(one))
    counts = shadow_counts(registry, **of)
    assert counts is not None
    return counts
