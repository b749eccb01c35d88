"""The OpenAPI document of a server: openapi.yaml, with this installation's limits and examples of what it serves."""

from collections.abc import Iterable, Iterator
from copy import deepcopy
from functools import cache
from importlib.metadata import version as installed
from pathlib import Path
from typing import Any

import yaml

from serve_app.loading import LoadedPolicy, LoadedVersion
from serve_app.openapi.examples import action_request, infer_request
from serve_app.settings import ServeSettings

SOURCE = Path(__file__).with_name("openapi.yaml")
ACT = "/v1/policies/{model}/action"
INFER = ("/v2/models/{model}/infer", "/v2/models/{model}/versions/{version}/infer")

Document = dict[str, Any]


def document(settings: ServeSettings, served: Iterable[LoadedVersion]) -> Document:
    """Describe every route; `served`: the versions for whose policies there shall be examples."""
    described = deepcopy(_source())
    described["info"]["version"] = installed("policy-league")
    schemas = described["components"]["schemas"]
    schemas["ActionRequest"]["properties"]["observations"]["maxItems"] = settings.max_batch
    described["info"]["description"] += (
        f"\n**Limits.** {settings.max_body:,} bytes and {settings.max_batch:,} observations in one request, "
        f"{settings.max_in_flight:,} requests at once, {settings.timeout:g} s for each.\n"
    )
    policies = dict(_named(served))
    if policies:
        _show(described, policies)
    return described


def _show(described: Document, policies: dict[str, LoadedPolicy]) -> None:
    """Put examples of the policies before the general ones. `x-model`: the model that an example is for."""
    acting = {_key(model): _example(model, action_request(policy)) for model, policy in policies.items()}
    body = _body(described, ACT)
    body["examples"] = acting | body["examples"]
    inferring = {
        _key(model): _example(model, request)
        for model, policy in policies.items()
        if (request := infer_request(policy)) is not None
    }
    for path in INFER:
        body = _body(described, path)
        body["examples"] = inferring | body["examples"]
    parameters = described["components"]["parameters"]
    parameters["model"]["example"] = next(iter(policies))
    parameters["league"]["example"] = next(iter(policies)).partition(".")[0]


def _body(described: Document, path: str) -> Document:
    body: Document = described["paths"][path]["post"]["requestBody"]["content"]["application/json"]
    return body


def _example(model: str, value: Any) -> Document:
    return {"summary": model, "value": value, "x-model": model}


def _key(model: str) -> str:
    return f"of_{model}"


def _named(served: Iterable[LoadedVersion]) -> Iterator[tuple[str, LoadedPolicy]]:
    for version in served:
        for name, policy in version.policies.items():
            yield version.league if len(version.policies) == 1 else f"{version.league}.{name}", policy


@cache
def _source() -> Document:
    loader = getattr(
        yaml, "CSafeLoader", yaml.SafeLoader
    )  # C's is several times as fast, where PyYAML was built with it
    parsed: Document = yaml.load(SOURCE.read_text("utf-8"), loader)
    return parsed
