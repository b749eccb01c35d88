"""Builds the OpenAPI document: the declared routes, with the limits of this server and examples for its policies."""

from collections.abc import Iterable, Iterator
from copy import deepcopy
from functools import cache
from importlib.metadata import version as installed
from pathlib import Path
from typing import Any

import yaml

from serve_app.live_versions.version_cache import LoadedPolicy, LoadedVersion
from serve_app.openapi.examples import action_request, infer_request
from serve_app.openapi.operations import KEY, Document, describe
from serve_app.routes.table import ROUTES
from serve_app.settings import ServeSettings

SOURCE = Path(__file__).with_name("openapi.yaml")
ACTION_PATH = "/v1/policies/{model}/action"
INFER_PATHS = ("/v2/models/{model}/infer", "/v2/models/{model}/versions/{version}/infer")


def document(settings: ServeSettings, served: Iterable[LoadedVersion]) -> Document:
    """The OpenAPI document. `served`: versions whose policies get examples."""
    described = deepcopy(_source())
    described["servers"] = [{"url": settings.root_path or "/"}]
    described["info"]["version"] = installed("policy-league")
    schemas = described["components"]["schemas"]
    schemas["ActionRequest"]["properties"]["observations"]["maxItems"] = settings.max_batch
    described["info"]["description"] += (
        f"\n**Limits.** {settings.max_body:,} bytes and {settings.max_batch:,} observations per request, "
        f"{settings.max_in_flight:,} concurrent requests, a timeout of {settings.timeout:g} s.\n"
    )
    policies = dict(_named(served))
    if policies:
        _show(described, policies)
    return described


def _show(described: Document, policies: dict[str, LoadedPolicy]) -> None:
    """Insert examples of the policies before the general ones. `x-model`: the model of an example."""
    acting = {_key(model): _example(model, action_request(policy)) for model, policy in policies.items()}
    body = _body(described, ACTION_PATH)
    body["examples"] = acting | body["examples"]
    inferring = {
        _key(model): _example(model, request)
        for model, policy in policies.items()
        if (request := infer_request(policy)) is not None
    }
    for path in INFER_PATHS:
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
    """The document without what depends on the server."""
    # Several times as fast as SafeLoader, if PyYAML was built with libyaml.
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    source: Document = yaml.load(SOURCE.read_text("utf-8"), loader)
    examples = source.pop("examples")
    paths, components = describe(ROUTES, examples["requests"], examples["responses"])
    components["schemas"] |= source["components"]["schemas"]
    return source | {"security": [{}, *KEY], "paths": paths, "components": source["components"] | components}
