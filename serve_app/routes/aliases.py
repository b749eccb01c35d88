"""Moves aliases (promotion, rollback) and lists their history.

A change requires an API key of scope `promote`, whose name becomes the actor in the history, and an `Idempotency-Key`:
a repeated call (a retry by a client or by HAProxy) is not applied again and gets the same response for 24 hours.
`expected` is the version that the alias must point to now, or null if it must not exist; without it there is no such
condition.
"""

from collections.abc import Sequence
from datetime import datetime
from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from league.errors import (
    AliasMoved,
    EnvironmentMismatch,
    InvalidInput,
    LeagueArchived,
    NothingToRollBack,
    NotPromotable,
    UnknownVersion,
    VersionRetired,
)
from league.refs import MAX_VERSION
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.storage import rows
from league.registry.storage.idempotency import IdempotentCall
from serve_app.access.api_keys import ApiKey
from serve_app.declaration import Declaration, Page, Response, moment
from serve_app.routes.documents import ChangeBody, Number

MAX_MEMBERS = 100
"""Members of a mixture."""
NumberInBody = Annotated[int, Field(ge=1, le=MAX_VERSION, description="The number of a version.")]


class MemberBody(BaseModel):
    """A version of a mixture, and its probability. The probabilities of a mixture sum to 1."""

    model_config = ConfigDict(extra="forbid", strict=True)

    version: NumberInBody
    probability: float = Field(gt=0, le=1)


class PromotionBody(ChangeBody):
    """A version or a mixture that an alias is to name: either `version` or `members`."""

    model_config = ConfigDict(json_schema_extra={"oneOf": [{"required": ["version"]}, {"required": ["members"]}]})

    version: NumberInBody | None = None
    members: list[MemberBody] | None = Field(default=None, max_length=MAX_MEMBERS)
    expected: NumberInBody | None = Field(default=None, description="The version that the alias must currently name.")

    @model_validator(mode="after")
    def _has_one_target(self) -> Self:
        if (self.version is None) == (self.members is None):
            raise ValueError("expected either version, or members with their probabilities")
        numbers = [member.version for member in self.members or ()]
        if len(set(numbers)) < len(numbers):
            raise ValueError("members: a version is named twice")
        return self

    def target(self, registry: Registry, league: str) -> int:
        """The version to promote; a mixture is published. Raises the errors of `publish_mixture`."""
        if self.version is not None:
            return self.version
        shares = {member.version: member.probability for member in self.members or ()}
        return registry.publisher.publish_mixture(league, shares).number


class RollbackBody(ChangeBody):
    """A return to the previous champion."""

    expected: NumberInBody | None = Field(default=None, description="The version that the champion must currently be.")


class AliasChange(Response):
    """A change of an alias."""

    league: str
    alias: str
    kind: str
    version: Number
    previous: int | None
    actor: str
    reason: str
    verdict: str | None = Field(description="The verdict that led to the promotion.")
    at: datetime
    event: int = Field(validation_alias="id")


@Declaration(
    "GET",
    "/v1/leagues/{league}/aliases/{alias}/history",
    Page("history", AliasChange, "event"),
    scope="read",
    tag="Read",
    success="A page of the history.",
    parameters=(moment("at", "A time with a time zone.", "2026-03-03T14:00:00Z"),),
)
def history(
    registry: Registry, league: str, alias: str, limit: int, before: int | None, at: datetime | None
) -> Sequence[rows.AliasEvent]:
    """Get the history of an alias.

    Newest first; empty for an alias that never existed. With `at`, only the change that was in effect at that time.
    """
    if at is not None and before is not None:
        raise InvalidInput("at and before are mutually exclusive")
    return registry.aliases.history(league, alias, at, before=before, limit=limit)


@Declaration(
    "POST",
    "/v1/leagues/{league}/aliases/{alias}",
    AliasChange,
    scope="promote",
    tag="Management",
    body=PromotionBody,
    errors=(UnknownVersion, VersionRetired, NotPromotable, EnvironmentMismatch, AliasMoved, LeagueArchived),
)
def set_alias(
    registry: Registry, league: str, alias: str, body: PromotionBody, key: ApiKey, call: IdempotentCall
) -> rows.AliasEvent:
    """Point an alias to a version or a mixture.

    A compare-and-set operation: with `expected`, the alias must currently name this version; with `expected: null`, it
    must not exist. Without `expected` the alias is set unconditionally. With `members`, a mixture is published as a
    version of its own, unless it exists, and the alias points to it.
    """
    return registry.aliases.set(
        league,
        alias,
        body.target(registry, league),
        expected=body.expected if "expected" in body.model_fields_set else ANY,
        actor=key.name,
        reason=body.reason,
        call=call,
    )


@Declaration(
    "POST",
    "/v1/leagues/{league}/rollback",
    AliasChange,
    scope="promote",
    tag="Management",
    body=RollbackBody,
    is_body_optional=True,
    errors=(AliasMoved, NothingToRollBack),
)
def roll_back(
    registry: Registry, league: str, body: RollbackBody, key: ApiKey, call: IdempotentCall
) -> rows.AliasEvent:
    """Roll back to the previous champion.

    With `expected`, the champion must currently be this version: of several rollbacks of one version, only the first
    succeeds.
    """
    expected = ANY if body.expected is None else body.expected
    return registry.aliases.rollback(league, expected=expected, actor=key.name, reason=body.reason, call=call)
