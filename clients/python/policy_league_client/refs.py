"""References to versions, policies, scripts and remote models.

| text                        | record                                      |
|-----------------------------|---------------------------------------------|
| `connect_four@7`            | `CheckpointRef("connect_four", 7)`          |
| `connect_four@champion`     | `CheckpointRef("connect_four", "champion")` |
| `script:random`             | `ScriptRef("random")`                       |
| `script:my_game.bots:block` | `ScriptRef("my_game.bots:block")`           |
| `connect_four.shared`       | `PolicyRef("connect_four", "shared")`       |

A mixture of versions is written with probabilities: `connect_four@3:0.6,connect_four@5:0.4`.

The URL of a model in the Open Inference Protocol, `http://host:8000/v2/models/NAME`, is a `RemoteRef`.
"""

import re
from dataclasses import dataclass

from policy_league_client.errors import InvalidReference

SLUG = re.compile(r"[a-z0-9_-]+")
MAX_SLUG = 100
"""Characters. Ids of schedules and verdicts contain the league's name and must fit into 255 characters."""
ENTRY_POINT = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*", re.ASCII)
MAX_ENTRY_POINT = 200
MODEL_URL = re.compile(
    r"(?P<server>https?://[A-Za-z0-9.\-\[\]:]+(/[A-Za-z0-9._\-]+)*?)/v2/models/(?P<model>[A-Za-z0-9._\-{}]+)"
    r"(/versions/(?P<version>[A-Za-z0-9._\-]+))?(#(?P<digest>[0-9a-f]{12}))?"
)
MAX_MODEL_URL = 200
POLICY = "{policy}"
"""Stands for the policy's name in the URL of a model."""
CHAMPION = "champion"
VERDICT = "-verdict-"
"""Part of a verdict's id before its digest: `connect_four-verdict-0f3a62d1c8b45e97-1b2c3d4e`."""
SHORT_VERDICT = 8
"""Characters of the digest that identify a verdict in displays, and are accepted by all commands."""
MAX_VERSION = 2**31 - 1
"""Version numbers are a signed 32-bit column of the registry."""


def check_slug(kind: str, text: str) -> str:
    """Return `text` if it is a valid name of a league, policy, side or alias; raise InvalidReference otherwise."""
    if len(text) > MAX_SLUG:
        raise InvalidReference(f"{kind} {text[:32]!r}… has {len(text)} characters, expected at most {MAX_SLUG}")
    if not SLUG.fullmatch(text):
        # For a file `configs/my_game.yaml`, a version `my_game@3`, or `My_Game`.
        name = text.rpartition("/")[2].partition("@")[0].removesuffix(".yaml").lower()
        guess = f", did you mean {name!r}?" if SLUG.fullmatch(name) else ""
        raise InvalidReference(f"{kind} {text!r} must consist of a-z, 0-9, '_' and '-'{guess}")
    return text


def check_new(kind: str, text: str) -> None:
    """Raise InvalidReference if a new name begins like an option of a command."""
    if text.startswith("-"):
        raise InvalidReference(f"{kind} {text!r} must not begin with '-'")


def parse_version(text: str) -> int | str:
    """Parse a version number or an alias: `"7"` → 7, `"champion"` → `"champion"`. Raises InvalidReference."""
    if text.isascii() and text.isdigit():
        number = int(text) if len(text) <= 10 else MAX_VERSION + 1
        if not 1 <= number <= MAX_VERSION:
            raise InvalidReference(f"version {text[:32]!r} must be between 1 and {MAX_VERSION}")
        return number
    return check_slug("alias", text)


def verdict_digest(verdict: str) -> str:
    """Return the part of a verdict's id that identifies it: `0f3a62d1c8b45e97-1b2c3d4e`."""
    return verdict.rpartition(VERDICT)[2]


def short_verdict(verdict: str) -> str:
    """Return the short id of a verdict, the beginning of its digest: `0f3a62d1`."""
    return verdict_digest(verdict)[:SHORT_VERDICT]


def check_alias(text: str) -> str:
    """Return `text` if it is a valid alias: a slug with at least one non-digit; raise InvalidReference otherwise."""
    check_new("alias", text)
    if text.isdigit():
        raise InvalidReference(f"alias {text!r} must not be all digits: that is a version number")
    return check_slug("alias", text)


@dataclass(frozen=True, slots=True)
class CheckpointRef:
    """A version of a league, by number or by alias."""

    league: str
    version: int | str

    @classmethod
    def parse(cls, text: str) -> "CheckpointRef":
        league, at, version = text.partition("@")
        if not at:
            raise InvalidReference(f"{text!r} contains no version: expected LEAGUE@NUMBER or LEAGUE@ALIAS")
        return cls(check_slug("league", league), parse_version(version))

    def __str__(self) -> str:
        return f"{self.league}@{self.version}"


@dataclass(frozen=True, slots=True)
class ScriptRef:
    """A scripted baseline by its name, or a bot by its entry point, `module:name`."""

    name: str

    @property
    def is_bot(self) -> bool:
        """Whether this is code of the user, which only processes with environments may import."""
        return ":" in self.name

    @classmethod
    def parse(cls, text: str) -> "ScriptRef":
        scheme, _, name = text.partition(":")
        if scheme != "script":
            raise InvalidReference(f"{text!r} is not a script: expected script:NAME")
        if ":" not in name:
            return cls(check_slug("script", name))
        if len(name) > MAX_ENTRY_POINT:
            raise InvalidReference(f"bot {name[:32]!r}… has {len(name)} characters, expected at most {MAX_ENTRY_POINT}")
        if not ENTRY_POINT.fullmatch(name):
            raise InvalidReference(f"bot {name!r} must be my_package.module:name")
        return cls(name)

    def __str__(self) -> str:
        return f"script:{self.name}"


@dataclass(frozen=True, slots=True)
class RemoteRef:
    """A model of a server of the Open Inference Protocol, by its URL.

    Attributes:
        server: URL of the server, without `/v2`.
        model: Name of the model, in which `{policy}` stands for the policy.
        version: Version of the model; None for the server's default.
        digest: First digits of the SHA-256 of the model's metadata, which identifies a model without versions.
    """

    server: str
    model: str
    version: str | None = None
    digest: str | None = None

    @classmethod
    def parse(cls, text: str) -> "RemoteRef":
        if len(text) > MAX_MODEL_URL:
            raise InvalidReference(f"{text[:32]!r}… has {len(text)} characters, expected at most {MAX_MODEL_URL}")
        match = MODEL_URL.fullmatch(text)
        if match is None or re.search(r"[{}]", match["model"].replace(POLICY, "")):
            raise InvalidReference(f"{text!r} is not the URL of a model: expected http://HOST:PORT/v2/models/NAME")
        return cls(match["server"], match["model"], match["version"], match["digest"])

    @property
    def default(self) -> "RemoteRef":
        """The reference without version and digest."""
        return RemoteRef(self.server, self.model)

    def path(self, policy: str) -> str:
        """Path of the model of a policy, below the server's URL."""
        model = f"/v2/models/{self.model.replace(POLICY, policy)}"
        return model if self.version is None else f"{model}/versions/{self.version}"

    def __str__(self) -> str:
        digest = "" if self.digest is None else f"#{self.digest}"
        return f"{self.server}{self.path(POLICY)}{digest}"


@dataclass(frozen=True, slots=True)
class PolicyRef:
    """A policy of a league; `policy` is optional if the league has one."""

    league: str
    policy: str | None = None

    @classmethod
    def parse(cls, text: str) -> "PolicyRef":
        if "@" in text:
            raise InvalidReference(f"model {text[:MAX_SLUG]!r} contains a version: send it as `version` instead")
        league, dot, policy = text.partition(".")
        return cls(check_slug("league", league), check_slug("policy", policy) if dot else None)

    def __str__(self) -> str:
        return self.league if self.policy is None else f"{self.league}.{self.policy}"


def parse_ref(text: str) -> CheckpointRef | ScriptRef | RemoteRef:
    """Parse the reference of a contestant: `connect_four@7`, `connect_four@champion`, `script:random`, or the URL of a
    model.
    """
    if text.startswith(("http://", "https://")):
        return RemoteRef.parse(text)
    return ScriptRef.parse(text) if text.startswith("script:") else CheckpointRef.parse(text)


def is_mixture(text: str) -> bool:
    """Whether a text is a mixture, `connect_four@3:0.6,connect_four@5:0.4`, not the reference of one version."""
    return ":" in text.partition("@")[2]


def parse_mixture(text: str) -> dict[CheckpointRef, float]:
    """Parse a mixture into version → probability. The league may be omitted after the first version: `@5:0.4`.

    Raises InvalidReference. The probabilities are not checked.
    """
    probabilities: dict[CheckpointRef, float] = {}
    for part in text.split(","):
        written, colon, share = part.strip().rpartition(":")
        if not colon:
            raise InvalidReference(f"{part.strip()!r} has no probability: expected LEAGUE@VERSION:PROBABILITY")
        first = next(iter(probabilities), None)
        ref = CheckpointRef.parse(written if first is None else of_league(written, first.league))
        if first is not None and ref.league != first.league:
            raise InvalidReference(f"{ref} is not a version of league {first.league}: a mixture has one league")
        if ref in probabilities:
            raise InvalidReference(f"{ref} is twice in the mixture")
        try:
            probabilities[ref] = float(share)
        except ValueError:
            raise InvalidReference(f"{share!r} is not a probability: expected {ref}:PROBABILITY") from None
    return probabilities


def of_league(ref: str, league: str) -> str:
    """Expand `@3` to `LEAGUE@3`."""
    return league + ref if ref.startswith("@") else ref
