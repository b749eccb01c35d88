import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from league import entry_points
from league.config.league import LeagueConfig
from league.entry_points import import_entry_point, import_module
from league.environment_code import environment_code
from league.environments.building import build
from league.errors import ConfigError

GAME = "from pettingzoo.classic.tictactoe_v3 import env\n\ndef make_env():\n    return env()\n"


@pytest.fixture(autouse=True)
def own_search_path(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Forget the folders and modules of each test."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(entry_points, "_folders", [])
    before = set(sys.modules)
    yield
    for name in [name for name in sys.modules if name not in before and name.startswith("own_")]:
        del sys.modules[name]


def write(folder: Path, module: str = "own_game", text: str = GAME) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / f"{module}.py").write_text(text)
    path = folder / "league.yaml"
    path.write_text(f"league: own\nenvironment:\n  entry_point: {module}:make_env\n")
    return path


def test_a_folder_is_relative_to_the_file(tmp_path: Path) -> None:
    write(tmp_path / "source")
    path = tmp_path / "league.yaml"
    path.write_text("league: own\nfolder: source\nenvironment: {entry_point: 'own_game:make_env'}\n")
    build(LeagueConfig.load(path).environment).close()
    path.write_text("league: own\nfolder: nowhere\nenvironment: {entry_point: 'own_game:make_env'}\n")
    with pytest.raises(ConfigError, match=r"league\.yaml: folder: .*nowhere is not a directory"):
        LeagueConfig.load(path)


def test_our_own_packages_are_not_to_be_renamed_in_a_clone() -> None:
    root = str(Path(__file__).parents[2])
    assert import_entry_point("key", "policy_league.examples.two_step:AGENTS", root)
    with pytest.raises(ConfigError, match=r"No module named 'training\.missing'"):
        import_module("key", "training.missing", root)


def test_an_import_error_names_line_and_searched_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    config = LeagueConfig.load(write(tmp_path / "project", text="\nimport own_missing\n"))
    with pytest.raises(ConfigError) as raised:
        build(config.environment)
    message = str(raised.value)
    assert "environment.entry_point: cannot import 'own_game': No module named 'own_missing'" in message
    assert f"{tmp_path}/project/own_game.py, line 2" in message
    assert f"searched: {tmp_path}/project" in message


def test_an_exception_on_import_names_its_line(tmp_path: Path) -> None:
    path = write(tmp_path, text="\n\n1 / 0\n")
    with pytest.raises(ConfigError, match=r"ZeroDivisionError: division by zero \(.*own_game\.py, line 3\)"):
        import_module("key", "own_game", str(path.parent))
    assert "own_game" not in sys.modules


def test_the_environment_next_to_the_file_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From any directory, in a new process, and with the modules that it imports, which do not replace libraries."""
    folder = tmp_path / "project"
    config = LeagueConfig.load(write(folder, text="import colorsys\nfrom own_rules import make_env\n"))
    (folder / "own_rules.py").write_text(GAME)
    (folder / "colorsys.py").write_text("raise RuntimeError('shadowed')")
    sys.modules.pop("colorsys", None)
    monkeypatch.chdir(tmp_path)
    build(config.environment).close()
    assert config.folder == str(folder)
    entry_points._folders.clear()
    sys.path.remove(str(folder))
    build(LeagueConfig.from_mapping(config.model_dump(mode="json", by_alias=True)).environment).close()


@pytest.mark.parametrize("is_installed", [True, False])
def test_the_folder_is_searched_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_installed: bool) -> None:
    """Before the installed packages, and before the working directory, which the command appends to the path."""
    for name in ("here", "there"):
        write(tmp_path / name, text=f"WHERE = {name!r}\n" if is_installed else "from own_rules import *\n")
        (tmp_path / name / "own_rules.py").write_text(f"WHERE = {name!r}\n")
    monkeypatch.chdir(tmp_path / "here")
    sys.path.insert(0 if is_installed else len(sys.path), str(tmp_path / "here"))
    config = LeagueConfig.load(tmp_path / "there" / "league.yaml")
    assert import_entry_point("key", "own_game:WHERE", config.folder) == "there"


def test_modules_of_a_folder_on_the_path_are_not_confused_with_those_of_a_league(tmp_path: Path) -> None:
    for name in ("one", "two"):
        write(tmp_path / name, f"own_{name}", "from own_rules import *\n")
        (tmp_path / name / "own_rules.py").write_text(f"WHERE = {name!r}\n")
    sys.path.insert(0, str(tmp_path / "one"))
    config = LeagueConfig.load(tmp_path / "two" / "league.yaml")
    with pytest.raises(ConfigError, match=r"'own_rules' is the name of several modules, .*two.* and .*one.*: rename"):
        import_module("key", "own_two", config.folder)


def test_two_leagues_with_modules_of_one_name_are_an_error(tmp_path: Path) -> None:
    first, second = (LeagueConfig.load(write(tmp_path / name)) for name in ("a", "b"))
    assert first.game_digest() == second.game_digest(), "the folder is no part of the game"
    assert str(tmp_path) not in first.environment.model_dump_json()
    build(first.environment).close()
    with pytest.raises(ConfigError, match="'own_game' is the name of several modules") as raised:
        build(second.environment)
    assert f"{tmp_path}/b/own_game.py and {tmp_path}/a/own_game.py" in str(raised.value)
    write(tmp_path / "b", text=GAME + "\n# another rule\n")
    environment_code.cache_clear()
    codes = {environment_code("own_game:make_env", str(tmp_path / name)).source for name in ("a", "b")}
    assert len(codes) == 2


@pytest.mark.parametrize("is_package", [True, False], ids=["package", "folder"])
def test_what_has_the_name_of_one_of_our_packages_is_to_be_renamed(tmp_path: Path, is_package: bool) -> None:
    folder = tmp_path / "training"
    folder.mkdir()
    if is_package:
        (folder / "__init__.py").touch()
    (folder / "envs.py").write_text(GAME)
    for module, text in (
        ("training.envs", GAME),
        ("own_game", "from training.envs import make_env"),
        ("own_game", "from training import envs"),
    ):
        write(tmp_path, text=text)
        with pytest.raises(ConfigError) as raised:
            import_entry_point("environment.entry_point", f"{module}:make_env", str(tmp_path))
        assert str(raised.value) == (
            f"environment.entry_point: {folder} has the name of a package of Policy League: rename it"
        )
    config = LeagueConfig.load(write(tmp_path, "evaluation"))
    with pytest.raises(ConfigError, match=rf"{tmp_path}/evaluation\.py has the name of a package of Policy League"):
        build(config.environment)
