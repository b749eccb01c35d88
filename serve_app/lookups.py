"""A look into the registry that is answered as JSON, which is written in the thread that looks: a page may be long, and
the event loop has actions to answer.
"""

from collections.abc import Callable
from typing import Any

import orjson
from starlette.responses import Response

from league.registry.registry import Registry
from serve_app.models import Models


async def looked_up(models: Models, question: Callable[[Registry], dict[str, Any]]) -> Response:
    """What `question` finds. Raises what it raises."""

    def answer(registry: Registry) -> bytes:
        return orjson.dumps(question(registry))

    return Response(await models.ask(answer), media_type="application/json")
