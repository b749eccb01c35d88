"""Bundled league configurations. Commands accept their names in place of a path."""

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
        ConfigError: There is no bundled configuration of that name.
    """
    path = Path(config)
    if path.is_file() or path.suffix in (".yaml", ".yml") or len(path.parts) != 1:
        return path
    if config not in names():
        near = path.with_suffix(".yaml")
        hint = f"did you mean {near}?" if near.is_file() else "for a league of your own, name its file"
        raise ConfigError(
            f"{config!r} is neither a YAML file nor a bundled configuration ({', '.join(names())}): {hint}"
        )
    return _DIRECTORY / f"{config}.yaml"
