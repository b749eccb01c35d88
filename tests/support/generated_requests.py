"""Requests that schemathesis generates from the server's OpenAPI document, valid and invalid."""

from dataclasses import dataclass
from typing import Any

import requests
import schemathesis
from hypothesis import assume
from hypothesis import strategies as st
from schemathesis import Case, GenerationMode
from schemathesis.schemas import APIOperation

from serve_app.openapi.document import document
from tests.support.leagues.match_results import PENDING, SCHEDULE, WON
from tests.support.servers.replicas import LOCALHOST, QUICK

SCHEMA = schemathesis.openapi.from_dict(document(QUICK, []))
OPERATIONS = [
    operation.ok() for operation in SCHEMA.get_all_operations() if not operation.ok().path.endswith("/events")
]
"""All but event streams, which do not end."""
OURS = ("x-api-key", "authorization", "x-request-timeout-ms")
"""Headers that the client sets; a time limit of a millisecond causes a documented error."""
EXISTING = {
    "model": ["board", "vector", "nested", "memory", "duo", "duo.left", "pistons", "kinds", "empty"],
    "league": ["board", "memory", "duo", "empty"],
    "alias": ["champion", "candidate"],
    "version": ["1", "2", "champion"],
    "evaluation": [1, 2, 3],
    "verdict": [WON, PENDING],
    "schedule": [SCHEDULE.id],
    "position": [0, 5],
    "game": [0, 1, 2],
    "run": ["first"],
}
"""Path parameter → values that exist."""


@dataclass(frozen=True)
class GeneratedRequest:
    """A request, and the case that validates its response."""

    method: str
    url: str
    headers: dict[str, str]
    content: bytes | None
    case: Case


def draw_request(data: st.DataObject, operation: APIOperation) -> GeneratedRequest:
    """Draw a request of an operation, in half of the cases for things that exist."""
    names = [parameter.name for parameter in operation.path_parameters]
    named = data.draw(st.none() | st.fixed_dictionaries({name: st.sampled_from(EXISTING[name]) for name in names}))
    mode = data.draw(st.sampled_from(GenerationMode))
    try:
        case = data.draw(operation.as_strategy(mode, path_parameters=named))
    except schemathesis.errors.SchemathesisError:
        assume(False)  # an operation without parameters cannot be violated
        raise
    case.method = operation.method.upper()
    prepared = requests.Request(**case.as_transport_kwargs(base_url=LOCALHOST)).prepare()
    headers = {name: value for name, value in prepared.headers.items() if name.lower() not in OURS}
    return GeneratedRequest(str(prepared.method), str(prepared.url), headers, _content(prepared.body), case)


def _content(body: Any) -> bytes | None:
    return body.encode() if isinstance(body, str) else body
