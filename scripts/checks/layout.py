"""The layout of the code, beyond the contracts of import-linter."""

import ast
import re
from collections import Counter, defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
PRODUCT = ("league", "training", "serve_app", "evaluation", "policy_league", "clients/python/policy_league_client")
GENERATED = ("migrations/", "_pb2.py", "_sync/")
MAX_LINES, MAX_DEPENDENCIES = 3_000, 17
"""Budget of a package, without its sub-packages: lines, and other packages of the product that it imports."""
ONE_PER_RESOURCE = {"serve_app/routes": 4_000}
"""Lines of packages with a module per resource of the HTTP API, which describes it, too."""
RLLIB_COMPAT = Path("training/rllib_compat.py")
DOCUMENTED = {
    *("ray", "ray.tune", "ray.tune.registry", "ray.tune.schedulers", "ray.tune.experiment", "ray.job_submission"),
    *("ray.tune.search", "ray.tune.search.optuna"),
    *("ray.exceptions", "ray.rllib.core", "ray.rllib.core.columns", "ray.rllib.core.learner.learner"),
    *("ray.rllib.algorithms", "ray.rllib.algorithms.algorithm", "ray.rllib.algorithms.algorithm_config"),
    *("ray.rllib.core.rl_module.rl_module", "ray.rllib.core.rl_module.multi_rl_module"),
    *("ray.rllib.core.rl_module.torch", "ray.rllib.core.rl_module.apis.value_function_api"),
    *("ray.rllib.env.env_runner", "ray.rllib.env.multi_agent_env", "ray.rllib.env.single_agent_episode"),
    *("ray.rllib.utils.metrics", "ray.rllib.utils.metrics.metrics_logger", "ray.rllib.utils.checkpoints"),
    "ray.util.scheduling_strategies",
}
"""Modules of Ray's API reference and of its documented examples."""
OVERRIDES = {"_forward", "_forward_exploration", "_forward_inference", "_forward_train"}
"""Methods that the documentation of RLModule tells subclasses to override."""


@cache
def modules() -> dict[Path, ast.Module]:
    """The Python files of the product, without generated ones, relative to the root, and what they contain."""
    paths = (path for package in PRODUCT for path in sorted((ROOT / package).rglob("*.py")))
    return {
        path.relative_to(ROOT): ast.parse(path.read_text())
        for path in paths
        if not any(part in path.as_posix() for part in GENERATED)
    }


def check_sizes() -> Iterator[str]:
    """A package is small, and uses few others."""
    lines: Counter[str] = Counter()
    dependencies: defaultdict[str, set[str]] = defaultdict(set)
    for path, tree in modules().items():
        package = path.parent.as_posix()
        lines[package] += len((ROOT / path).read_text().splitlines())
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.partition(".")[0] in PRODUCT:
                module = Path(*node.module.split("."))
                dependencies[package].add((module if (ROOT / module).is_dir() else module.parent).as_posix())
    for package, number in lines.items():
        if number > (limit := ONE_PER_RESOURCE.get(package, MAX_LINES)):
            yield f"{package}: {number:,} lines, expected at most {limit:,}"
    for package, imported in dependencies.items():
        if len(imported - {package}) > MAX_DEPENDENCIES:
            yield f"{package}: imports {len(imported - {package})} packages, expected at most {MAX_DEPENDENCIES}"


def check_class_names() -> Iterator[str]:
    """A public class has a name of its own."""
    places: defaultdict[str, list[str]] = defaultdict(list)
    for path, tree in modules().items():
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(path.as_posix())
    for name, paths in places.items():
        if len(paths) > 1:
            yield f"class {name}: in {' and '.join(paths)}"


def check_upstream_internals() -> Iterator[str]:
    """Private modules and hooks of Ray are used in three places, and what serves HTTP and WebSockets in one of them."""
    places = ("serve_app/runtime/", "league/local_ray/", "training/rllib_compat.py")
    for path, tree in modules().items():
        serving = ("uvicorn.", "websockets.") if path.parts[0] == "serve_app" else ()
        internals = [
            name for name in imports(tree) if f"{name}.".startswith(serving) or ("._" in name and name[:4] == "ray.")
        ]
        internals += ["__serve_"] * ("__serve_" in (ROOT / path).read_text())
        if internals and not path.as_posix().startswith(places):
            yield f"{path}: {internals[0]} may be used in {', '.join(places)} only"


def check_internals_of_rllib() -> Iterator[str]:
    """In training, only rllib_compat.py uses undocumented modules and private attributes of Ray."""
    trees = {path: tree for path, tree in modules().items() if path.parts[0] == "training" and path != RLLIB_COMPAT}
    names = OVERRIDES.union(*map(defined_names, trees.values()))
    for path, tree in trees.items():
        for node in ast.walk(tree):
            match node:
                case ast.ImportFrom(module=str(name)) if name.partition(".")[0] == "ray" and name not in DOCUMENTED:
                    yield f"{path}:{node.lineno}: {name}: expected in {RLLIB_COMPAT} only"
                case ast.Constant(value=str(text)) if text.startswith(("ray._", "ray.tune.")):
                    yield f"{path}:{node.lineno}: {text!r}: expected in {RLLIB_COMPAT} only"
                case ast.Attribute(attr=name) if name[0] == "_" and name[:2] != "__" and name not in names:
                    yield f"{path}:{node.lineno}: {ast.unparse(node)}: expected in {RLLIB_COMPAT} only"


def defined_names(tree: ast.Module) -> set[str]:
    """Names that the functions, classes and assignments of a module define, including attributes of `self`."""
    names = set()
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name) | ast.Name(id=name, ctx=ast.Store()):
                names.add(name)
            case ast.Attribute(attr=name, ctx=ast.Store(), value=ast.Name(id="self")):
                names.add(name)
    return names


def imports(tree: ast.Module) -> Iterator[str]:
    """Names that a module imports, such as `ray.serve.deployment`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def check_docstrings() -> Iterator[str]:
    """Each module says what it is for."""
    for path, tree in modules().items():
        if tree.body and not ast.get_docstring(tree):
            yield f"{path}: no docstring"


def check_tests_are_independent() -> Iterator[str]:
    """No test module imports another."""
    for path in (ROOT / "tests").rglob("*.py"):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for name in re.findall(r"^(?:from|import) (tests\.\S*\b(?:test_|conftest)\S*)", path.read_text(), flags=re.M):
            if name != module:  # programs of its other processes import it
                yield f"{path.relative_to(ROOT)}: imports {name}, expected a module of tests/support"
