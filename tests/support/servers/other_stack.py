"""The application, deployed from a machine with another version of a package."""

from ray import serve
from ray.serve import Application

from league.stack import installed_with_this
from serve_app.app import PolicyServer
from serve_app.settings import ServeSettings

OTHER = {"onnxruntime": "1.2.3"}


def build_app(args: ServeSettings) -> Application:
    """As `serve_app.app:build_app`."""
    deployment = serve.deployment(serve.ingress()(PolicyServer))
    return deployment.bind(args, None, None, installed_with_this() | OTHER)
