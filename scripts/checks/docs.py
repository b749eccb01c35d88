"""The documentation is correct: what it names exists, its examples are valid, and nothing is missing."""

import ast
import re
import runpy
import shlex
from collections.abc import Iterator
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any

import typer
import yaml
from markdown.extensions.toc import slugify
from typer.core import TyperGroup

from league.config.algorithms import ALGORITHMS
from league.config.league import LeagueConfig
from league.config.marwil import MARWILConfig
from league.errors import LeagueError
from policy_league.cli.main import app
from serve_app.openapi.document import document
from serve_app.runtime import haproxy_script
from serve_app.settings import ServeSettings

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
README = ROOT / "README.md"
PAGES = [README, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted(DOCS.rglob("*.md"))]
PACKAGES = {name: ROOT / name for name in ("evaluation", "league", "policy_league", "serve_app", "training")} | {
    "policy_league_client": ROOT / "clients/python/policy_league_client"
}
FOLDERS = (*PACKAGES, "benchmarks", "clients", "deploy", "docs", "scripts", "tests")
COMMANDS = typer.main.get_command(app).commands  # type: ignore[attr-defined]
MODULE_INDEX = runpy.run_path(str(ROOT / "scripts/module_index.py"))["page"]
REFERENCES = runpy.run_path(str(ROOT / "scripts/references.py"))
MADE = {
    DOCS / "modules.md": MODULE_INDEX,
    DOCS / "http-reference.md": REFERENCES["http_page"],
    DOCS / "json-documents.md": REFERENCES["documents_page"],
}
"""Pages that scripts/mkdocs_hooks.py makes from the code."""
COPIED = {"contributing.md", "changelog.md"}
"""Pages that scripts/mkdocs_hooks.py makes from CONTRIBUTING.md and CHANGELOG.md."""
RETIRED = re.compile(
    r"\bstudio|\bkeeper\b|\bchronicle\b|\bkeyring\b|\bsitting\b|\bexhibition|\bhouse\b|\bamiss\b|\bstrangers?\b"
    r"|who beats whom|who stands where",
    flags=re.I,
)
EXAMPLES = {"league", "environment.entry_point", "policies", "sides", "gate.anchors"}
"""Keys whose values in the sample are examples: they are required, or their default is computed or empty."""
SETTINGS = {
    f"training.{field.alias or key}" for model in ALGORITHMS.values() for key, field in model.model_fields.items()
}
"""Keys of a configuration, which look like names of modules."""


def name_of(page: Path) -> str:
    """The path of a page below the root."""
    return page.relative_to(ROOT).as_posix()


def fenced(page: Path, language: str) -> list[str]:
    """The code blocks of a page in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), flags=re.S | re.M)


def shell_lines() -> Iterator[tuple[str, list[str]]]:
    """(page and line, words) of every shown command of ours."""
    for page in PAGES:
        for line in re.findall(r"^(?:league|make) .+", "".join(fenced(page, "sh")), flags=re.M):
            yield f"{name_of(page)}: {line}", shlex.split(line, comments=True)


def check_commands() -> Iterator[str]:
    """Each shown command exists, with its options."""
    targets = " ".join(re.findall(r"^([a-z][\w -]*):", (ROOT / "Makefile").read_text(), flags=re.M)).split()
    for place, (program, *arguments) in shell_lines():
        if program == "make":
            if arguments[0] not in targets:
                yield f"{place}: no such target"
            continue
        command: Any = COMMANDS.get(arguments.pop(0))
        if isinstance(command, TyperGroup):
            command = command.commands.get(arguments.pop(0))
        if command is None:
            yield f"{place}: no such command"
            continue
        options = {option for parameter in command.params for option in parameter.opts}
        for argument in arguments:
            if argument.startswith("--") and argument.partition("=")[0] not in options:
                yield f"{place}: no option {argument}"
            if argument.startswith("policy_league/configs/") and not (ROOT / argument).exists():
                yield f"{place}: no file {argument}"


def check_readme() -> Iterator[str]:
    """The README has every command, and is short."""
    text = README.read_text()
    for name in COMMANDS:
        if f"league {name}" not in text:
            yield f"README.md: `league {name}` is missing"
    if text.count("\n") > 120:
        yield "README.md: more than 120 lines"


def check_json_documents() -> Iterator[str]:
    """docs/json.md describes the output of each command with --json, and entries of docstrings the fields."""
    headings = " ".join(re.findall(r"^## (.+)$", (DOCS / "json.md").read_text(), flags=re.M))
    for name, command in COMMANDS.items():
        commands = command.commands.values() if isinstance(command, TyperGroup) else [command]
        with_json = any("--json" in parameter.opts for command in commands for parameter in command.params)
        if with_json and f"league {name}" not in headings:
            yield f"docs/json.md: no heading for `league {name}`"
    text = MADE[DOCS / "json-documents.md"]()
    for row in ("| `bound` | number | What a best response scores at least", "| `by_side[side][i][j]`: the same"):
        if row not in text:
            yield f"docs/json-documents.md: {row}… is missing"
    for entry in ("`curve`", *re.findall(r"\. [a-z_]+(?:, [a-z_]+)*: |None", text)):
        if entry in text:
            yield f"docs/json-documents.md: {entry}: not printed, or an entry without its field"


@cache
def anchors(page: Path) -> set[str]:
    """The anchors of the headings of a page."""
    text = MADE[page]() if page in MADE else page.read_text()
    text = re.sub(r"^```.*?^```", "", text, flags=re.S | re.M)
    return {slugify(heading.replace("`", ""), "-") for heading in re.findall(r"^#+ (.+)$", text, flags=re.M)}


def check_links() -> Iterator[str]:
    """Each link has a target, each page is in the navigation, and a walkthrough links to at most five files."""
    for page in PAGES:
        for target, anchor in re.findall(r"\]\(([^)#]*)(?:#([^)]*))?\)", page.read_text()):
            if target.startswith(("http:", "https:")):
                continue
            path = (page.parent / target).resolve() if target else page
            if not (path in MADE or path.exists()) or (anchor and anchor not in anchors(path)):
                yield f"{name_of(page)}: no {target}{anchor and '#'}{anchor}"
    navigation = set(re.findall(r"[\w/-]+\.md$", (ROOT / "mkdocs.yml").read_text(), flags=re.M))
    for name in navigation ^ ({page.relative_to(DOCS).as_posix() for page in (*DOCS.rglob("*.md"), *MADE)} | COPIED):
        yield f"mkdocs.yml: {name}: in the navigation or in docs, expected both"
    for page in (DOCS / "walkthroughs").glob("*.md"):
        if not 1 <= len(set(re.findall(r"\]\((\.\./\.\./[^)]+)\)", page.read_text()))) <= 5:
            yield f"{name_of(page)}: expected links to one to five files"


def check_configurations() -> Iterator[str]:
    """Each shown league is valid, and the sample of all keys shows the defaults."""
    for page in PAGES:
        for block in fenced(page, "yaml"):
            if block.startswith("league:"):
                try:
                    LeagueConfig.from_mapping(yaml.safe_load(block), source=name_of(page))
                except LeagueError as error:
                    yield str(error)
    sample = yaml.safe_load(fenced(DOCS / "configuration.md", "yaml")[0])
    required = {"league": sample["league"], "environment": {"entry_point": sample["environment"]["entry_point"]}}
    yield from differing_keys(sample, LeagueConfig.from_mapping(required).model_dump(by_alias=True, mode="json"))


def differing_keys(sample: Any, defaults: Any, key: str = "") -> Iterator[str]:
    """Keys of the sample with another value than the default."""
    if key in EXAMPLES:
        return
    if isinstance(sample, dict) and isinstance(defaults, dict):
        for name, value in sample.items():
            yield from differing_keys(value, defaults.get(name, "no such key"), f"{key}.{name}".strip("."))
    elif sample != defaults:
        yield f"docs/configuration.md: {key}: {sample!r}, default {defaults!r}"


def settings_of(heading: str) -> dict[str, str]:
    """Key → default, from the table below a heading."""
    section = (DOCS / "configuration.md").read_text().partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    return dict(re.findall(r"^\| `(\w+)` \| `?(.*?)`? \|", section, flags=re.M))


def check_training_settings() -> Iterator[str]:
    """Each setting of training is documented with its default."""
    for name, model in ALGORITHMS.items():
        rows = settings_of("`training`: all algorithms")
        for part in ["ppo", name] if model is MARWILConfig else [name]:
            rows |= settings_of(f"`training` with `algorithm: {part}`")
        for key in rows.keys() ^ {field.alias or key for key, field in model.model_fields.items()}:
            yield f"docs/configuration.md: {name}: {key}: in the tables or a setting, expected both"
        required = [key for key, field in model.model_fields.items() if field.is_required() and key != "algorithm"]
        configuration = {"algorithm": name} | dict.fromkeys(required, "games")
        unused = MARWILConfig.unused if model is MARWILConfig else ()
        for key in rows.keys() & {field.alias or key for key, field in model.model_fields.items()} - set(unused):
            if key in configuration:
                if key != "algorithm" and rows[key] != "required":
                    yield f"docs/configuration.md: {name}: {key}: {rows[key]}, expected required"
                continue
            value = yaml.safe_load(rows[key]) if rows[key] != "–" else None
            default = model.model_validate(configuration).model_dump(by_alias=True)[key]
            if model.model_validate(configuration | {key: value}).model_dump(by_alias=True)[key] != default:
                yield f"docs/configuration.md: {name}: {key}: {value!r}, default {default!r}"


def check_module_index() -> Iterator[str]:
    """Each module is in the index of modules."""
    files = {
        name_of(path)
        for package in PACKAGES.values()
        for path in package.rglob("*.py")
        if path.name != "__init__.py" and path.parent.parent.name != "migrations"
    }
    for name in files ^ set(re.findall(r"^\| `([\w/]+\.py)` \| \S", MODULE_INDEX(), flags=re.M)):
        yield f"docs/modules.md: {name}: in the index or a module, expected both"


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
            return length == len(parts) or parts[length] in top_level_names(module)
    return False


def check_names_of_modules_and_files() -> Iterator[str]:
    """Each named module and file exists."""
    packages = "|".join((*PACKAGES, "benchmarks", "scripts", "tests"))
    files = ("db", "gif", "html", "js", "json", "jsonl", "md", "py", "yaml", "yml")
    for page in PAGES:
        text = page.read_text()
        quoted = " ".join(re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", text, flags=re.S | re.M)))
        dotted = re.findall(rf"(?<![\w./-])(?:{packages})(?:\.[A-Za-z_]\w*)+", quoted)
        dotted += re.findall(r"^::: ([\w.]+)$", text, flags=re.M)
        dotted += re.findall(rf"python -m ((?:{packages})[\w.]*)", text)
        dotted += re.findall(rf"^from ((?:{packages})[\w.]*) import", text, flags=re.M)
        modules = [name for name in dotted if name.rpartition(".")[2] not in files and name not in SETTINGS]
        paths = re.findall(rf"(?<![\w./-])((?:{'|'.join(FOLDERS)})/[\w./-]*\w)", quoted)
        for name in chain(
            (name for name in modules if not exists(name)), (path for path in paths if not (ROOT / path).exists())
        ):
            yield f"{name_of(page)}: no {name}"


def check_calls_and_errors_of_the_server() -> Iterator[str]:
    """docs/http.md shows existing calls, and describes each error."""
    text = (DOCS / "http.md").read_text()
    schema = document(ServeSettings(), [])
    operations = {
        (method.upper(), path) for path, item in schema["paths"].items() for method in item if method != "parameters"
    }
    for method, path in re.findall(r"\b(GET|POST|PUT|DELETE) +(/v1/[^\s`?]*)", text):
        if "…" not in path and (method, path) not in operations:
            yield f"docs/http.md: no call {method} {path}"
    documented = set(re.findall(r"`([a-z_]+)`", text.partition("\n## Errors\n")[2].partition("\n## ")[0]))
    of_haproxy = {code for _, code, _ in haproxy_script.ERRORS.values()}
    for code in documented ^ {*error_codes(schema), *of_haproxy, "method_not_allowed"}:
        yield f"docs/http.md: {code}: in the section Errors or an error of the server, expected both"


def error_codes(node: Any) -> Iterator[str]:
    """The values of `code` in a part of the OpenAPI document."""
    if isinstance(node, dict):
        if isinstance(code := node.get("code"), dict):
            yield from code.get("enum", ())
        node = list(node.values())
    for child in node if isinstance(node, list) else ():
        yield from error_codes(child)


def check_terms() -> Iterator[str]:
    """No page uses a retired term."""
    for page in PAGES:
        for term in RETIRED.findall(page.read_text()):
            yield f"{name_of(page)}: {term!r} is a retired term"


def check_environment_variables() -> Iterator[str]:
    """Each environment variable of ours is documented."""
    names = set()
    for package in PACKAGES.values():
        for path in package.rglob("*.py"):
            names |= set(re.findall(r"\bLEAGUE_[A-Z_]+\b", path.read_text()))
    text = (DOCS / "environment-variables.md").read_text()
    for name in names ^ set(re.findall(r"^\| `(LEAGUE_\w+)` \|", text, flags=re.M)):
        yield f"docs/environment-variables.md: {name}: in the table or in the code, expected both"
