"""What people write of a version.

PUT  /v1/leagues/{league}/versions/{version}/note   {"note": "…"}

It takes an API key of scope `promote`, whose name is kept with the note. The note before is replaced, by an empty one
taken away; to put the same one twice is to put it once, so that no `Idempotency-Key` is needed.
"""

from pydantic import BaseModel, ConfigDict, Field
from starlette.requests import Request
from starlette.responses import JSONResponse

from league.refs import CheckpointRef, check_slug, parse_version
from league.registry.notes import LONGEST
from serve_app.bodies import read_body
from serve_app.doors import KEY
from serve_app.keyring import Key
from serve_app.models import Models
from serve_app.routes.leagues import version_document
from serve_app.routes.promotion import parse
from serve_app.settings import ServeSettings


class Note(BaseModel):
    """The body."""

    model_config = ConfigDict(extra="forbid", strict=True)

    note: str = Field(max_length=LONGEST, pattern=r"^[^\x00]*$")


class NoteRoutes:
    """The endpoint. Doors lets only keys of scope `promote` come here."""

    def __init__(self, models: Models, settings: ServeSettings) -> None:
        self._models = models
        self._settings = settings

    async def put(self, request: Request) -> JSONResponse:
        """Write of a version. Raises InvalidReference, UnknownLeague, UnknownVersion, UnknownAlias or InvalidInput."""
        league = check_slug("league", request.path_params["league"])
        ref = CheckpointRef(league, parse_version(request.path_params["version"]))
        body = parse(Note, await read_body(request.scope, request.receive, self._settings.max_body))
        key: Key = request.scope[KEY]
        row = await self._models.ask(lambda registry: registry.note(ref, body.note, actor=key.name))
        return JSONResponse(version_document(row))
