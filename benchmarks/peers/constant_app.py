"""The lower bound of a policy server on Ray Serve: reads the request body and answers with a constant.

`build_app` is deployed with the settings of deploy.yaml in place of serve_app: through HAProxy and Ray Serve's request
handling. `build_short` bypasses that handling, like serve_app for actions.
"""

from typing import Any

from ray import serve
from ray.serve import Application
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import Receive, Scope, Send

from serve_app.runtime.ray_serve import replica_id
from serve_app.runtime.serve_bypass import install

ANSWER = b'{"action":3,"model":"connect_four","version":1,"sha256":"' + b"0" * 64 + b'"}'


class Constant:
    """A replica."""

    def __init__(self, short: bool) -> None:
        self._short = short
        self._replica = replica_id()

    def __serve_build_asgi_app__(self) -> Starlette:
        async def ready(_: Request) -> Response:
            return JSONResponse({"replica": self._replica})

        action = Route("/v1/policies/{model}/action", Answer(), methods=["POST"])
        application = Starlette(routes=[action, Route("/v1/health/ready", ready)])
        if self._short:
            install(application)
        return application


class Answer:
    """An ASGI application that reads the complete body and answers."""

    async def __call__(self, _: Scope, receive: Receive, send: Send) -> None:
        while (await receive()).get("more_body", False):
            pass
        headers = [(b"content-type", b"application/json"), (b"content-length", b"%d" % len(ANSWER))]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": ANSWER})


def build_app(_: Any) -> Application:
    """The Serve application."""
    return _deployment().bind(short=False)


def build_short(_: Any) -> Application:
    """The same without Serve's request handling."""
    return _deployment().bind(short=True)


def _deployment() -> Any:
    return serve.deployment(name="PolicyServer")(serve.ingress()(Constant))
