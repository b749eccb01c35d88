"""`make bench` runs every benchmark, and accepts `--quick`."""

from pathlib import Path

from benchmarks.__main__ import ORDER

FOLDER = Path("benchmarks")
OF_TWO_CHECKOUTS = "revisions"


def test_every_benchmark_is_run() -> None:
    programs = {path.stem for path in FOLDER.glob("*.py") if 'if __name__ == "__main__"' in path.read_text()}
    packages = {path.parent.name for path in FOLDER.glob("*/__main__.py")}
    assert set(ORDER) == (programs | packages) - {OF_TWO_CHECKOUTS, "__main__"}


def test_every_benchmark_has_a_quick_form() -> None:
    modules = {name: FOLDER / f"{name}.py" for name in ORDER}
    programs = {name: path if path.exists() else FOLDER / name / "__main__.py" for name, path in modules.items()}
    assert [name for name, path in programs.items() if '"--quick"' not in path.read_text()] == []
