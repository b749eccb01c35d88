"""Bundled league configurations. Commands accept their names in place of a path."""

import difflib
from pathlib import Path

from league.errors import ConfigError

_DIRECTORY = Path(__file__).parent


def names() -> list[str]:
    """Return the names of the bundled configurations in alphabetical order."""
    return sorted(path.stem for path in _DIRECTORY.glob("*.yaml"))


def find(config: str) -> Path:
    """Return the path of a configuration.

    Args:
        config: Path of a YAML file, or the name of a bundled configuration such as `connect_four`. A file in the
            working directory takes precedence over a bundled configuration of the same name.

    Raises:
        ConfigError: There is no such file, or no bundled configuration of that name. The message names similar ones.
    """
    path = Path(config)
    if path.is_file():
        return path
    if path.suffix in (".yaml", ".yml") and not path.exists():
        raise ConfigError(f"{config}: No such file or directory{_similar(path)}")
    if path.suffix in (".yaml", ".yml") or len(path.parts) != 1:
        return path
    if config not in names():
        near = path.with_suffix(".yaml")
        hint = f"did you mean {near}?" if near.is_file() else "for a league of your own, name its file"
        raise ConfigError(
            f"{config!r} is neither a YAML file nor a bundled configuration ({', '.join(names())}): {hint}"
        )
    return _DIRECTORY / f"{config}.yaml"


def _similar(path: Path) -> str:
    """`; did you mean games/tron.yaml?` for a path of which there are similar files, or a bundled configuration."""
    files = [file for suffix in (".yaml", ".yml") for file in path.parent.glob(f"*{suffix}")]
    texts = {name: name for name in names()} | {file.stem: str(file) for file in files}
    near = difflib.get_close_matches(path.stem, texts)
    return f"; did you mean {' or '.join(texts[name] for name in near)}?" if near else ""
