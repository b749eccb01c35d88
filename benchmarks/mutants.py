"""Do the quick tests notice a fault? Mutants of the modules that changed since a revision, drawn at random.

A mutant changes one expression or drops one statement. Its tests run in a clone: first those of the package, as
`tests/` mirrors the packages, then, if none fails, all of `make test`. A mutant that no test notices may also be one
that behaves as before; it counts as missed all the same.
"""

import ast
import os
import random
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from benchmarks.harness import ROOT, Quick, Target

PACKAGES = ("league", "training", "evaluation", "serve_app", "policy_league/cli", "clients/python")
MIRRORS = {"policy_league/cli": "cli", "clients/python/policy_league_client": "policy_league_client"}
"""Folders of tests that have another name than their package."""
GENERATED = re.compile(r"_pb2|_sync/|/migrations/|clients/python/build/")
OPPOSITE: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.And: ast.Or,
    ast.Or: ast.And,
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.FloorDiv,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
}
"""What an operator becomes."""
AT_LEAST = 0.9
"""Share of mutants that the tests should notice."""


@dataclass(frozen=True, slots=True)
class Mutant:
    """One fault: the text between two offsets of a module's source, in bytes, and what replaces it."""

    module: str
    line: int
    start: int
    end: int
    before: str
    after: str

    def __str__(self) -> str:
        before, after = (" ".join(text.split())[:60] for text in (self.before, self.after))
        return f"{self.module}:{self.line}: {before} -> {after}"


def mutants(module: str, source: str) -> Iterator[Mutant]:
    """All faults that can be injected into a module."""
    starts = [0]
    for line in source.encode().splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    tree = ast.parse(source)
    ignored = {id(part) for node in ast.walk(tree) for root in _ignored(node) for part in ast.walk(root)}
    for node in ast.walk(tree):
        if id(node) in ignored or not isinstance(node, (ast.expr, ast.stmt)) or (after := _fault(node)) is None:
            continue
        start, end = (
            starts[line - 1] + column
            for line, column in ((node.lineno, node.col_offset), (node.end_lineno or 0, node.end_col_offset or 0))
        )
        yield Mutant(module, node.lineno, start, end, source.encode()[start:end].decode(), after)


def _ignored(node: ast.AST) -> Iterator[ast.AST]:
    """Parts of a node that are no behaviour: annotations, documentation, and what only the type checker reads."""
    match node:
        case ast.arg(annotation=ast.expr() as annotation) | ast.AnnAssign(annotation=annotation):
            yield annotation
        case ast.FunctionDef(returns=ast.expr() as returns) | ast.AsyncFunctionDef(returns=ast.expr() as returns):
            yield returns
        case ast.If(test=ast.Name(id="TYPE_CHECKING")) | ast.Assert() | ast.JoinedStr():
            yield node
        case ast.Expr(value=ast.Constant()):
            yield node


def _fault(node: ast.expr | ast.stmt) -> str | None:
    """The source of a node with a fault, None if none of the kinds fits it."""
    match node:
        case ast.Compare(left=left, ops=[operator], comparators=comparators) if type(operator) in OPPOSITE:
            return f"({ast.unparse(ast.Compare(left, [_opposite(operator)], comparators))})"
        case ast.BoolOp(op=operator, values=values):
            return f"({ast.unparse(ast.BoolOp(_opposite(operator), values))})"
        case ast.BinOp(left=left, op=operator, right=right) if type(operator) in OPPOSITE:
            return f"({ast.unparse(ast.BinOp(left, _opposite(operator), right))})"
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            return f"bool({ast.unparse(operand)})"
        case ast.Constant(value=bool() as value):
            return str(not value)
        case ast.Constant(value=int() as value):
            return str(value + 1)
        case ast.Return(value=ast.expr()):
            return "return None"
        case ast.Expr(value=ast.Call()) | ast.AugAssign():
            return "pass"
    return None


def _opposite(operator: ast.AST) -> Any:
    return OPPOSITE[type(operator)]()


def main(
    base: str, quick: Quick = False, number: int = 40, seed: int = 36, processes: int = 2, whole: bool = True
) -> Iterator[Target]:
    """Draw mutants of the modules that changed since a revision, and run the tests on each.

    whole: whether all of `make test` runs for a mutant that the tests of its package do not notice.
    """
    names = subprocess.check_output(["git", "diff", "--name-only", base, "--", *PACKAGES], cwd=ROOT, text=True)
    modules = [name for name in names.split() if name.endswith(".py") and not GENERATED.search(name)]
    faults = [fault for name in modules if (ROOT / name).exists() for fault in mutants(name, (ROOT / name).read_text())]
    drawn = random.Random(seed).sample(faults, 2 if quick else number)
    with tempfile.TemporaryDirectory() as directory:
        clones: SimpleQueue[Path] = SimpleQueue()
        for index in range(processes):
            clone = Path(directory) / str(index)
            subprocess.run(["git", "clone", "--quiet", str(ROOT), str(clone)], check=True)
            clones.put(clone)

        def noticed(fault: Mutant) -> str | None:
            clone = clones.get()
            try:
                return _noticed(fault, clone, whole)
            finally:
                clones.put(clone)

        with ThreadPoolExecutor(processes) as threads:
            outcomes = []
            for fault, test in zip(drawn, threads.map(noticed, drawn), strict=True):
                print(f"{fault}: {test or 'MISSED'}", flush=True)
                outcomes.append(test)
    share = sum(test is not None for test in outcomes) / len(drawn)
    note = f"{len(drawn)} of {len(faults):,} in {len(modules)} modules, seed {seed}"
    yield Target("faults that tests notice", share, at_least=AT_LEAST, note=note)


def _noticed(fault: Mutant, clone: Path, whole: bool) -> str | None:
    """The first test that fails with a fault in a clone, None if all pass."""
    path = clone / fault.module
    source = path.read_bytes()
    path.write_bytes(source[: fault.start] + fault.after.encode() + source[fault.end :])
    try:
        for tests in _tests(fault.module, clone, whole):
            if test := _first_failure(tests, clone):
                return test
        return None
    finally:
        path.write_bytes(source)


def _tests(module: str, clone: Path, whole: bool) -> Iterator[list[str]]:
    """What to run, the nearest first."""
    folder, name = str(Path(module).parent), Path(module).stem
    for package, mirror in MIRRORS.items():
        folder = folder.replace(package, mirror)
    near = clone / "tests" / folder
    if (near / f"test_{name}.py").exists():
        yield [f"tests/{folder}/test_{name}.py"]
    while not near.exists():
        near = near.parent
    if near != clone / "tests":
        yield [str(near.relative_to(clone))]
    if whole:
        yield ["tests"]


def _first_failure(tests: list[str], clone: Path) -> str | None:
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-m", "not slow", "--timeout", "300", *tests]
    path = os.pathsep.join(map(str, (clone, clone / "clients/python")))
    environment = os.environ | {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
    run = subprocess.run(command, cwd=clone, env=environment, capture_output=True, text=True, check=False)
    if run.returncode in (0, 5):  # 5: no test was selected
        return None
    failure = re.search(r"^(?:FAILED|ERROR) (\S+)", run.stdout, re.MULTILINE)
    return failure[1] if failure else f"{tests[0]}: exit code {run.returncode}"
