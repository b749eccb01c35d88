"""The documentation is correct: the names in it exist, and its examples are valid."""

import ast
import re
import runpy
import shlex
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml
from markdown.extensions.toc import slugify
from typer.core import TyperGroup

from league.config.algorithms import ALGORITHMS
from league.config.league import LeagueConfig
from league.config.marwil import MARWILConfig
from policy_league.cli.main import app
from serve_app.openapi.document import document
from serve_app.runtime import haproxy_script
from serve_app.settings import ServeSettings

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
README = ROOT / "README.md"
PAGES = [README, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted(DOCS.rglob("*.md"))]
PACKAGES = {name: ROOT / name for name in ("evaluation", "league", "policy_league", "serve_app", "training")} | {
    "policy_league_client": ROOT / "clients/python/policy_league_client"
}
FOLDERS = (*PACKAGES, "benchmarks", "clients", "deploy", "docs", "scripts", "tests")
COMMANDS = typer.main.get_command(app).commands  # type: ignore[attr-defined]


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def fenced(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), flags=re.S | re.M)


def code(page: Path) -> list[str]:
    """Text in backquotes outside of fenced blocks."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.S | re.M)
    return re.findall(r"`([^`\n]+)`", text)


def shell_lines() -> list[tuple[str, str]]:
    lines = []
    for page in PAGES:
        for block in fenced(page, "sh"):
            lines += [(name_of(page), line) for line in block.splitlines() if line.strip()]
    return lines


@pytest.mark.parametrize(("page", "line"), [pair for pair in shell_lines() if pair[1].startswith("league ")])
def test_each_shown_command_exists_with_its_options(page: str, line: str) -> None:
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
        if re.fullmatch(r"policy_league/configs/.*", argument):
            assert (ROOT / argument).exists(), f"{page}: {line}"


@pytest.mark.parametrize(("page", "line"), [pair for pair in shell_lines() if pair[1].startswith("make ")])
def test_each_shown_make_target_exists(page: str, line: str) -> None:
    target = shlex.split(line, comments=True)[1]
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), flags=re.M), f"{page}: {line}"


def test_each_command_is_in_the_readme() -> None:
    text = README.read_text()
    assert [name for name in COMMANDS if f"league {name}" not in text] == []


def test_each_json_document_is_described() -> None:
    headings = " ".join(re.findall(r"^## (.+)$", (DOCS / "json.md").read_text(), flags=re.M))
    missing = [
        name
        for name, command in COMMANDS.items()
        for each in (command.commands.values() if isinstance(command, TyperGroup) else [command])
        if any("--json" in parameter.opts for parameter in each.params) and f"league {name}" not in headings
    ]
    assert missing == []


def test_entries_of_docstrings_describe_the_fields_of_json_documents() -> None:
    text = MADE[DOCS / "json-documents.md"]()
    assert "| `bound` | number | What a best response scores at least" in text
    assert "| `by_side[side][i][j]`: the same" in text
    assert "`curve`" not in text, "it is not printed"
    assert not re.findall(r"\. [a-z_]+(?:, [a-z_]+)*: |None", text), "an entry without its field"


def test_the_readme_is_short() -> None:
    assert len(README.read_text().splitlines()) <= 120


MODULE_INDEX = runpy.run_path(str(ROOT / "scripts/module_index.py"))["page"]
REFERENCES = runpy.run_path(str(ROOT / "scripts/references.py"))
MADE = {
    DOCS / "modules.md": MODULE_INDEX,
    DOCS / "http-reference.md": REFERENCES["http_page"],
    DOCS / "json-documents.md": REFERENCES["documents_page"],
}
"""Pages that scripts/mkdocs_hooks.py makes from the code."""


@cache
def anchors(page: Path) -> set[str]:
    text = MADE[page]() if page in MADE else page.read_text()
    text = re.sub(r"^```.*?^```", "", text, flags=re.S | re.M)
    return {slugify(heading.replace("`", ""), "-") for heading in re.findall(r"^#+ (.+)$", text, flags=re.M)}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_each_link_has_a_target(page: Path) -> None:
    for target, anchor in re.findall(r"\]\(([^)#]*)(?:#([^)]*))?\)", page.read_text()):
        if target.startswith(("http:", "https:")):
            continue
        linked = (page.parent / target).resolve() if target else page
        assert linked in MADE or linked.exists(), f"{name_of(page)} links to {target}"
        if anchor:
            assert anchor in anchors(linked), f"{name_of(page)} links to {target}#{anchor}"


def test_each_page_is_in_the_navigation() -> None:
    text = (ROOT / "mkdocs.yml").read_text()
    listed = re.findall(r"[\w/-]+\.md$", text, flags=re.M)
    pages = {page.relative_to(DOCS).as_posix() for page in (*DOCS.rglob("*.md"), *MADE)}
    assert sorted(listed) == sorted(pages | COPIED)


COPIED = {"contributing.md", "changelog.md"}
"""Pages that scripts/mkdocs_hooks.py makes from CONTRIBUTING.md and CHANGELOG.md."""


@pytest.mark.slow
def test_the_site_is_built_without_warnings(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
    assert (tmp_path / "search/search_index.json").exists()
    loaded = [
        link
        for page in tmp_path.rglob("*.html")
        for link in re.findall(r"<(?:script|img|link)[^>]* (?:src|href)=\"?(https?://[^\" >]*)", page.read_text())
    ]
    assert loaded == [], "the site must work offline"


@pytest.mark.parametrize(
    ("page", "block"),
    [(name_of(page), block) for page in PAGES for block in fenced(page, "yaml") if block.startswith("league:")],
)
def test_each_shown_league_is_a_valid_configuration(page: str, block: str) -> None:
    LeagueConfig.from_mapping(yaml.safe_load(block), source=page)


EXAMPLES = {"league", "environment.entry_point", "policies", "sides", "gate.anchors"}
"""Keys whose values in the sample are examples: they are required, or their default is computed or empty."""


def differing_keys(sample: Any, defaults: Any, key: str = "") -> Iterator[str]:
    if key in EXAMPLES:
        return
    if isinstance(sample, dict) and isinstance(defaults, dict):
        for name, value in sample.items():
            yield from differing_keys(value, defaults.get(name, "no such key"), f"{key}.{name}".strip("."))
    elif sample != defaults:
        yield f"{key}: {sample!r}, default {defaults!r}"


def test_the_sample_of_all_keys_shows_the_defaults() -> None:
    sample = yaml.safe_load(fenced(DOCS / "configuration.md", "yaml")[0])
    required = {"league": sample["league"], "environment": {"entry_point": sample["environment"]["entry_point"]}}
    defaults = LeagueConfig.from_mapping(required).model_dump(by_alias=True, mode="json")
    assert list(differing_keys(sample, defaults)) == []


def settings_of(heading: str) -> dict[str, str]:
    """Key → default, from the table below a heading."""
    _, found, section = (DOCS / "configuration.md").read_text().partition(f"\n## {heading}\n")
    assert found, heading
    return dict(re.findall(r"^\| `(\w+)` \| `?(.*?)`? \|", section.partition("\n## ")[0], flags=re.M))


@pytest.mark.parametrize("name", ALGORITHMS)
def test_each_training_setting_is_documented_with_its_default(name: str) -> None:
    model = ALGORITHMS[name]
    parts = ["ppo", name] if model is MARWILConfig else [name]
    rows = settings_of("`training`: all algorithms")
    for part in parts:
        rows |= settings_of(f"`training` with `algorithm: {part}`")
    assert set(rows) == {field.alias or key for key, field in model.model_fields.items()}
    required = {key: "games" for key, field in model.model_fields.items() if field.is_required() and key != "algorithm"}
    document = {"algorithm": name} | required
    assert all(rows[key] == "required" for key in required)
    unused = MARWILConfig.unused if model is MARWILConfig else ()
    for key in rows.keys() - document.keys() - set(unused):
        shown = yaml.safe_load(rows[key]) if rows[key] != "–" else None
        default = model.model_validate(document).model_dump(by_alias=True)[key]
        assert model.model_validate(document | {key: shown}).model_dump(by_alias=True)[key] == default


def test_each_module_is_in_the_module_index() -> None:
    files = {
        name_of(path)
        for package in PACKAGES.values()
        for path in package.rglob("*.py")
        if path.name != "__init__.py" and path.parent.parent.name != "migrations"
    }
    listed = re.findall(r"^\| `([\w/]+\.py)` \| \S", MODULE_INDEX(), flags=re.M)
    assert sorted(listed) == sorted(files)


@cache
def top_level_names(module: Path) -> set[str]:
    """Names defined at the top level of a module, and those that it imports."""
    names = set()
    top_level = ast.parse(module.read_text()).body
    for node in [*top_level, *chain.from_iterable(node.body for node in top_level if isinstance(node, ast.If))]:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.ImportFrom | ast.Import):
            names |= {alias.asname or alias.name for alias in node.names}
        elif isinstance(node, ast.Assign):
            names |= {target.id for target in node.targets if isinstance(target, ast.Name)}
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            names.add(node.target.id)
    return names


def exists(dotted: str) -> bool:
    """Whether a dotted name is a package, a module, or defined in one."""
    parts = dotted.split(".")
    for length in range(len(parts), 0, -1):
        path = PACKAGES.get(parts[0], ROOT / parts[0]).joinpath(*parts[1:length])
        module = path.with_suffix(".py") if path.with_suffix(".py").exists() else path / "__init__.py"
        if module.exists():
            rest = parts[length:]
            return not rest or rest[0] in top_level_names(module)
    return False


SETTINGS = {
    f"training.{field.alias or key}" for model in ALGORITHMS.values() for key, field in model.model_fields.items()
}
"""Keys of a configuration, which look like names of modules."""


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_each_named_module_and_file_exists(page: Path) -> None:
    packages = "|".join((*PACKAGES, "benchmarks", "tests"))
    text = page.read_text()
    quoted = " ".join(code(page))
    dotted = re.findall(rf"(?<![\w./-])(?:{packages})(?:\.[A-Za-z_]\w*)+", quoted)
    dotted += re.findall(r"^::: ([\w.]+)$", text, flags=re.M)
    dotted += re.findall(rf"python -m ((?:{packages})[\w.]*)", text)
    dotted += re.findall(rf"^from ((?:{packages})[\w.]*) import", text, flags=re.M)
    files = ("db", "gif", "html", "js", "json", "jsonl", "md", "py", "yaml", "yml")
    unknown = [name for name in dotted if name.rpartition(".")[2] not in files and not exists(name)]
    unknown = [name for name in unknown if name not in SETTINGS]
    paths = re.findall(rf"(?<![\w./-])((?:{'|'.join(FOLDERS)})/[\w./-]*\w)", quoted)
    unknown += [path for path in paths if not (ROOT / path).exists()]
    assert unknown == []


@pytest.mark.parametrize("page", sorted((DOCS / "walkthroughs").glob("*.md")), ids=name_of)
def test_a_walkthrough_links_to_at_most_five_files(page: Path) -> None:
    assert 1 <= len(set(re.findall(r"\]\((\.\./\.\./[^)]+)\)", page.read_text()))) <= 5


def test_each_documented_call_of_the_server_exists() -> None:
    text = (DOCS / "http.md").read_text()
    paths = document(ServeSettings(), [])["paths"]
    operations = {(method.upper(), path) for path, item in paths.items() for method in item if method != "parameters"}
    calls = set(re.findall(r"\b(GET|POST|PUT|DELETE) +(/v1/[^\s`?]*)", text))
    assert calls
    assert {call for call in calls if "…" not in call[1]} <= operations


def test_each_error_of_the_server_is_documented() -> None:
    text = (DOCS / "http.md").read_text()
    codes = set(re.findall(r"`([a-z_]+)`", text.partition("\n## Errors\n")[2].partition("\n## ")[0]))
    of_haproxy = {code for _, code, _ in haproxy_script.ERRORS.values()}
    assert codes == set(error_codes(document(ServeSettings(), []))) | of_haproxy | {"method_not_allowed"}


def error_codes(node: Any) -> Iterator[str]:
    """The values of `code` in a part of the OpenAPI document."""
    if isinstance(node, dict):
        if isinstance(code := node.get("code"), dict):
            yield from code.get("enum", ())
        node = list(node.values())
    for child in node if isinstance(node, list) else ():
        yield from error_codes(child)


def test_the_code_of_the_tutorial_runs(capsys: pytest.CaptureFixture[str]) -> None:
    page = DOCS / "vectorised-environments.md"
    example = "".join((ROOT / "policy_league/examples/kuhn_poker_vector.py").read_text().split())
    names: dict[str, object] = {}
    for block in fenced(page, "python"):
        # Methods of the example have another indentation and other line breaks on the page.
        if "".join(block.split()) not in example:
            exec(compile(block, str(page), "exec"), names)
    printed = capsys.readouterr().out
    shown = fenced(page, "text")
    assert shown
    assert [text for text in shown if text not in printed] == []


RETIRED = (
    r"\bstudio",
    r"\bkeeper\b",
    r"\bchronicle\b",
    r"\bkeyring\b",
    r"\bsitting\b",
    r"\bexhibition",
    r"\bhouse\b",
    r"\bamiss\b",
    r"\bstrangers?\b",
    r"who beats whom",
    r"who stands where",
)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_no_page_uses_a_retired_term(page: Path) -> None:
    text = page.read_text()
    assert [term for term in RETIRED if re.search(term, text, flags=re.I)] == []


def test_each_environment_variable_of_ours_is_documented() -> None:
    used = set()
    for package in PACKAGES.values():
        for path in package.rglob("*.py"):
            used |= set(re.findall(r"\bLEAGUE_[A-Z_]+\b", path.read_text()))
    listed = re.findall(r"^\| `(LEAGUE_\w+)` \|", (DOCS / "environment-variables.md").read_text(), flags=re.M)
    assert sorted(listed) == sorted(used)
