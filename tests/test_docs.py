"""The documentation is true: what it names exists, and what it shows parses."""

import re
import shlex
from pathlib import Path

import pytest
import typer
import yaml
from typer.core import TyperGroup

from cli.main import app
from league.config import LeagueConfig
from league.training_config import ALGORITHMS

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
ROOMS = ("cli", "evaluation", "examples", "league", "serve_app", "training")
COMMANDS = typer.main.get_command(app).commands  # type: ignore[attr-defined]


def fenced(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), flags=re.S | re.M)


def shell_lines() -> list[tuple[str, str]]:
    lines = []
    for page in PAGES:
        for block in fenced(page, "sh"):
            lines += [(page.name, line) for line in block.splitlines() if line.strip()]
    return lines


@pytest.mark.parametrize(("page", "line"), [pair for pair in shell_lines() if pair[1].startswith("league ")])
def test_each_command_shown_exists_with_its_options(page: str, line: str) -> None:
    _, name, *arguments = shlex.split(line, comments=True)
    assert name in COMMANDS, f"{page}: {line}"
    command = COMMANDS[name]
    if isinstance(command, TyperGroup):
        assert arguments[0] in command.commands, f"{page}: {line}"
        command = command.commands[arguments.pop(0)]
    known = {option for parameter in command.params for option in parameter.opts}
    for argument in arguments:
        if argument.startswith("--"):
            assert argument.partition("=")[0] in known, f"{page}: {line}"


@pytest.mark.parametrize(("page", "line"), [pair for pair in shell_lines() if pair[1].startswith("make ")])
def test_each_make_target_shown_exists(page: str, line: str) -> None:
    target = shlex.split(line, comments=True)[1]
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), flags=re.M), f"{page}: {line}"


def test_every_command_is_in_the_readme() -> None:
    text = (ROOT / "README.md").read_text()
    assert {name for name in COMMANDS if f"league {name}" not in text} <= {"demo"}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_each_link_leads_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", page.read_text()):
        if not target.startswith(("http:", "https:")):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


@pytest.mark.parametrize(
    ("page", "block"),
    [(page.name, block) for page in PAGES for block in fenced(page, "yaml") if block.startswith("league:")],
)
def test_each_league_shown_is_a_valid_configuration(page: str, block: str) -> None:
    LeagueConfig.from_mapping(yaml.safe_load(block), source=page)


def settings_of(heading: str) -> dict[str, str]:
    """Key → default, as the table below a heading shows them."""
    _, _, section = (ROOT / "docs/configuration.md").read_text().partition(f"\n## {heading}\n")
    return dict(re.findall(r"^\| `(\w+)` \| `?(.*?)`? \|", section.partition("\n## ")[0], flags=re.M))


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_training_setting_is_documented_with_its_default(name: str) -> None:
    model = ALGORITHMS[name]
    rows = settings_of("`training`, whatever the algorithm") | settings_of(f"`training` with `algorithm: {name}`")
    fields = {field.alias or key for key, field in model.model_fields.items()}
    assert set(rows) == fields
    for key in fields:
        if key == "algorithm":
            continue
        shown = yaml.safe_load(rows[key]) if rows[key] != "–" else None
        default = model.model_validate({"algorithm": name}).model_dump(by_alias=True)[key]
        assert model.model_validate({"algorithm": name, key: shown}).model_dump(by_alias=True)[key] == default


def test_every_file_has_a_caption_in_the_architecture_page() -> None:
    text = (ROOT / "docs/architecture.md").read_text()
    files = {
        path.relative_to(ROOT).as_posix()
        for room in ROOMS
        for path in (ROOT / room).rglob("*.py")
        if path.name != "__init__.py" and "versions" not in path.parent.name
    }
    captioned = set(re.findall(r"^\| `([\w/]+\.py)` \|", text, flags=re.M))
    assert captioned == files


def test_every_environment_variable_of_ours_is_documented() -> None:
    used = set()
    for room in ROOMS:
        for path in (ROOT / room).rglob("*.py"):
            used |= set(re.findall(r"\bLEAGUE_[A-Z_]+\b", path.read_text()))
    readme = (ROOT / "README.md").read_text()
    assert {name for name in used if name not in readme} == set()
