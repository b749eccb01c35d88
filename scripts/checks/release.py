"""What a release consists of agrees: version, date, changelog, citation, workflows and issue forms."""

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import yaml

from policy_league_client import __version__

ROOT = Path(__file__).parents[2]
GITHUB = ROOT / ".github"
TOWNCRIER = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["towncrier"]


def check_versions() -> Iterator[str]:
    """Changelog and citation are those of the version."""
    text = (ROOT / "CHANGELOG.md").read_text()
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    expected = __version__, citation["date-released"].isoformat()
    releases = re.findall(r"^## \[(\d+\.\d+\.\d+)\] - (\d{4}-\d\d-\d\d)$", text, flags=re.M)
    if releases[0] != expected or citation["version"] != __version__:
        yield f"CHANGELOG.md, CITATION.cff: {releases[0]} and {citation['version']}, expected {expected}"
    for heading in re.findall(r"^## (.*)", text, flags=re.M):
        if heading not in {f"[{number}] - {date}" for number, date in releases}:
            yield f"CHANGELOG.md: {heading}: expected [version] - date"
    for heading in re.findall(r"^### (.*)", text, flags=re.M):
        if heading not in (names := [kind["name"] for kind in TOWNCRIER["type"]]):
            yield f"CHANGELOG.md: {heading}: expected one of {names}"
    if TOWNCRIER["start_string"] not in text:
        yield f"CHANGELOG.md: {TOWNCRIER['start_string']!r} is missing"


def check_fragments() -> Iterator[str]:
    """Each fragment has a type of the changelog."""
    types = "|".join(kind["directory"] for kind in TOWNCRIER["type"])
    for path in (ROOT / TOWNCRIER["directory"]).iterdir():
        if path.name != ".gitignore" and not re.fullmatch(rf"\+?[a-z0-9-]+\.({types})(\.\d+)?\.md", path.name):
            yield f"{path.relative_to(ROOT)}: expected NAME.TYPE.md with a type of {types}"


def check_issue_forms() -> Iterator[str]:
    """GitHub accepts the issue forms."""
    for path in (GITHUB / "ISSUE_TEMPLATE").glob("[!c]*.yml"):
        form = yaml.safe_load(path.read_text())
        if unknown := form.keys() - {"name", "description", "title", "labels", "assignees", "body"}:
            yield f"{path.relative_to(ROOT)}: unknown keys {sorted(unknown)}"
        fields = [element for element in form["body"] if element["type"] != "markdown"]
        if not (form["name"] and form["description"] and len({field["id"] for field in fields}) == len(fields) > 0):
            yield f"{path.relative_to(ROOT)}: expected a name, a description, and fields with different ids"
        for element in form["body"]:
            text = element["attributes"].get("value" if element["type"] == "markdown" else "label")
            if element["type"] not in {"markdown", "textarea", "input", "dropdown", "checkboxes"} or not text:
                yield f"{path.relative_to(ROOT)}: {element}: expected a known type with a text"


def check_workflow() -> Iterator[str]:
    """A release is built as in CI, and attested."""
    jobs = yaml.safe_load((GITHUB / "workflows/release.yml").read_text())["jobs"].values()
    steps = [step for job in jobs for step in job["steps"]]
    targets = re.findall(r"^make ([\w-]+)", "\n".join(step.get("run", "") for step in steps), flags=re.M)
    if targets != ["setup", "dist", "test-slow"] or not re.search(r"^make dist$", (ROOT / ".ci/run").read_text(), re.M):
        yield f"release.yml: {targets}: expected setup, dist as in .ci/run, and test-slow"
    attested = [step["with"]["subject-path"] for step in steps if "attest" in step.get("uses", "")]
    if attested != ["dist/*"]:
        yield f"release.yml: attests {attested}, expected dist/*"


def check_slow_tests() -> Iterator[str]:
    """Every slow test is in a part of `make test-slow`, and every part runs every night."""
    parts = dict(re.findall(r"^(\w+) := (tests/.+)$", (ROOT / "Makefile").read_text(), flags=re.M))
    (job,) = yaml.safe_load((GITHUB / "workflows/scheduled.yml").read_text())["jobs"].values()
    scheduled = re.findall(r"PART=(\w+)", "\n".join(job["strategy"]["matrix"]["command"]))
    if scheduled != list(parts):
        yield f"scheduled.yml: parts {scheduled}, expected those of the Makefile: {list(parts)}"
    folders = [ROOT / path for paths in parts.values() for path in paths.split()]
    for path in (ROOT / "tests").rglob("test_*.py"):
        slow = re.search(r"mark\.slow|on_both_\w+", path.read_text())
        if slow and sum(path.is_relative_to(folder) for folder in folders) != 1:
            yield f"{path.relative_to(ROOT)}: has slow tests, and is not in one part of `make test-slow`"
