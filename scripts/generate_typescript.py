"""Generates the types of the TypeScript client from the OpenAPI document, with the installed openapi-typescript.

`python scripts/generate_typescript.py` writes `clients/typescript/src/openapi.ts`.
"""

import json
import shutil
import subprocess
import sys
from pathlib import Path

from serve_app.openapi.document import document
from serve_app.settings import ServeSettings

PACKAGE = Path(__file__).parents[1] / "clients/typescript"
TARGET = PACKAGE / "src/openapi.ts"


def generate() -> str:
    """Return the types. The packages of `npm ci` must be installed."""
    command = ["npx", "--no-install", "openapi-typescript"]
    api = json.dumps(document(ServeSettings(), []))
    return subprocess.run(command, cwd=PACKAGE, input=api, stdout=subprocess.PIPE, text=True, check=True).stdout


def main() -> None:
    """Install the packages and write the file."""
    if shutil.which("npm") is None:
        sys.exit("the types of the TypeScript client cannot be generated: npm is not installed")
    subprocess.run(["npm", "ci", "--no-audit", "--no-fund"], cwd=PACKAGE, check=True)
    TARGET.write_text(generate())


if __name__ == "__main__":
    main()
