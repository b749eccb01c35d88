"""The calls of the HTTP API: request and response parser of each, independent of the connection."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Generic, TypeVar
from uuid import uuid4

from policy_league_client.errors import AliasMoved, InvalidInput
from policy_league_client.refs import CheckpointRef, check_alias, check_slug, is_mixture, parse_mixture
from policy_league_client.requests import ActionRequest, BatchActionRequest, JsonObject, to_json
from policy_league_client.responses import (
    ActionResponse,
    BatchActionResponse,
    Model,
    parse_action_response,
    parse_batch_action_response,
)

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class ApiCall(Generic[T]):
    """A request that is safe to repeat, and the parser of its response.

    Attributes:
        path: Path and query string.
        parse: Body of the response and name of the replica → the result of the call.
        body: JSON body of a POST request; None for a GET or DELETE request.
        headers: Additional headers.
        is_delete: Whether the method is DELETE.
    """

    path: str
    parse: Callable[[JsonObject, str], T]
    body: bytes | None = None
    headers: Mapping[str, str] = field(default_factory=dict)
    is_delete: bool = False


@dataclass(frozen=True, slots=True)
class Promotion:
    """A change of an alias, as recorded in the registry.

    Attributes:
        league: The league.
        alias: The alias that was moved.
        kind: `promotion` or `rollback`.
        version: The version that the alias points to now.
        previous: The version that it pointed to before; None if the alias is new.
        actor: The user or API key that made the change.
        reason: Text given with the change.
        at: Time of the change, ISO 8601 in UTC.
        event: Number of the entry in the audit log.
        verdict: Digest of the verdict that justifies the change; None for a manual change.
    """

    league: str
    alias: str
    kind: str
    version: int
    previous: int | None
    actor: str
    reason: str
    at: str
    event: int
    verdict: str | None = None


def act(model: Model, request: ActionRequest) -> ApiCall[ActionResponse]:
    """Request one action."""
    return ApiCall(
        f"{model.path}/action{model.query}",
        lambda body, replica: parse_action_response(body, replica, request.seed),
        to_json(request.body),
    )


def act_batch(model: Model, request: BatchActionRequest) -> ApiCall[BatchActionResponse]:
    """Request the actions of a batch."""
    return ApiCall(
        f"{model.path}/action{model.query}",
        lambda body, replica: parse_batch_action_response(body, replica, request.seed),
        to_json(request.body),
    )


def leagues() -> ApiCall[list[JsonObject]]:
    """List all leagues."""
    return ApiCall("/v1/leagues", lambda body, _: body["leagues"])


def league(slug: str) -> ApiCall[JsonObject]:
    """Describe one league."""
    return ApiCall(f"/v1/leagues/{check_slug('league', slug)}", lambda body, _: body)


def versions(slug: str) -> ApiCall[list[JsonObject]]:
    """List the versions of a league."""
    return ApiCall(f"/v1/leagues/{check_slug('league', slug)}/versions", lambda body, _: body["versions"])


def health(probe: str) -> ApiCall[str]:
    """Check whether a replica is `live` or `ready`; the result is the replica's name."""
    return ApiCall(f"/v1/health/{probe}", lambda body, _: body["replica"])


ANY: Any = object()
"""Value of `expected` for which an alias is moved unconditionally."""


def promote(ref: str, alias: str, expected: int | None, reason: str | None, key: str | None) -> ApiCall[Promotion]:
    """Point an alias at a version, `connect_four@3`, or a mixture, `connect_four@3:0.6,@5:0.4`.

    Raises InvalidReference or InvalidInput.
    """
    shares = parse_mixture(ref) if is_mixture(ref) else {CheckpointRef.parse(ref): 1.0}
    for member in shares:
        if not isinstance(member.version, int):
            raise InvalidInput(f"{member} is an alias, expected a version number")
    members = [{"version": member.version, "probability": share} for member, share in shares.items()]
    body: JsonObject = {"members": members} if is_mixture(ref) else {"version": members[0]["version"]}
    if expected is not ANY:
        body["expected"] = expected
    path = f"/v1/leagues/{next(iter(shares)).league}/aliases/{check_alias(alias)}"
    return _change(path, _parse_promotion, body, reason, key)


def rollback(slug: str, expected: int, reason: str | None, key: str | None) -> ApiCall[Promotion]:
    """Restore the previous champion."""
    body = {} if expected is ANY else {"expected": expected}
    path = f"/v1/leagues/{check_slug('league', slug)}/rollback"
    return _change(path, _parse_promotion, body, reason, key)


def evaluate(slug: str, options: Mapping[str, Any], reason: str | None, key: str | None) -> ApiCall[JsonObject]:
    """Start an evaluation. options: further fields of the body of `POST …/evaluations`."""
    return _change(_evaluations_path(slug), lambda body, _: body, options, reason, key)


def evaluation(slug: str, number: int) -> ApiCall[JsonObject]:
    """Describe one evaluation."""
    return ApiCall(f"{_evaluations_path(slug)}/{number:d}", lambda body, _: body)


def evaluations(slug: str, before: int | None, limit: int) -> ApiCall[list[JsonObject]]:
    """List the evaluations of a league."""
    older = "" if before is None else f"&before={before:d}"
    return ApiCall(f"{_evaluations_path(slug)}?limit={limit:d}{older}", lambda body, _: body["evaluations"])


def stop_evaluation(slug: str, number: int) -> ApiCall[JsonObject]:
    """Stop an evaluation."""
    return ApiCall(f"{_evaluations_path(slug)}/{number:d}", lambda body, _: body, is_delete=True)


def has_ended(evaluation: JsonObject) -> bool:
    """Return whether an evaluation is neither queued nor running."""
    return evaluation["state"] not in ("queued", "running")


def outdated_replicas(league: JsonObject, promotion: Promotion) -> list[str]:
    """Describe each replica that does not serve a promoted version yet.

    league: the league's description. Raises AliasMoved if the alias points to another version by now.
    """
    alias, version = promotion.alias, promotion.version
    current = league["aliases"].get(alias)
    if current != version:
        raise AliasMoved(f"{league['league']}@{alias} has been moved to version {current} meanwhile")
    if not league["replicas"]:
        return ["no replica has reported the versions that it serves"]
    outdated = [
        replica
        for replica in league["replicas"]
        if replica["aliases"].get(alias) != version or (replica["event"] or 0) < promotion.event
    ]
    return [
        f"{replica['replica']} served {replica['aliases'].get(alias)} {replica['silent_seconds']:.0f} s ago"
        f" ({replica['fault'] or 'no error'})"
        for replica in outdated
    ]


def rollout_error(promotion: Promotion, seconds: float, outdated: list[str]) -> str:
    """Return the error message for a promotion that did not reach every replica in time."""
    ref = f"{promotion.league}@{promotion.alias}"
    return f"{ref} is version {promotion.version}, but not every replica serves it after {seconds:g} s: " + "; ".join(
        outdated
    )


def _evaluations_path(slug: str) -> str:
    return f"/v1/leagues/{check_slug('league', slug)}/evaluations"


def _change(
    path: str, parse: Callable[[JsonObject, str], T], body: Mapping[str, Any], reason: str | None, key: str | None
) -> ApiCall[T]:
    """Return a call that changes something. key: a request with the same one is applied once."""
    content = to_json(body if reason is None else {**body, "reason": reason})
    return ApiCall(path, parse, content, {"idempotency-key": key or str(uuid4())})


def _parse_promotion(body: JsonObject, _: str) -> Promotion:
    """Ignores unknown fields, which newer servers may send."""
    field_names = {promotion_field.name for promotion_field in fields(Promotion)}
    return Promotion(**{name: value for name, value in body.items() if name in field_names})
