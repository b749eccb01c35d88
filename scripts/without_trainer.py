"""Removes what only training needs from the dependencies in a pyproject.toml: the group `tool.policy-league.trainer`.

    python scripts/without_trainer.py pyproject.toml

The wheel of the `server` image is built from the result.
"""

import re
import sys
import tomllib
from pathlib import Path


def main() -> None:
    """Rewrite the file."""
    path = Path(sys.argv[1])
    path.write_text(without_trainer(path.read_text()))


def without_trainer(text: str) -> str:
    """Return the text of a pyproject.toml without the lines of the group's requirements."""
    document = tomllib.loads(text)
    requirements = {re.split("[<>=~!]", line)[0]: line for line in document["project"]["dependencies"]}
    for name in document["tool"]["policy-league"]["trainer"]:
        text = text.replace(f'    "{requirements[name]}",\n', "", 1)
    return text


if __name__ == "__main__":
    main()
