"""No local variable has a name that hides what it is: `found`, `each`, `own`, …

A name says what the value is, by a noun: `version`, `batch`, `legal_actions`.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = (
    "benchmarks",
    "clients/python/policy_league_client",
    "evaluation",
    "league",
    "policy_league",
    "scripts",
    "serve_app",
    "tests",
    "training",
)
GENERATED = ("_pb2.py", "_sync", "migrations")
VAGUE = frozenset(("found", "seen", "each", "own", "shown", "wanted", "given", "here", "now", "this", "that", "others"))
VAGUE |= {"rest", "mine", "known", "chosen", "taken", "begun"}


def check_local_names() -> Iterator[str]:
    """Yield the place of each vague name."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            if not any(part in str(path) for part in GENERATED):
                for name in vague_names(ast.parse(path.read_text())):
                    yield (
                        f"{path.relative_to(ROOT)}:{name.lineno}: {name.id}: "
                        "name the local variable by a noun that says what it is"
                    )


def vague_names(module: ast.Module) -> Iterator[ast.Name]:
    """The assignments to vague names in the functions of a module, in its order. Fields of classes do not count."""
    fields = {name for node in ast.walk(module) if isinstance(node, ast.ClassDef) for name in map(_field, node.body)}
    for node in ast.walk(module):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id in VAGUE and node not in fields:
            yield node


def _field(statement: ast.stmt) -> ast.expr | None:
    return statement.target if isinstance(statement, ast.AnnAssign) else None
