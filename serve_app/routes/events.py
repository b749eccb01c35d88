"""Server-sent events: what of a league, or of an evaluation, has changed, as soon as it has.

GET  /v1/leagues/{league}/events                            event `league`: where it stands, so what to ask for again
GET  /v1/leagues/{league}/evaluations/{evaluation}/events   event `evaluation`: all of it, until it has ended

A stream begins with what there is. It ends when the replica stops, or the key that opened it is valid no longer:
whoever wants more opens it again. It is read by `fetch`, for the `EventSource` of browsers sends no key.
"""

from collections.abc import AsyncIterator, Callable

import orjson
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.types import ASGIApp, Receive, Scope, Send

from league.errors import Unauthenticated
from league.refs import check_slug
from league.registry.registry import Registry
from league.registry.rows import Pulse
from serve_app.doors import KEY, Doors
from serve_app.events import Document, Events
from serve_app.routes.evaluations import evaluation_document, named
from serve_app.settings import ACKNOWLEDGED_WITHIN

EVENT_STREAM = "text/event-stream"
HEADERS = {"cache-control": "no-store", "x-accel-buffering": "no"}
"""The second is for nginx, which would gather what it passes on."""
NOTHING_NEW = b": nothing new\n\n"


class EventRoutes:
    """The endpoints."""

    def __init__(self, events: Events, doors: Doors) -> None:
        self._events = events
        self._doors = doors

    async def league(self, request: Request) -> ASGIApp:
        """Where a league stands. Raises UnknownLeague."""
        league = check_slug("league", request.path_params["league"])

        def look(registry: Registry) -> Document:
            return _pulse(registry.pulse(league, since=ACKNOWLEDGED_WITHIN))

        return self._stream(request, "league", look, is_last=lambda _: False)

    async def evaluation(self, request: Request) -> ASGIApp:
        """One evaluation. Raises UnknownLeague or UnknownEvaluation."""
        league, number = named(request)

        def look(registry: Registry) -> Document:
            return evaluation_document(registry.evaluation(league, number))

        return self._stream(request, "evaluation", look, is_last=lambda document: document["ended_at"] is not None)

    def _stream(
        self, request: Request, kind: str, look: Callable[[Registry], Document], is_last: Callable[[Document], bool]
    ) -> ASGIApp:
        if request.method == "HEAD":
            return Response(headers=HEADERS, media_type=EVENT_STREAM)

        async def stream(scope: Scope, receive: Receive, send: Send) -> None:
            async with self._events.listening(scope["path"], look) as documents:
                messages = _messages(documents, kind, is_last, lambda: self._doors.admit_still(scope.get(KEY)))
                await StreamingResponse(messages, headers=HEADERS, media_type=EVENT_STREAM)(scope, receive, send)

        return stream


async def _messages(
    documents: AsyncIterator[Document | None],
    kind: str,
    is_last: Callable[[Document], bool],
    check: Callable[[], None],
) -> AsyncIterator[bytes]:
    """A stream of events of one kind (HTML Standard, section 9.2.5), for as long as `check` lets it go on."""
    async for document in documents:
        try:
            check()
        except Unauthenticated:
            return
        if document is None:
            yield NOTHING_NEW
            continue
        yield b"event: %b\ndata: %b\n\n" % (kind.encode(), orjson.dumps(document))
        if is_last(document):
            return


def _pulse(pulse: Pulse) -> Document:
    return {
        "league": pulse.league,
        "aliases": pulse.aliases,
        "event": pulse.event,
        "version": pulse.version,
        "note": pulse.note,
        "traffic": pulse.traffic,
        "serving": {str(version): replicas for version, replicas in pulse.serving.items()},
        "verdicts": pulse.verdicts,
        "evaluation": pulse.evaluation,
        "evaluations": [
            {"evaluation": row.id, "state": row.state, "progress": row.progress} for row in pulse.evaluations
        ],
        "run": pulse.run,
        "runs": [{"run": row.id, "state": row.state, "steps": row.steps} for row in pulse.runs],
        "computed_at": pulse.computed_at and pulse.computed_at.isoformat(),
    }
