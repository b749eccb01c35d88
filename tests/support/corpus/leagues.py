"""The leagues and the API keys to which the cases of the corpus are addressed."""

from datetime import UTC, datetime

from league.interface import AgentInterface
from league.registry.registry import Registry
from league.registry.storage.rows import Portion
from league.search.policies import publish_search
from league.settings import Storage
from tests.support.leagues import tictactoe
from tests.support.leagues.protocol_leagues import CHESS, CHOICE, KINDS, PISTONS, every_kind
from tests.support.leagues.served_leagues import BOARD, MEMORY, NESTED, VECTOR, promote, publish, register
from tests.support.policies.graphs import counting, masked_mlp

SHARE = 0.4
"""Of the canary."""
MODELS: dict[str, AgentInterface] = {
    **dict.fromkeys(
        ("board", "board.shared", "duo.left", "duo.right", "canaried", "shadowed", "mixed", "sampled"), BOARD
    ),
    **dict.fromkeys(("memory", "memories"), MEMORY),
    "vector": VECTOR,
    "nested": NESTED,
    "kinds": KINDS,
    "chess": CHESS,
    "pistons": PISTONS,
    "choice": CHOICE,
}
"""Model → its spaces. Those of tic-tac-toe are its environment's."""
SEARCHED = "tictactoe"
"""Version 2 of this league searches."""


def build(storage: Storage) -> Registry:
    """All leagues of the tests of inference, and one for each way to choose the version that answers."""
    registry = every_kind(storage)
    publish(registry, "memory", {"shared": counting()}, "run/2")
    for league in ("canaried", "shadowed", "mixed"):
        _two_versions(registry, league, BOARD, masked_mlp(seed=5), masked_mlp(seed=6))
    _two_versions(registry, "memories", MEMORY, counting(), counting())
    for league in ("mixed", "memories"):
        promote(registry, league, registry.publisher.publish_mixture(league, {1: 0.5, 2: 0.5}).number)
    registry.traffic.set("canaried", canary=Portion(2, SHARE), actor="test", reason="test")
    registry.traffic.set("shadowed", shadow=Portion(2, 1.0), actor="test", reason="test")
    register(registry, "sampled", {"shared": BOARD}, actions="sampled")
    publish(registry, "sampled", {"shared": masked_mlp()}, "run")
    promote(registry, "sampled", 1)
    _searching(registry)
    return registry


def _two_versions(registry: Registry, league: str, spaces: AgentInterface, *graphs: bytes) -> None:
    register(registry, league, {"shared": spaces})
    for number, graph in enumerate(graphs):
        publish(registry, league, {"shared": graph}, f"run/{number}")
    promote(registry, league, 1)


def _searching(registry: Registry) -> None:
    tictactoe.registry(registry.storage.home).close()
    tictactoe.publish(registry, masked_mlp((3, 3, 2), 9), value=masked_mlp((3, 3, 2), 9, has_value=True))
    league, base = registry.leagues.get(SEARCHED), registry.versions.get(SEARCHED, 1)
    publish_search(registry, base, league.config.environment, league.interface, "puct", 16)
    promote(registry, SEARCHED, 1)


def create_keys(registry: Registry) -> dict[str, str]:
    """Create API keys; name → text. The only token of `spent` returns after more than a quarter of an hour."""
    limits = {
        "good": {"scopes": ["act", "read"]},
        "fast": {"scopes": ["act"], "rate": 1e6},
        "reader": {"scopes": ["read"]},
        "duo": {"scopes": ["act"], "only_leagues": ["duo"]},
        "spent": {"scopes": ["act"], "rate": 0.001},
        "revoked": {"scopes": ["act"]},
        "expired": {"scopes": ["act"], "expires_at": datetime.now(UTC)},
    }
    keys = {name: registry.keys.create(name, **limit)[1] for name, limit in limits.items()}
    registry.keys.revoke("revoked")
    return keys | {"unknown": f"{keys['good'][:-1]}_", "short": "plk_short"}
