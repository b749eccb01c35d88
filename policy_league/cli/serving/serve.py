"""`league serve`."""

from typing import TYPE_CHECKING, Annotated

import typer

from league.refs import CHAMPION
from league.settings import Storage
from policy_league.cli.options import DEFAULT_URL, open_registry
from policy_league.cli.output import say

if TYPE_CHECKING:
    from league.registry.registry import Registry


def serve(
    host: Annotated[
        str | None, typer.Option(help="Address to listen on. Default: from deploy.yaml, 127.0.0.1.")
    ] = None,
    port: Annotated[int | None, typer.Option(help="HTTP port. Default: from deploy.yaml, 8000.")] = None,
    grpc_port: Annotated[int | None, typer.Option(help="gRPC port. Default: from deploy.yaml, 8001.")] = None,
    replicas: Annotated[
        int | None, typer.Option(min=1, help="Number of server processes. Default: from deploy.yaml, 2.")
    ] = None,
    max_replicas: Annotated[
        int | None,
        typer.Option(min=1, help="Start up to this number of server processes under load. Default: no more."),
    ] = None,
    root_path: Annotated[
        str | None,
        typer.Option(help="Path below which a proxy serves this server, such as /ai. Default: from deploy.yaml."),
    ] = None,
    address: Annotated[
        str | None, typer.Option(help="Running Ray cluster. Default: start Ray on this machine.")
    ] = None,
    dashboard: Annotated[
        bool, typer.Option("--dashboard", help="Start the local Ray's dashboard, with Ray's own metrics.")
    ] = False,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Accept requests without an API key, even from other machines.")
    ] = False,
) -> None:
    """Serve all leagues over HTTP and gRPC until Ctrl-C.

    `POST /v1/policies/{league}/action` returns the action of the champion, or of any version, for an observation.
    Replicas apply promotions and rollbacks within a second, without a restart and without failed requests.

    API keys (`league keys`) authenticate clients. On the loopback interface they are required as soon as one exists.
    Listening on other interfaces (`--host 0.0.0.0`) requires at least one key, or --insecure.
    """
    from serve_app.runtime.launch import serve_forever

    storage = Storage.from_environment()
    say("Starting Ray Serve …")
    serve_forever(
        storage,
        host=host,
        port=port,
        grpc_port=grpc_port,
        replicas=replicas,
        max_replicas=max_replicas,
        insecure=insecure,
        root_path=root_path,
        address=address,
        dashboard=dashboard,
        on_ready=lambda url, logs, of_dashboard: say(
            f"Serving the leagues of {storage.home} on {url}\n{hints(open_registry(), url)}\n"
            f"Logs of Ray and of the replicas: {logs}\n"
            + (f"Ray's dashboard: {of_dashboard}\n" if of_dashboard else "")
            + "Stop: Ctrl-C"
        ),
    )


def hints(registry: "Registry", url: str) -> str:
    """The addresses of a server, and what to do first: call a champion, or get one.

    The league is the one whose champion was promoted last.
    """
    promoted = {league: target.event for (league, alias), target in registry.aliases.all().items() if alias == CHAMPION}
    newest = max(promoted, key=lambda league: promoted[league], default=None)
    model = newest or "LEAGUE"
    called = url.replace("//0.0.0.0:", "//127.0.0.1:").replace("//[::]:", "//[::1]:")
    addresses = {
        called: "web pages",
        f"{called}/docs": "API documentation",
        f"{called}/v1/leagues": "leagues as JSON",
        f"{called}/v1/policies/{model}/action": "POST an observation to get an action",
        f"{called}/v2/models/{model}": "Open Inference Protocol over HTTP; also over gRPC",
    }
    width = max(map(len, addresses))
    lines = [f"  {address:{width}}  {what}" for address, what in addresses.items()]
    if newest is None:
        lines.append("No league has a champion yet: league train CONFIG, then league nightly LEAGUE.")
    else:
        option = "" if called == DEFAULT_URL else f" --url {called}"
        lines.append(f"Try: league act {newest}@{CHAMPION}{option}")
    return "\n".join(lines)
