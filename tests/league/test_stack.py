import tomllib
from pathlib import Path

from league.stack import VERIFIED, installed


def test_the_verified_stack_equals_the_constraints() -> None:
    lines = Path("constraints.txt").read_text().splitlines()
    pins = dict(line.lower().split("==") for line in lines if "==" in line)
    assert {package: pins.get(package) for package in VERIFIED} == VERIFIED


def test_build_dependencies_are_pinned() -> None:
    """pip installs them in an environment of its own, without the constraints."""
    required = tomllib.loads(Path("pyproject.toml").read_text())["build-system"]["requires"]
    assert set(required) <= set(Path("constraints.txt").read_text().splitlines())


def test_the_tests_run_on_the_verified_stack() -> None:
    assert {name: version.partition("+")[0] for name, version in installed().items()} == VERIFIED
