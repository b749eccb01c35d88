"""Do the quick tests notice a fault? Mutants of the modules of each package, drawn at random.

A mutant changes one expression or drops one statement. The nearest tests run on it in a clone: the test file of its
module, as `tests/` mirrors the packages, then those of its folder. A test counts if it passes without the fault. A
mutant that no test notices may also be one that behaves as before; it counts as missed all the same.

With --earlier FILE, the output of a run with other tests and the same modules, only the faults that were noticed there
are tested, and all must be noticed.
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
from typing import Annotated, Any

import typer

from benchmarks.harness import ROOT, Quick, Target

PACKAGES = ("league", "training", "evaluation", "serve_app", "policy_league/cli", "clients/python/policy_league_client")
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
LONGEST = 1200
"""Seconds for a run of tests: a fault can also hang the interpreter when it exits."""


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
    paths: Annotated[list[str] | None, typer.Argument(help="folders of modules; default: every package")] = None,
    quick: Quick = False,
    number: Annotated[int, typer.Option(help="mutants of each folder")] = 25,
    seed: int = 51,
    processes: int = 2,
    earlier: Annotated[Path | None, typer.Option(help="the output of an earlier run")] = None,
) -> Iterator[Target]:
    """Draw mutants, and run the nearest tests on each."""
    drawn = [mutant for path in paths or PACKAGES for mutant in _drawn(path, 1 if quick else number, seed)]
    if earlier:
        lines = earlier.read_text().splitlines()
        drawn = [fault for fault in drawn if any(line.startswith(f"{fault}: tests/") for line in lines)]
    with tempfile.TemporaryDirectory() as directory:
        clones: SimpleQueue[Path] = SimpleQueue()
        for index in range(processes):
            clone = Path(directory) / str(index)
            subprocess.run(["git", "clone", "--quiet", str(ROOT), str(clone)], check=True)
            clones.put(clone)

        def noticed(fault: Mutant) -> str | None:
            clone = clones.get()
            try:
                return _noticed(fault, clone)
            finally:
                clones.put(clone)

        outcomes = []
        with ThreadPoolExecutor(processes) as threads:
            for fault, test in zip(drawn, threads.map(noticed, drawn), strict=True):
                print(f"{fault}: {test or 'MISSED'}", flush=True)
                outcomes.append(test)
    share = sum(test is not None for test in outcomes) / len(drawn)
    note = f"of {len(drawn)}, seed {seed}"
    yield Target("faults that tests notice", share, at_least=1.0 if earlier else None, note=note)


def _drawn(path: str, number: int, seed: int) -> list[Mutant]:
    """Mutants of the modules in a folder."""
    names = subprocess.check_output(["git", "ls-files", "--", path], cwd=ROOT, text=True).split()
    modules = [name for name in names if name.endswith(".py") and not GENERATED.search(name)]
    faults = [fault for name in modules for fault in mutants(name, (ROOT / name).read_text())]
    return random.Random(seed).sample(faults, number)


def _noticed(fault: Mutant, clone: Path) -> str | None:
    """The first test that fails with a fault in a clone and passes without it, None if there is none."""
    path = clone / fault.module
    source = path.read_bytes()
    mutant = source[: fault.start] + fault.after.encode() + source[fault.end :]
    ignored: list[str] = []
    for tests in _tests(fault.module, clone):
        path.write_bytes(mutant)
        while test := _first_failure([*tests, *(f"--deselect={name}" for name in ignored)], clone):
            path.write_bytes(source)
            if _first_failure([test], clone) is None:
                return test
            ignored.append(test)
            path.write_bytes(mutant)
        path.write_bytes(source)
    return None


def _tests(module: str, clone: Path) -> Iterator[list[str]]:
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


def _first_failure(arguments: list[str], clone: Path) -> str | None:
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-m", "not slow", "--timeout", "120", *arguments]
    path = os.pathsep.join(map(str, (clone, clone / "clients/python")))
    environment = os.environ | {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        run = subprocess.run(command, cwd=clone, env=environment, capture_output=True, text=True, timeout=LONGEST)
    except subprocess.TimeoutExpired:
        return arguments[0]
    if run.returncode in (0, 5):  # 5: no test was selected
        return None
    failure = re.search(r"^(?:FAILED|ERROR) (tests/.+?)(?: - .*)?$", run.stdout, re.MULTILINE)
    return failure[1] if failure else arguments[0]
