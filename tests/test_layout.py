"""The layout of the code, beyond the contracts of import-linter."""

import ast
from collections import Counter, defaultdict
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parent.parent
PRODUCT = ("league", "training", "serve_app", "evaluation", "policy_league", "clients/python/policy_league_client")
GENERATED = ("migrations/", "_pb2.py", "_sync/")
MAX_LINES, MAX_DEPENDENCIES = 3_000, 17
"""Budget of a package, without its sub-packages: lines, and other packages of the product that it imports."""
ONE_PER_RESOURCE = {"serve_app/routes": 4_000}
"""Lines of packages with a module per resource of the HTTP API, which describes it, too."""


def modules(*packages: str) -> list[Path]:
    """Python files of top-level packages, without generated ones, relative to the root."""
    found = (path.relative_to(ROOT) for package in packages for path in (ROOT / package).rglob("*.py"))
    return sorted(path for path in found if not any(part in path.as_posix() for part in GENERATED))


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse((ROOT / path).read_text())


def test_a_package_is_small_and_uses_few_others() -> None:
    lines: Counter[str] = Counter()
    dependencies: defaultdict[str, set[str]] = defaultdict(set)
    for path in modules(*PRODUCT):
        package = path.parent.as_posix()
        lines[package] += len((ROOT / path).read_text().splitlines())
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.partition(".")[0] in PRODUCT:
                module = Path(*node.module.split("."))
                dependencies[package].add((module if (ROOT / module).is_dir() else module.parent).as_posix())
    large = {package: n for package, n in lines.items() if n > ONE_PER_RESOURCE.get(package, MAX_LINES)}
    assert large == {}
    used = {package: sorted(others - {package}) for package, others in dependencies.items()}
    assert {package: others for package, others in used.items() if len(others) > MAX_DEPENDENCIES} == {}


def test_public_class_names_are_unique() -> None:
    places: defaultdict[str, list[str]] = defaultdict(list)
    for path in modules(*PRODUCT):
        for node in tree(path).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(path.as_posix())
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


def imports(path: Path) -> set[str]:
    """Names that a module imports, such as `ray.serve.deployment`."""
    found = set()
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def uses_upstream_internals(path: Path) -> bool:
    """Private modules and hooks of Ray, and what serves HTTP and WebSockets. The client uses websockets' public API."""
    serving = ("uvicorn.", "websockets.") if path.parts[0] == "serve_app" else ()
    return "__serve_" in (ROOT / path).read_text() or any(
        f"{name}.".startswith(serving) or (name.startswith("ray.") and "._" in name) for name in imports(path)
    )


def test_upstream_internals_are_used_in_three_places_only() -> None:
    users = {path.as_posix() for path in modules(*PRODUCT) if uses_upstream_internals(path)}
    places = ("serve_app/runtime/", "league/local_ray/", "training/rllib_compat.py")
    assert any(name.startswith("serve_app/runtime/") for name in users), "the check finds them"
    assert [name for name in users if not name.startswith(places)] == []


def test_each_module_has_a_docstring() -> None:
    undocumented = [path for path in modules(*PRODUCT) if tree(path).body and not ast.get_docstring(tree(path))]
    assert undocumented == []


def test_no_test_module_imports_another() -> None:
    imports_of_tests = [
        (path.as_posix(), node.module)
        for path in modules("tests")
        for node in ast.walk(tree(path))
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("tests.")
    ]
    others = [
        (path, name) for path, name in imports_of_tests if name.rpartition(".")[2].startswith(("test_", "conftest"))
    ]
    assert imports_of_tests
    assert others == []
