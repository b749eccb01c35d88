"""Storage locations: home directory, database and artefact store, from three environment variables."""

import os
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from league.errors import ConfigError

OBJECT_STORES = ("s3", "gs", "az")
"""URL schemes of object stores."""


@dataclass(frozen=True, slots=True)
class Storage:
    """Locations of the home directory, the database and the artefact store. All paths are absolute."""

    home: Path
    database_url: str
    artifacts: Path | str
    """A directory, or the URL of an object store."""

    @classmethod
    def at(cls, home: Path | str) -> "Storage":
        """Return a SQLite database and an artefact directory inside `home`."""
        try:
            home = Path(home).expanduser().absolute()
        except RuntimeError as error:
            raise ConfigError(f"{home}: this user has no home directory: use an absolute path") from error
        # In URLs, a query begins with ? and an escape sequence with %.
        database = str(home / "league.db").replace("%", "%25").replace("?", "%3F")
        return cls(home, f"sqlite:///{database}", home / "artifacts")

    @classmethod
    def from_environment(cls) -> "Storage":
        """Read LEAGUE_HOME (default `./league-home`), LEAGUE_DATABASE_URL and LEAGUE_ARTIFACTS."""
        default = cls.at(os.environ.get("LEAGUE_HOME") or "league-home")
        artifacts = os.environ.get("LEAGUE_ARTIFACTS")
        return cls(
            home=default.home,
            database_url=os.environ.get("LEAGUE_DATABASE_URL") or default.database_url,
            artifacts=_artifacts(artifacts) if artifacts else default.artifacts,
        )

    @property
    def has_password(self) -> bool:
        """Whether the database's URL contains a password, which must not be shown where the URL is."""
        parts = urlsplit(self.database_url)
        return parts.password is not None or "password" in parse_qs(parts.query)

    def check_no_password(self, shown_by: str) -> None:
        """Raise ConfigError if the database's URL contains a password. shown_by: what would show it."""
        if self.has_password:
            raise ConfigError(
                f"LEAGUE_DATABASE_URL contains a password, which {shown_by} would show: leave it out, and give the"
                " cluster's nodes a password file (PGPASSFILE)"
            )

    @property
    def environment(self) -> dict[str, str]:
        """The three environment variables."""
        return {
            "LEAGUE_HOME": str(self.home),
            "LEAGUE_DATABASE_URL": self.database_url,
            "LEAGUE_ARTIFACTS": str(self.artifacts),
        }

    def check_reach(self, machines: set[str]) -> None:
        """Raise ConfigError if several machines cannot share the storage: SQLite, or artefacts in `home`."""
        is_local = isinstance(self.artifacts, Path) and self.artifacts.is_relative_to(self.home)
        is_shared = not self.database_url.startswith("sqlite") and not is_local
        if len(machines) > 1 and not is_shared:
            raise ConfigError(
                f"the cluster has {len(machines)} machines: set LEAGUE_DATABASE_URL to a PostgreSQL server and"
                " LEAGUE_ARTIFACTS to an object store (s3://bucket/prefix) or a directory that all of them mount"
            )

    def export(self) -> None:
        """Set the three variables in this process, so that Ray's workers inherit them."""
        os.environ |= self.environment


def _artifacts(value: str) -> Path | str:
    scheme, separator, location = value.partition("://")
    if not separator:
        return Path(value).expanduser().absolute()
    if scheme not in OBJECT_STORES or not location.strip("/"):
        expected_forms = ", ".join(f"{store}://BUCKET/PREFIX" for store in OBJECT_STORES)
        raise ConfigError(f"LEAGUE_ARTIFACTS={value}: expected a directory or one of {expected_forms}")
    return value.rstrip("/")
