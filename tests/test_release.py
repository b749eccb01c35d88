"""What a release consists of agrees: version, date, changelog, citation, workflows and issue forms."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

from policy_league_client import __version__

ROOT = Path(__file__).parent.parent
GITHUB = ROOT / ".github"
CHANGELOG = (ROOT / "CHANGELOG.md").read_text()
TOWNCRIER = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["towncrier"]
KINDS = {kind["name"] for kind in TOWNCRIER["type"]}


def test_changelog_and_citation_are_those_of_the_version() -> None:
    releases = re.findall(r"^## \[(\d+\.\d+\.\d+)\] - (\d{4}-\d\d-\d\d)$", CHANGELOG, flags=re.M)
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert releases[0] == (__version__, citation["date-released"].isoformat())
    assert citation["version"] == __version__
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()
    assert re.findall(r"^## .*", CHANGELOG, flags=re.M) == [f"## [{number}] - {date}" for number, date in releases]
    assert set(re.findall(r"^### (.*)", CHANGELOG, flags=re.M)) <= KINDS
    assert TOWNCRIER["start_string"] in CHANGELOG


def test_each_fragment_has_a_type_of_the_changelog() -> None:
    types = "|".join(kind["directory"] for kind in TOWNCRIER["type"])
    names = [path.name for path in (ROOT / TOWNCRIER["directory"]).iterdir() if path.name != ".gitignore"]
    assert [name for name in names if not re.fullmatch(rf"\+?[a-z0-9-]+\.({types})(\.\d+)?\.md", name)] == []


@pytest.mark.parametrize("path", sorted((GITHUB / "ISSUE_TEMPLATE").glob("[!c]*.yml")), ids=lambda path: path.stem)
def test_issue_forms_are_valid(path: Path) -> None:
    form = yaml.safe_load(path.read_text())
    assert form.keys() <= {"name", "description", "title", "labels", "assignees", "body"}
    assert form["name"]
    assert form["description"]
    fields = [element for element in form["body"] if element["type"] != "markdown"]
    assert len({field["id"] for field in fields}) == len(fields) > 0
    for element in form["body"]:
        assert element["type"] in {"markdown", "textarea", "input", "dropdown", "checkboxes"}
        assert element["attributes"].get("value" if element["type"] == "markdown" else "label")


def steps(workflow: str) -> list[dict[str, Any]]:
    jobs = yaml.safe_load((GITHUB / "workflows" / workflow).read_text())["jobs"].values()
    return [step for job in jobs for step in job["steps"]]


def test_a_release_is_built_as_in_ci_and_attested() -> None:
    commands = [step.get("run", "") for step in steps("release.yml")]
    targets = re.findall(r"^make ([\w-]+)", "\n".join(commands), flags=re.M)
    assert targets == ["setup", "dist", "test-slow"]
    assert re.search(r"^make dist$", (ROOT / ".ci/run").read_text(), flags=re.M)
    attested = [step["with"]["subject-path"] for step in steps("release.yml") if "attest" in step.get("uses", "")]
    assert attested == ["dist/*"]


def test_every_slow_test_is_in_a_part_that_runs_every_night() -> None:
    parts = dict(re.findall(r"^(\w+) := (tests/.+)$", (ROOT / "Makefile").read_text(), flags=re.M))
    (job,) = yaml.safe_load((GITHUB / "workflows/scheduled.yml").read_text())["jobs"].values()
    commands = "\n".join(job["strategy"]["matrix"]["command"])
    assert re.findall(r"PART=(\w+)", commands) == list(parts)
    folders = [ROOT / path for paths in parts.values() for path in paths.split()]
    slow = [
        path for path in (ROOT / "tests").rglob("test_*.py") if re.search(r"mark\.slow|on_both_\w+", path.read_text())
    ]
    assert [path for path in slow if sum(path.is_relative_to(folder) for folder in folders) != 1] == []
