"""The calls of a client, each as a request and how its reply is read: no connection, so both clients share them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Generic, TypeVar
from uuid import uuid4

from league.client.answers import Answer, BatchAnswer, answer, batch_answer
from league.client.encoding import to_json
from league.client.models import Model
from league.client.questions import BatchQuestion, Question
from league.errors import AliasMoved, InvalidInput
from league.refs import CheckpointRef, check_alias, check_slug

T = TypeVar("T")

Document = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Call(Generic[T]):
    """A request that may be repeated. read: the reply's document and replica → what the caller gets."""

    path: str
    read: Callable[[Document, str], T]
    body: bytes | None = None
    """Of a POST; None is a GET."""
    headers: Mapping[str, str] = field(default_factory=dict)
    is_removal: bool = False
    """A DELETE, which has no body."""


@dataclass(frozen=True, slots=True)
class Promotion:
    """A movement of an alias, as the registry recorded it. kind: `promotion` or `rollback`. verdict: what it rests on,
    None of one by hand."""

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


def act(model: Model, question: Question) -> Call[Answer]:
    """Ask for one action."""
    return Call(
        f"{model.path}/action{model.query}",
        lambda reply, replica: answer(reply, replica, question.seed),
        to_json(question.document),
    )


def act_batch(model: Model, question: BatchQuestion) -> Call[BatchAnswer]:
    """Ask for the actions of a batch."""
    return Call(
        f"{model.path}/action{model.query}",
        lambda reply, replica: batch_answer(reply, replica, question.seed),
        to_json(question.document),
    )


def leagues() -> Call[list[Document]]:
    """Ask for all leagues."""
    return Call("/v1/leagues", lambda reply, _: reply["leagues"])


def league(slug: str) -> Call[Document]:
    """Ask for one league."""
    return Call(f"/v1/leagues/{check_slug('league', slug)}", lambda reply, _: reply)


def versions(slug: str) -> Call[list[Document]]:
    """Ask for the versions of a league."""
    return Call(f"/v1/leagues/{check_slug('league', slug)}/versions", lambda reply, _: reply["versions"])


def health(what: str) -> Call[str]:
    """Ask a replica whether it is `live` or `ready`; returns its name."""
    return Call(f"/v1/health/{what}", lambda reply, _: reply["replica"])


ANY: Any = object()
"""An alias may point anywhere before it is moved."""


def promote(ref: str, alias: str, expected: int | None, reason: str | None, key: str | None) -> Call[Promotion]:
    """Point an alias at a version, `connect_four@3`. Raises InvalidReference or InvalidInput."""
    version = CheckpointRef.parse(ref)
    if not isinstance(version.version, int):
        raise InvalidInput(f"{ref} is an alias, expected the number of a version to promote")
    document: Document = {"version": version.version}
    if expected is not ANY:
        document["expected"] = expected
    path = f"/v1/leagues/{version.league}/aliases/{check_alias(alias)}"
    return _change(path, document, reason, key)


def rollback(slug: str, reason: str | None, key: str | None) -> Call[Promotion]:
    """Go back to the champion before."""
    return _change(f"/v1/leagues/{check_slug('league', slug)}/rollback", {}, reason, key)


def evaluate(slug: str, asked: Mapping[str, Any], reason: str | None, key: str | None) -> Call[Document]:
    """Start an evaluation; `asked` is what the body of POST …/evaluations may hold."""
    document = dict(asked) if reason is None else {**asked, "reason": reason}
    headers = {"idempotency-key": key or str(uuid4())}
    return Call(_evaluations(slug), lambda reply, _: reply, to_json(document), headers)


def evaluation(slug: str, number: int) -> Call[Document]:
    """Ask how an evaluation is."""
    return Call(f"{_evaluations(slug)}/{number:d}", lambda reply, _: reply)


def evaluations(slug: str, before: int | None, limit: int) -> Call[list[Document]]:
    """Ask for a league's evaluations."""
    older = "" if before is None else f"&before={before:d}"
    return Call(f"{_evaluations(slug)}?limit={limit:d}{older}", lambda reply, _: reply["evaluations"])


def stop_evaluation(slug: str, number: int) -> Call[Document]:
    """Ask for the end of an evaluation."""
    return Call(f"{_evaluations(slug)}/{number:d}", lambda reply, _: reply, is_removal=True)


def has_ended(told: Document) -> bool:
    """Whether an evaluation goes on no more."""
    return told["state"] not in ("queued", "running")


def _evaluations(slug: str) -> str:
    return f"/v1/leagues/{check_slug('league', slug)}/evaluations"


def late(told: Document, alias: str, version: int) -> list[str]:
    """The replicas that do not serve a version as `alias` yet, each with why, as a league's document tells; a sentence
    if there is no replica. Raises AliasMoved if the alias points elsewhere by now."""
    now = told["aliases"].get(alias)
    if now != version:
        raise AliasMoved(f"{told['league']}@{alias} has moved on to version {now} meanwhile")
    if not told["replicas"]:
        return ["no replica has said that it serves anything"]
    behind = [said for said in told["replicas"] if said["aliases"].get(alias) != version]
    return [f"{said['replica']} serves {said['aliases'].get(alias)} ({said['fault'] or 'no fault'})" for said in behind]


def not_everywhere(moved: Promotion, seconds: float, behind: list[str]) -> str:
    """What is said when waiting for replicas was in vain."""
    where = f"{moved.league}@{moved.alias} is version {moved.version}"
    return f"{where}, but after {seconds:g} s not every replica serves it: {'; '.join(behind)}"


def _change(path: str, document: Document, reason: str | None, key: str | None) -> Call[Promotion]:
    if reason is not None:
        document["reason"] = reason
    headers = {"idempotency-key": key or str(uuid4())}
    return Call(path, _moved, to_json(document), headers)


def _moved(reply: Document, _: str) -> Promotion:
    """What a server of a later version says besides is left out."""
    known = {each.name for each in fields(Promotion)}
    return Promotion(**{name: value for name, value in reply.items() if name in known})
