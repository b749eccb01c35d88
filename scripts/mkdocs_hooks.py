"""MkDocs hooks: pages link to files of the repository, and the site contains what they link to.

CONTRIBUTING.md and CHANGELOG.md become pages. The page Modules is made from docstrings, the page HTTP reference from
the declared routes, and the page JSON documents from the records of evaluations. Every other file outside of `docs/`
that a page links to becomes a page with its source. A link to a file that does not exist stays as it is, so that the
strict build fails.
"""

import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page
from module_index import page as module_index
from references import documents_page, http_page

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
LINK = re.compile(r"(?<=\]\()(?![a-z]+:|#)([^)#\s]+)")
LANGUAGES = {
    ".py": "python",
    ".yaml": "yaml",
    ".yml": "yaml",
    ".json": "json",
    ".toml": "toml",
    ".js": "javascript",
    ".ts": "typescript",
}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made from files outside of `docs/`."""
    linked = {path for file in files.documentation_pages() for path in _links(file.content_string, DOCS / file.src_uri)}
    for name in PAGES:
        linked |= set(_links((ROOT / name).read_text(), ROOT / name))
    files.append(File.generated(config, "modules.md", content=module_index()))
    files.append(File.generated(config, "http-reference.md", content=http_page()))
    files.append(File.generated(config, "json-documents.md", content=documents_page()))
    for name, uri in PAGES.items():
        files.append(File.generated(config, uri, content=(ROOT / name).read_text()))
    for path in sorted(path for path in linked if not path.is_relative_to(DOCS) and path.exists()):
        if path.relative_to(ROOT).as_posix() not in PAGES:
            page = File.generated(config, _uri(path), content=_source(path), inclusion=InclusionLevel.NOT_IN_NAV)
            files.append(page)
    return files


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Point links to files outside of `docs/` at their pages."""
    uri = page.file.src_uri
    if uri.startswith("source/"):
        return markdown
    origin = {made: ROOT / name for name, made in PAGES.items()}.get(uri, DOCS / uri)

    def place(match: re.Match[str]) -> str:
        target = (origin.parent / match[1]).resolve()
        if not target.is_relative_to(ROOT) or not target.exists():
            return match[1]
        return posixpath.relpath(_uri(target), posixpath.dirname(uri) or ".")

    return LINK.sub(place, markdown)


def _links(text: str, page: Path) -> list[Path]:
    paths = [(page.parent / target).resolve() for target in LINK.findall(text)]
    return [path for path in paths if path.is_relative_to(ROOT)]


def _uri(path: Path) -> str:
    """Where the site has a file or folder of the repository."""
    if path.is_relative_to(DOCS):
        return path.relative_to(DOCS).as_posix()
    name = path.relative_to(ROOT).as_posix()
    return PAGES.get(name) or f"source/{name}.md"


def _source(path: Path) -> str:
    name = path.relative_to(ROOT).as_posix()
    parts = [f"---\nsearch: {{exclude: true}}\n---\n\n# {name}\n"]
    for file in [path] if path.is_file() else sorted(file for file in path.iterdir() if file.is_file()):
        heading = "" if file == path else f"\n## {file.name}\n"
        parts.append(f"{heading}\n``````{LANGUAGES.get(file.suffix, 'text')}\n{file.read_text()}\n``````\n")
    return "".join(parts)
