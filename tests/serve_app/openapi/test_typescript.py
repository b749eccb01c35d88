"""TypeScript clients can be generated from the OpenAPI document."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from serve_app.openapi.document import document
from tests.support.servers.replicas import QUICK

PACKAGES = ("openapi-typescript@7.13.0", "openapi-fetch@0.17.0", "typescript@5.9.3")
CLIENT = Path(__file__).with_name("client.ts")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("npm") is None, reason="npm is not installed"),
]


def run(directory: Path, *command: str) -> None:
    process = subprocess.run(command, cwd=directory, capture_output=True, text=True, timeout=300)
    assert process.returncode == 0, process.stdout + process.stderr


def test_a_generated_client_compiles_in_strict_mode(tmp_path: Path) -> None:
    (tmp_path / "package.json").write_text('{"type": "module"}')
    (tmp_path / "openapi.json").write_text(json.dumps(document(QUICK, [])))
    shutil.copy(CLIENT, tmp_path)
    run(tmp_path, "npm", "install", "--no-audit", "--no-fund", *PACKAGES)
    run(tmp_path, "npx", "openapi-typescript", "openapi.json", "--output", "schema.d.ts")
    options = ("--strict", "--noEmit", "--target", "es2022", "--module", "esnext", "--moduleResolution", "bundler")
    run(tmp_path, "npx", "tsc", *options, CLIENT.name)
