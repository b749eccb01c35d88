"""Parses query strings of inference requests, which do not pass through `endpoints`."""

from urllib.parse import parse_qsl

from starlette.types import Scope

from league.errors import InvalidInput

MAX_PARAMETERS = 16
"""Maximum query parameters."""


def query_params(scope: Scope) -> dict[str, str]:
    """The query parameters. Raises InvalidInput."""
    text: bytes = scope["query_string"]
    if not text:
        return {}
    try:
        return dict(parse_qsl(text.decode("latin-1"), keep_blank_values=True, max_num_fields=MAX_PARAMETERS))
    except ValueError:
        raise InvalidInput(f"the query has more than {MAX_PARAMETERS} parameters") from None
