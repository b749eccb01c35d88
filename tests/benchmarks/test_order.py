"""`make bench` runs every benchmark, and accepts `--quick`."""

from pathlib import Path

from benchmarks.__main__ import ORDER

FOLDER = Path("benchmarks")
OF_TWO_CHECKOUTS = "revisions"


def test_every_benchmark_is_run() -> None:
    programs = {path.stem for path in FOLDER.glob("*.py") if 'if __name__ == "__main__"' in path.read_text()}
    assert set(ORDER) == programs - {OF_TWO_CHECKOUTS, "__main__"}


def test_every_benchmark_has_a_quick_form() -> None:
    assert [name for name in ORDER if '"--quick"' not in (FOLDER / f"{name}.py").read_text()] == []
