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


def test_a_library_is_identified_by_its_version_and_those_of_its_imports() -> None:
    code = read("pettingzoo.classic.leduc_holdem_v4")
    assert code.libraries == {name: version(name) for name in ("gymnasium", "numpy", "pettingzoo", "rlcard")}
    assert code.source == read("mpe2.simple_spread_v3").source


@pytest.mark.parametrize("folder", ["site-packages", "dist-packages"])
def test_libraries_of_the_system_and_of_other_environments_are_libraries(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str
) -> None:
    """A virtual environment can have several folders of libraries (`--system-site-packages`)."""
    libraries = tmp_path / "usr" / "lib" / folder
    metadata = libraries / "wood-1.2.dist-info" / "METADATA"
    metadata.parent.mkdir(parents=True)
    metadata.write_text("Metadata-Version: 2.1\nName: wood\nVersion: 1.2\n")
    (libraries / "wood.py").write_text("import scipy\n")
    monkeypatch.syspath_prepend(str(libraries))
    (package / "rules.py").write_text("import wood\n")
    code = read()
    assert code.libraries == {"numpy": version("numpy"), "wood": "1.2"}
    (libraries / "wood.py").write_text("WIN = 1\n")
    assert read() == code


@pytest.mark.parametrize("encoding", ["utf-8-sig", "latin-1"])
def test_sources_are_read_in_their_encoding(tmp_path: Path, encoding: str) -> None:
    (tmp_path / "tiles.py").write_text(f"# coding: {encoding}\n# für\nimport numpy\nimport grout\n", encoding=encoding)
    before = read_in(tmp_path, "tiles:env", grout="WIN = 1\n")
    after = read_in(tmp_path, "tiles:env", grout="WIN = 2\n")
    assert before.source != after.source
    assert before.libraries == after.libraries == {"numpy": version("numpy")}


def test_modules_of_a_league_come_from_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not from another folder on the path, and not from a module of the same name that is loaded."""
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "grout.py").write_text(f"NAME = '{name}'\n")
    monkeypatch.syspath_prepend(str(tmp_path / "one"))
    code = read_in(tmp_path / "two", "tiles:env", tiles="import grout\nimport yaml\n", yaml="")
    assert code.files["grout"] == str(tmp_path / "two" / "grout.py")
    assert "PyYAML" in code.libraries, "a file of the folder does not replace a library"


def read_in(folder: Path, entry_point: str, **files: str) -> EnvironmentCode:
    """Read the code of an environment in a league's folder, where these modules are written first."""
    for name, text in files.items():
        (folder / f"{name}.py").write_text(text)
    environment_code.cache_clear()
    return environment_code(entry_point, str(folder))


def test_each_imported_module_decides_and_no_other(package: Path) -> None:
    assert read("no_such_package.game:env").libraries == {}
    before = read()
    (package / "train.py").write_text("EPOCHS = 3\n")
    assert read() == before
    sources = {before.source}
    for name in ("game.py", "rules.py", "board.py", "__init__.py"):
        (package / name).write_text((package / name).read_text() + "# edited\n")
        code = read()
        assert code.source not in sources
        assert code.libraries == before.libraries == {"numpy": version("numpy")}
        sources.add(code.source)
    for text in ("def (:\n", "def (:  \n"):  # what is not Python is compared as text
        (package / "rules.py").write_text(text)
        assert read().source not in sources
        sources.add(read().source)


@pytest.mark.parametrize("is_in_folder", [True, False], ids=["folder", "path"])
def test_code_without_a_distribution_is_source_wherever_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_in_folder: bool
) -> None:
    """Such as a project below `site-packages`, or packages that were copied there by hand."""
    folder = tmp_path / "install" / "site-packages"
    folder.mkdir(parents=True)
    if not is_in_folder:
        monkeypatch.syspath_prepend(str(folder))
    codes = []
    for text in ("import numpy\nWIN = 1\n", "import numpy\nWIN = 2\n"):
        (folder / "tiles.py").write_text(text)
        environment_code.cache_clear()
        codes.append(environment_code("tiles:env", str(folder) if is_in_folder else None))
    assert codes[0].source != codes[1].source
    assert codes[0].libraries == codes[1].libraries == {"numpy": version("numpy")}


def test_the_users_modules_may_have_any_name(tmp_path: Path) -> None:
    """That of a distribution or of the standard library, and may try an import beyond their package."""
    folder = tmp_path / "site-packages"
    folder.mkdir()
    assert read_in(folder, "yaml:env", yaml="WIN = 1\n").libraries == {}
    assert set(read_in(tmp_path, "turtle:env", turtle="import numpy\n").files) == {"turtle"}
    tiles = "try:\n    from .grout import WIN\nexcept ImportError:\n    from grout import WIN\n"
    assert set(read_in(tmp_path, "tiles:env", tiles=tiles, grout="WIN = 1\n").files) == {"tiles", "grout"}
