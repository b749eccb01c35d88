"""Generates the blocking client, `policy_league_client._sync`, from the asyncio client, `_async`.

    python scripts/generate_sync_client.py [--check]

--check: write nothing; exit with 1 if a generated file is outdated.
"""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "clients/python/policy_league_client"
SOURCE, TARGET = PACKAGE / "_async", PACKAGE / "_sync"
RULES = (
    (r"\basync (?=def|for|with)", ""),
    (r"\bawait ", ""),
    (r"\bAsync(?=[A-Z])", ""),
    (r"\basync_(?=[a-z])", ""),
    (r"\b__a(enter|exit)__\b", r"__\1__"),
    (r"\baclose\b", "close"),
    (r"\b_async\b", "_sync"),
)
"""Pattern and replacement, for code, comments and docstrings alike."""
WORDING = {
    "The asyncio client; the blocking client, `_sync`, is generated from it.": "The blocking client.",
    "Belongs to one event loop.": "May be shared by threads.",
}
"""Sentences that differ between the two clients."""


def generate(source: Path) -> str:
    """Return the blocking counterpart of an asyncio module."""
    text = source.read_text()
    for sentence, counterpart in WORDING.items():
        text = text.replace(sentence, counterpart)
    for pattern, replacement in RULES:
        text = re.sub(pattern, replacement, text)
    header = f"# Generated from {source.relative_to(ROOT)} by {Path(__file__).relative_to(ROOT)}; do not edit.\n"
    return _ruff(header + text, TARGET / source.name)


def _ruff(text: str, path: Path) -> str:
    ruff = str(Path(sys.executable).with_name("ruff"))
    for command in (["check", "--select=I", "--fix-only", "--quiet"], ["format", "--quiet"]):
        text = subprocess.run(
            [ruff, *command, f"--stdin-filename={path}", "-"], input=text, capture_output=True, text=True, check=True
        ).stdout
    return text


def main() -> int:
    """Write the outdated files, or list them."""
    wanted = {source.name: generate(source) for source in sorted(SOURCE.glob("*.py"))}
    found = {path.name: path.read_text() for path in TARGET.glob("*.py")}
    outdated = sorted(name for name in wanted | found if wanted.get(name) != found.get(name))
    if "--check" in sys.argv[1:]:
        for name in outdated:
            print(f"{TARGET.relative_to(ROOT) / name} is outdated: run `make generate`", file=sys.stderr)
        return 1 if outdated else 0
    TARGET.mkdir(exist_ok=True)
    for name in outdated:
        if name in wanted:
            (TARGET / name).write_text(wanted[name])
        else:
            (TARGET / name).unlink()
    return 0


if __name__ == "__main__":
    sys.exit(main())
