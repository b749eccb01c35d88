"""Virtual environments in which only a wheel and what it requires can be imported."""

import os
import subprocess
import sys
from collections.abc import Iterable
from importlib.metadata import Distribution, PathDistribution, distribution
from pathlib import Path

from packaging.requirements import Requirement

CLEAN = {name: value for name, value in os.environ.items() if not name.startswith(("LEAGUE_", "PYTHON"))}
"""The environment of processes that must not find this project's sources."""


def wheel_of(project: Path, directory: Path) -> Path:
    """Build the wheel of a project, from its source distribution, as `python -m build` does."""
    build = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(directory), str(project)]
    subprocess.run(build, check=True, capture_output=True, timeout=300)
    (wheel,) = directory.glob("*.whl")
    return wheel


def installed(wheel: Path, directory: Path, *extras: str) -> Path:
    """The directory of the programs of a new virtual environment with a wheel and the distributions that it requires.

    Their files are links to those that are installed here, so that no package index is needed. `pip check` confirms
    that no requirement is missing.
    """
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(directory)], check=True)
    programs = directory / "bin"
    pip = [sys.executable, "-m", "pip", "--python", str(programs / "python")]
    install = [*pip, "install", "--quiet", "--no-deps", "--no-index", str(wheel)]
    subprocess.run(install, env=CLEAN, check=True, timeout=120)
    (packages,) = directory.glob("lib/*/site-packages")
    (metadata,) = packages.glob("*.dist-info")
    for name in _required(PathDistribution(metadata), extras):
        _link(name, packages)
    subprocess.run([*pip, "check"], env=CLEAN, check=True, timeout=120)
    return programs


def _required(wheel: Distribution, extras: Iterable[str]) -> set[str]:
    """Names of the distributions that one requires, directly or not."""
    names: set[str] = set()
    visited: set[tuple[str, str]] = set()
    pending = [(wheel, extra) for extra in ("", *extras)]
    while pending:
        parent, extra = pending.pop()
        for requirement in map(Requirement, parent.requires or ()):
            if requirement.marker is None or requirement.marker.evaluate({"extra": extra}):
                pairs = {(requirement.name, needed) for needed in ("", *requirement.extras)} - visited
                visited |= pairs
                names.add(requirement.name)
                pending += [(distribution(name), needed) for name, needed in pairs]
    return names


def _link(name: str, packages: Path) -> None:
    """Link the packages, modules and metadata of an installed distribution, without its programs."""
    files = distribution(name).files or ()
    for top in {file.parts[0] for file in files} - {"..", "__pycache__"}:
        target = packages / top
        if not target.exists():
            target.symlink_to(str(distribution(name).locate_file(top)))
