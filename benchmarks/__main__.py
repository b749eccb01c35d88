"""`python -m benchmarks NAME` runs a benchmark, and prints its results and whether its targets are met."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from benchmarks.harness import ROOT, Quick, Target, record

FOLDER = Path(__file__).parent
NEED_ARGUMENTS = ("learner", "revisions")
"""Need the Python of another environment, or another checkout: `all` does not run them."""


def names() -> list[str]:
    """The modules of this folder that have a function `main`."""
    modules = (path for path in FOLDER.glob("*.py") if path.stem != "__main__")
    return sorted(path.stem for path in modules if "\ndef main(" in path.read_text())


class Benchmarks(TyperGroup):
    """One command for each benchmark, whose module is imported when the command is used."""

    def list_commands(self, ctx: typer.Context) -> list[str]:
        """The benchmarks, and `all`."""
        return [*names(), *super().list_commands(ctx)]

    def get_command(self, ctx: typer.Context, cmd_name: str) -> Any:
        """The command of a benchmark."""
        if cmd_name not in names():
            return super().get_command(ctx, cmd_name)
        module = import_module(f"benchmarks.{cmd_name}")
        command = typer.Typer(add_completion=False, rich_markup_mode=None)
        # \b keeps the line breaks of a paragraph.
        command.command(cmd_name, help=(module.__doc__ or "").replace("\n\n", "\n\n\b\n"))(module.main)
        return typer.main.get_command(command)

    def format_commands(self, ctx: typer.Context, formatter: Any) -> None:  # noqa: ARG002
        """List the benchmarks without importing them."""
        docstrings = {name: ast.get_docstring(ast.parse((FOLDER / f"{name}.py").read_text())) for name in names()}
        with formatter.section("Benchmarks"):
            captions = {name: " ".join((text or "").partition("\n\n")[0].split()) for name, text in docstrings.items()}
            formatter.write_dl([*captions.items(), ("all", run_all.__doc__ or "")])


def report(targets: Iterator[Target] | None, save: bool) -> None:
    """Print the results as they come, and record them if wanted. Exits with 1 if a target is missed."""
    results = []
    for target in targets or ():
        print(target, flush=True)
        results.append(target)
    if save and results:
        record(sys.argv[sys.argv.index("--record") + 1], " ".join(sys.argv[sys.argv.index("--record") + 2 :]), results)
    if not all(target.met for target in results):
        raise typer.Exit(1)


app = typer.Typer(cls=Benchmarks, add_completion=False, rich_markup_mode=None, result_callback=report)


@app.callback()
def _options(
    save: Annotated[bool, typer.Option("--record", help="add the results to benchmarks/results")] = False,
) -> None:
    """Measurements of this code, most of them against a peer in the same run."""


@app.command("all")
def run_all(quick: Quick = False) -> None:
    """Run all benchmarks but `learner` and `revisions`, each in a process of its own, which has its own Ray."""
    options = ["--quick"] if quick else []
    failed = []
    for name in names():
        if name not in NEED_ARGUMENTS:
            print(f"\n== {name} ==", flush=True)
            if subprocess.run([sys.executable, "-m", "benchmarks", name, *options], cwd=ROOT).returncode:
                failed.append(name)
    if failed:
        print(f"\nfailed: {', '.join(failed)}", file=sys.stderr)
        raise typer.Exit(1)


if __name__ == "__main__":
    app()
