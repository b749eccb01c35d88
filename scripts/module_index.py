"""The text of the page Modules: every module with the first paragraph of its docstring.

Packages are in the order of their layers, highest first, as the import contracts in pyproject.toml have them.
"""

import ast
import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGES = ("policy_league", "evaluation", "training", "serve_app", "league", "clients/python/policy_league_client")
HEAD = """# Modules

All Python modules, by package. In each package the sub-packages are listed from the highest layer to the lowest: a
module imports from lower layers only. [Architecture](architecture.md) explains the layers.
"""


def page() -> str:
    """The text of the page, in Markdown."""
    layers = _layers()
    return "\n".join([HEAD, *(_package(ROOT / name, layers) for name in PACKAGES)]).rstrip("\n") + "\n"


def modules(folder: Path) -> list[Path]:
    """The modules that lie directly in a folder, without the package's own and migrations."""
    if folder.parent.name == "migrations":
        return []
    return sorted(path for path in folder.glob("*.py") if path.name != "__init__.py")


def _package(folder: Path, layers: dict[str, int]) -> str:
    name = folder.relative_to(ROOT).as_posix()
    level = "##" if folder.parent == ROOT else "###"
    parts = []
    if paths := modules(folder):
        caption = _caption(folder / "__init__.py", optional=True)
        rows = [f"| `{path.relative_to(ROOT).as_posix()}` | {_caption(path)} |" for path in paths]
        parts.append("\n".join([f"{level} `{name}/`\n", *([f"{caption}\n"] if caption else []), *HEADER, *rows, ""]))
    elif folder.parent == ROOT:
        caption = _caption(folder / "__init__.py", optional=True)
        parts.append("\n".join([f"{level} `{name}/`\n", *([f"{caption}\n"] if caption else [])]))
    inner = [path for path in folder.iterdir() if (path / "__init__.py").exists()]
    inner.sort(key=lambda path: (layers.get(".".join(path.relative_to(ROOT).parts), 0), path.name))
    return "\n".join([*parts, *filter(None, (_package(path, layers) for path in inner))])


HEADER = ("| module | purpose |", "|---|---|")


def _caption(path: Path, optional: bool = False) -> str:
    docstring = ast.get_docstring(ast.parse(path.read_text()))
    if not docstring:
        if optional:
            return ""
        raise ValueError(f"{path.relative_to(ROOT)} has no docstring")
    return " ".join(docstring.partition("\n\n")[0].split()).replace("|", "\\|")


def _layers() -> dict[str, int]:
    """Dotted name of a sub-package → its place among the layers of its package, the highest first."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    return {
        f"{container}.{name.strip()}": place
        for contract in contracts
        for container in contract.get("containers", ())
        for place, layer in enumerate(contract["layers"])
        for name in layer.replace(":", "|").split("|")
    }
