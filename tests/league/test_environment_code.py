"""The code of an environment is found by its imports, without executing it."""

from importlib.metadata import version
from pathlib import Path

import pytest

from league.environment_code import EnvironmentCode, environment_code


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package `bricks` whose environment imports its rules and NumPy, and fails if it is executed."""
    monkeypatch.syspath_prepend(str(tmp_path))
    folder = tmp_path / "bricks"
    folder.mkdir()
    (folder / "__init__.py").write_text("raise RuntimeError\n")
    (folder / "game.py").write_text(
        "import math\nimport numpy as np\nfrom . import rules\nfrom bricks.board import *\n"
    )
    (folder / "rules.py").write_text("WIN = 1\n")
    (folder / "board.py").write_text("def draw():\n    import pygame\n")
    (folder / "train.py").write_text("import bricks.game\n")
    return folder


def read(entry_point: str = "bricks.game:env") -> EnvironmentCode:
    environment_code.cache_clear()
    return environment_code(entry_point)


@pytest.mark.parametrize("name", ["game.py", "rules.py", "board.py", "__init__.py"])
def test_each_imported_module_decides(package: Path, name: str) -> None:
    before = read()
    (package / name).write_text((package / name).read_text() + "# edited\n")
    after = read()
    assert after.source != before.source
    assert after.libraries == before.libraries == {"numpy": version("numpy")}


def test_modules_that_are_not_imported_do_not_decide(package: Path) -> None:
    before = read()
    (package / "train.py").write_text("EPOCHS = 3\n")
    assert read() == before


def test_a_library_is_identified_by_its_version_and_those_of_its_imports() -> None:
    code = read("pettingzoo.classic.leduc_holdem_v4")
    assert code.libraries == {name: version(name) for name in ("gymnasium", "numpy", "pettingzoo", "rlcard")}
    assert code.source == read("mpe2.simple_spread_v3").source


def test_a_module_that_does_not_exist_has_no_code() -> None:
    assert read("no_such_package.game:env").libraries == {}


def test_a_module_that_is_not_python_is_compared_as_text(package: Path) -> None:
    (package / "rules.py").write_text("def (:\n")
    before = read()
    (package / "rules.py").write_text("def (:  \n")
    assert read().source != before.source
